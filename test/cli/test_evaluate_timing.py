# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`gam_relocalizer evaluate timing` on a map of a few rendered images."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING

import pytest
from corner_room import CAMERA, write_room_images
from typer.testing import CliRunner

from gam_relocalizer.cli.main import app
from gam_relocalizer.errors import ImageError, UsageError
from gam_relocalizer.image_set import ImageSet
from gam_relocalizer.mapping.build import MapBuildOptions, build_map

if TYPE_CHECKING:
    from pathlib import Path

    from click.testing import Result


@dataclass(frozen=True)
class Corner:
    """A map, the images it was built from and their poses."""

    path: Path
    images: Path
    poses: Path

    @property
    def queries(self) -> tuple[str, ...]:
        """The images themselves are localized."""
        words = ('--map', self.path, '--queries', self.images, '--truth', self.poses)
        return (*map(str, words), '--every', '2')


@pytest.fixture(scope='module')
def corner(tmp_path_factory: pytest.TempPathFactory) -> Corner:
    return built(tmp_path_factory.mktemp('timing'), 'xfeat')


def built(folder: Path, extractor: str) -> Corner:
    poses = write_room_images(folder / 'images', count=4)
    images = ImageSet.of_folder(folder / 'images', CAMERA, poses)
    build_map(images, folder / 'corner', MapBuildOptions(extractor=extractor, max_keypoints=300))
    return Corner(folder / 'corner', folder / 'images', folder / 'poses.txt')


def run(corner: Corner, *arguments: object) -> Result:
    words = ['evaluate', 'timing', *corner.queries, *map(str, arguments)]
    return CliRunner().invoke(app, words)


def test_times_both_methods_and_writes_what_it_prints(corner: Corner, tmp_path: Path) -> None:
    out = tmp_path / 'a' / 'b'
    done = run(corner, '--images', corner.images, '--retrieved', 2, '--out', out)

    assert done.exit_code == 0
    assert done.stdout == (out / 'timing.md').read_text()
    names = {'timing.md', 'timing.json', 'timing.png', 'timing.html'}
    assert {path.name for path in out.iterdir()} == names
    (only,) = json.loads((out / 'timing.json').read_text())['sets']
    assert [method['retrieved_images'] for method in only['methods']] == [2, 10, 2, 10]
    for method in only['methods']:
        assert (method['found']['queries'], method['found']['localized']) == (2, 2)
        assert method['found']['median_position'] < 0.05
        assert method['elapsed']['mean'] > 0.0
    assert only['speedup']['elapsed']['mean'] > 0.0


def test_without_images_only_the_localizer_is_timed(corner: Corner) -> None:
    done = run(corner, '--retrieved', 1)
    assert done.exit_code == 0
    assert 'LighterGlue' not in done.stdout
    assert '--images' in done.stderr


def test_images_are_a_folder_per_map(corner: Corner) -> None:
    images = ('--images', corner.images)
    assert isinstance(run(corner, *images, *images).exception, UsageError)
    assert isinstance(run(corner, '--images', corner.images / 'nowhere').exception, UsageError)


def test_other_images_are_an_image_error(corner: Corner, tmp_path: Path) -> None:
    write_room_images(tmp_path / 'images', count=5)
    done = run(corner, '--images', tmp_path / 'images')
    assert isinstance(done.exception, ImageError)


def test_a_map_of_other_features_cannot_be_compared(tmp_path: Path) -> None:
    of_sift = built(tmp_path, 'sift')
    done = run(of_sift, '--images', of_sift.images)
    assert isinstance(done.exception, UsageError)
    assert 'sift' in str(done.exception)


def test_less_than_one_retrieved_image_exits_with_2(corner: Corner) -> None:
    assert run(corner, '--retrieved', 0).exit_code == 2
