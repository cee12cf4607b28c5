# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest
import typer
from recorded_drive import KnowingLocalizer, fill_with_odometry, write_bag
from typer.testing import CliRunner

from gam_relocalizer.cli.replay import replay
from gam_relocalizer.errors import BagError, MapError, UsageError, WeightsError
from gam_relocalizer.localization.localizer import Localizer
from gam_relocalizer.replay.writing import ATTEMPTS, CORRECTED, FIXES, POSES, SUMMARY

if TYPE_CHECKING:
    from pathlib import Path

    from click.testing import Result
    from tiny_place import TinyPlace

    from gam_relocalizer.scene_map import SceneMap


@pytest.fixture
def knowing_localizer(monkeypatch: pytest.MonkeyPatch, wall_map: SceneMap) -> KnowingLocalizer:
    """The command gets a localizer that knows where it is, whatever the map."""
    localizer = KnowingLocalizer(wall_map.points, refuse=[20])
    localizer.scene_map = wall_map
    monkeypatch.setattr(Localizer, 'load', lambda _map_path, _options: localizer)
    return localizer


def run(*arguments: object) -> Result:
    app = typer.Typer()
    app.command()(replay)
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.mark.usefixtures('knowing_localizer')
def test_writes_all_files_and_succeeds_with_refused_attempts(
    mcap_drive: Path, tmp_path: Path
) -> None:
    out = tmp_path / 'out'
    result = run(
        mcap_drive, '--map', 'wall', '--out', out, '--period', 1.0,
        '--truth-topic', '/ground_truth',
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    names = {POSES, ATTEMPTS, FIXES, SUMMARY, 'report.html', 'overview.png'}
    assert {file.name for file in out.iterdir()} == names
    summary = json.loads((out / SUMMARY).read_text(encoding='utf-8'))
    assert summary['trajectory_errors'] == {}
    assert (summary['attempts'], summary['accepted'], summary['images']) == (10, 9, 100)
    assert summary['image_topic'] == '/camera/image'
    assert (summary['matcher'], summary['weights']) == ('gam', None)
    assert 'TOO_FEW_INLIERS' in result.output


def test_fixes_that_odometry_speaks_against_are_told_as_implausible(
    knowing_localizer: KnowingLocalizer, tmp_path: Path
) -> None:
    knowing_localizer.mistaken = {50: 99}
    bag, out = write_bag(tmp_path / 'bag', fill_with_odometry), tmp_path / 'out'
    result = run(bag, '--map', 'wall', '--out', out, '--period', 1.0, '--odom-topic', '/odom')
    assert result.exit_code == 0, result.output
    summary = json.loads((out / SUMMARY).read_text(encoding='utf-8'))
    assert summary['odometry_topic'] == '/odom'
    assert summary['statuses'] == {'ACCEPTED': 8, 'TOO_FEW_INLIERS': 1, 'IMPLAUSIBLE': 1}


@pytest.mark.usefixtures('knowing_localizer')
def test_odometry_is_written_corrected_and_its_errors_are_told(tmp_path: Path) -> None:
    bag, out = write_bag(tmp_path / 'bag', fill_with_odometry), tmp_path / 'out'
    result = run(
        bag, '--map', 'wall', '--out', out, '--period', 1.0, '--odom-topic', '/odom',
        '--truth-topic', '/ground_truth',
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    # from the second fix on, which confirms the first one
    lines = (out / CORRECTED).read_text(encoding='utf-8').splitlines()
    assert len(lines) == 90
    errors = json.loads((out / SUMMARY).read_text(encoding='utf-8'))['trajectory_errors']
    counts = {name: error['poses'] for name, error in errors.items()}
    assert counts == {'odometry': 100, 'fixes': 9, 'corrected': 90}
    for name, error in errors.items():
        assert error['position_max'] < 1e-6
        assert name in result.output
    assert 'Drift correction' in (out / 'report.html').read_text(encoding='utf-8')


def test_drive_through_a_rendered_room_is_found_twice_alike(
    tiny_place: TinyPlace, tmp_path: Path
) -> None:
    for name in ('first', 'second'):
        result = run(
            tiny_place.bag, '--map', tiny_place.map_path, '--out', tmp_path / name,
            '--period', 1.0, '--truth-topic', '/ground_truth',
        )  # fmt: skip
        assert result.exit_code == 0, result.output
    summary = json.loads((tmp_path / 'first' / SUMMARY).read_text(encoding='utf-8'))
    assert summary['accepted'] >= 0.75 * summary['attempts'] > 0
    assert summary['position_error']['median'] < 0.05
    assert summary['rotation_error_deg']['median'] < 1.0
    for file in (POSES, FIXES):
        first = (tmp_path / 'first' / file).read_bytes()
        assert first == (tmp_path / 'second' / file).read_bytes()


def test_matcher_is_the_one_named(tiny_place: TinyPlace, tmp_path: Path) -> None:
    result = run(
        tiny_place.bag, '--map', tiny_place.map_path, '--out', tmp_path / 'out',
        '--period', 2.0, '--truth-topic', '/ground_truth', '--matcher', 'nn-cross',
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    summary = json.loads((tmp_path / 'out' / SUMMARY).read_text(encoding='utf-8'))
    assert summary['matcher'] == 'nn-cross'
    assert summary['accepted'] == summary['attempts'] > 0
    assert summary['position_error']['median'] < 0.05


@pytest.mark.parametrize(
    ('arguments', 'error'),
    [
        (['--matcher', 'best'], UsageError),
        (['--matcher', 'nn-cross', '--weights', 'tuned.npz'], UsageError),
        (['--weights', 'nowhere.npz'], WeightsError),
        (['--global-weights', 'netvlad.mat'], UsageError),
    ],
)
def test_matcher_that_cannot_be_had_is_a_failure_that_leaves_nothing(
    tiny_place: TinyPlace, tmp_path: Path, arguments: list[str], error: type[Exception]
) -> None:
    out = tmp_path / 'out'
    result = run(tiny_place.bag, '--map', tiny_place.map_path, '--out', out, *arguments)
    assert isinstance(result.exception, error)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures('knowing_localizer')
def test_bag_without_the_topic_is_a_failure_that_leaves_nothing(
    mcap_drive: Path, tmp_path: Path
) -> None:
    out = tmp_path / 'out'
    result = run(mcap_drive, '--map', 'wall', '--out', out, '--image-topic', '/left/image')
    assert isinstance(result.exception, BagError)
    assert '/camera/image' in str(result.exception)
    assert list(tmp_path.iterdir()) == []


def test_missing_map_is_a_failure_that_leaves_nothing(mcap_drive: Path, tmp_path: Path) -> None:
    result = run(mcap_drive, '--map', tmp_path / 'nowhere', '--out', tmp_path / 'out')
    assert isinstance(result.exception, MapError)
    assert list(tmp_path.iterdir()) == []


def test_folder_of_something_else_is_refused_before_anything_runs(tmp_path: Path) -> None:
    (tmp_path / 'notes.txt').write_text('precious', encoding='utf-8')
    result = run(tmp_path / 'nowhere', '--map', tmp_path / 'nowhere', '--out', tmp_path)
    assert isinstance(result.exception, UsageError)


@pytest.mark.usefixtures('knowing_localizer')
def test_bag_without_an_image_gives_a_whole_report(tmp_path: Path) -> None:
    def fill(bag: object) -> None:
        bag.topic('/camera/image', 'sensor_msgs/msg/Image')
        bag.camera_info(0)

    result = run(write_bag(tmp_path / 'bag', fill), '--map', 'wall', '--out', tmp_path / 'out')
    assert result.exit_code == 0, result.output
    assert json.loads((tmp_path / 'out' / SUMMARY).read_text(encoding='utf-8'))['attempts'] == 0


@pytest.mark.parametrize('period', ['-1', 'often'])
def test_period_that_cannot_be_used_is_a_usage_error(tmp_path: Path, period: str) -> None:
    result = run(tmp_path, '--map', tmp_path, '--out', tmp_path / 'out', '--period', period)
    assert result.exit_code == 2
