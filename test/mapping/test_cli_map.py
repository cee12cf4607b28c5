# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from corner_room import CAMERA
from typer.testing import CliRunner

from gam_relocalizer.cameras import format_camera
from gam_relocalizer.cli.map import app
from gam_relocalizer.errors import MapBuildError, MapError, UsageError
from gam_relocalizer.mapping.workspace import open_workspace
from gam_relocalizer.scene_map import load_map, read_manifest

if TYPE_CHECKING:
    from click.testing import Result
    from conftest import BuiltMap, Room

RUNNER = CliRunner()


def run(*arguments: str) -> Result:
    return RUNNER.invoke(app, arguments)


def test_builds_a_map_from_images_camera_and_poses(room: Room, tmp_path: Path) -> None:
    (tmp_path / 'camera.txt').write_text(f'{format_camera(CAMERA)}\n')

    done = run(
        'build',
        *('--images', str(room.images)),
        *('--out', str(tmp_path / 'map')),
        *('--camera', str(tmp_path / 'camera.txt')),
        *('--poses', str(room.images.parent / 'poses.txt')),
        *('--max-keypoints', '600'),
    )

    assert done.exit_code == 0
    assert '8 of 8' in done.stdout
    assert load_map(tmp_path / 'map').num_images == 8


def build(room: Room, out: Path, *arguments: str) -> Result:
    return run(
        'build',
        *('--images', str(room.images)),
        *('--out', str(out)),
        *('--camera', format_camera(CAMERA)),
        *('--max-keypoints', '300'),
        *arguments,
    )


def test_keeps_the_finished_steps_beside_the_map_until_told_otherwise(
    room: Room, tmp_path: Path
) -> None:
    out, work = tmp_path / 'map', tmp_path / 'map.work'

    first = build(room, out)
    assert 'map.work,' in first.stdout
    assert 'from the workspace' not in first.stdout
    assert work.is_dir()

    again = build(room, out, '--descriptor-bits', '8', '--discard-work')
    assert 'match 28 pairs' in again.stdout
    assert read_manifest(out).descriptor_bits == 8
    assert not work.exists()


def test_a_camera_that_came_out_elsewhere_is_warned_of_in_output_report_and_check(
    room: Room, tmp_path: Path
) -> None:
    out = tmp_path / 'map'
    arguments = ('--poses', str(room.images.parent / 'poses.txt'), '--refine-camera')

    built = run(
        'build',
        *('--images', str(room.images)),
        *('--out', str(out)),
        *('--camera', 'SIMPLE_PINHOLE 384 288 480 192 144'),
        *('--max-keypoints', '600'),
        *arguments,
    )
    (warning,) = json.loads((tmp_path / 'map.report' / 'report.json').read_text())['warnings']

    assert '480 px' in warning
    assert f'warning: {warning}' in built.stdout
    assert f'warning: build: {warning}' in run('check', str(out)).stdout


def test_a_map_may_be_built_anew_from_inside_its_folder(
    room: Room, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / 'map'
    build(room, out)
    monkeypatch.chdir(out)

    again = build(room, Path(), '--descriptor-bits', '8')

    assert again.exit_code == 0, again.exception
    assert read_manifest(out).descriptor_bits == 8
    assert sorted(path.name for path in tmp_path.iterdir()) == ['map', 'map.report', 'map.work']


def test_a_build_of_a_map_that_is_being_built_is_refused(room: Room, tmp_path: Path) -> None:
    with open_workspace(tmp_path / 'map.work'):
        refused = build(room, tmp_path / 'map')

    assert isinstance(refused.exception, MapBuildError)
    assert not (tmp_path / 'map').exists()


def test_options_that_cannot_be_used_leave_nothing(room: Room, tmp_path: Path) -> None:
    refused = build(room, tmp_path / 'map', '--descriptor-bits', '7')

    assert isinstance(refused.exception, UsageError)
    assert list(tmp_path.iterdir()) == []


def test_info_as_json_is_the_manifest(posed_map: BuiltMap) -> None:
    done = run('info', str(posed_map.path), '--json')

    manifest = read_manifest(posed_map.path)
    shown = json.loads(done.stdout)
    assert done.exit_code == 0
    assert shown['map_id'] == manifest.map_id
    assert shown['counts'] == manifest.counts


def test_info_shows_what_the_map_is(posed_map: BuiltMap) -> None:
    done = run('info', str(posed_map.path))

    assert done.exit_code == 0
    assert read_manifest(posed_map.path).map_id in done.stdout


def test_check_of_a_sound_map_exits_with_0(posed_map: BuiltMap) -> None:
    assert run('check', str(posed_map.path)).exit_code == 0


def test_check_of_a_damaged_map_exits_with_1(posed_map: BuiltMap, tmp_path: Path) -> None:
    shutil.copytree(posed_map.path, tmp_path / 'map')
    (tmp_path / 'map' / 'points.npy').write_bytes(b'')

    done = run('check', str(tmp_path / 'map'))

    assert done.exit_code == 1
    assert 'points.npy' in done.stdout


@pytest.mark.parametrize(
    'arguments',
    [
        ['--images', '/nowhere', '--out', 'map'],
        ['--images', '.', '--out', 'map', '--camera', 'PINHOLE 1'],
        ['--images', '.', '--out', 'map', '--poses', 'nowhere.txt'],
        ['--images', '.', '--out', 'map', '--extractor', 'magic'],
    ],
)
def test_arguments_that_cannot_be_used_are_usage_errors(arguments: list[str]) -> None:
    assert isinstance(run('build', *arguments).exception, UsageError)


@pytest.mark.parametrize(
    'arguments', [['--mapper', 'magic'], ['--max-keypoints', '0'], ['--max-keypoints', 'x']]
)
def test_impossible_values_exit_with_2(arguments: list[str]) -> None:
    assert run('build', '--images', '.', '--out', 'map', *arguments).exit_code == 2


@pytest.mark.parametrize('arguments', [['build', '--images', '.', '--out', '.'], ['info', '.']])
def test_a_folder_that_is_no_map_is_a_map_error(arguments: list[str]) -> None:
    assert isinstance(run(*arguments).exception, MapError)


def test_check_of_nothing_exits_with_1() -> None:
    assert run('check', '/nowhere').exit_code == 1
