# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import pytest
from corner_room import CornerRoom, looking_into_the_corner
from typer.testing import CliRunner

from gam_relocalizer.cli.map import app
from gam_relocalizer.errors import BagError, UsageError, VideoError
from gam_relocalizer.scene_map import load_map

if TYPE_CHECKING:
    from pathlib import Path

    from conftest import BuiltMap


def run(*words: object) -> str:
    result = CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)
    assert result.exit_code == 0
    return result.stdout


def test_extend_adds_a_folder_of_images_under_a_prefix(posed_map: BuiltMap, tmp_path: Path) -> None:
    (tmp_path / 'images').mkdir()
    image = cv2.cvtColor(CornerRoom().render(looking_into_the_corner(0.4)), cv2.COLOR_RGB2BGR)
    cv2.imwrite(str(tmp_path / 'images' / 'view 00.png'), image)

    printed = run(
        'extend',
        posed_map.path,
        '--images',
        tmp_path / 'images',
        '--prefix',
        'day2/',
        '--out',
        tmp_path / 'map',
    )

    assert 'day2/view 00.png' in load_map(tmp_path / 'map').image_names
    assert '1 of 1' in printed


@pytest.mark.parametrize(
    'words',
    [
        [],
        ['--images', '.', '--video', 'walk.mp4'],
        ['--video', 'walk.mp4', '--image-topic', '/image'],
        ['--images', '.', '--image-is-rectified'],
    ],
)
def test_extend_takes_one_source_and_its_options(
    words: list[str], posed_map: BuiltMap, tmp_path: Path
) -> None:
    arguments = ['extend', str(posed_map.path), *words, '--out', str(tmp_path / 'map')]

    assert isinstance(CliRunner().invoke(app, arguments).exception, UsageError)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(('source', 'error'), [('--video', VideoError), ('--bag', BagError)])
def test_extend_by_a_source_that_is_missing_leaves_nothing(
    source: str, error: type[Exception], posed_map: BuiltMap, tmp_path: Path
) -> None:
    nothing, out = str(tmp_path / 'nothing'), str(tmp_path / 'map')
    arguments = ['extend', str(posed_map.path), source, nothing, '--out', out]

    assert isinstance(CliRunner().invoke(app, arguments).exception, error)
    assert list(tmp_path.iterdir()) == []


def test_merge_joins_two_maps(posed_map: BuiltMap, free_map: BuiltMap, tmp_path: Path) -> None:
    printed = run(
        'merge', posed_map.path, free_map.path, '--prefix', 'free/', '--out', tmp_path / 'map'
    )

    assert load_map(tmp_path / 'map').num_images == 16
    assert 'points joined' in printed


def test_prune_prints_what_is_left(posed_map: BuiltMap, tmp_path: Path) -> None:
    printed = run('prune', posed_map.path, '--keep', '0.5', '--out', tmp_path / 'map')

    small = load_map(tmp_path / 'map')
    assert small.num_points < load_map(posed_map.path).num_points
    assert f'{small.num_points} of' in printed


def test_names_that_are_taken_are_a_matter_of_usage(posed_map: BuiltMap, tmp_path: Path) -> None:
    words = ['merge', str(posed_map.path), str(posed_map.path), '--out', str(tmp_path / 'map')]

    result = CliRunner().invoke(app, words)

    assert isinstance(result.exception, UsageError)
    assert not (tmp_path / 'map').exists()
