# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`gam_relocalizer evaluate matching` on a map of a few rendered images."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from typing import TYPE_CHECKING

import pytest
from corner_room import CAMERA, write_room_images
from typer.testing import CliRunner

from gam_relocalizer.cli.main import app
from gam_relocalizer.errors import ImageError, MapError, UsageError
from gam_relocalizer.evaluation.matching import TRUE_CANDIDATES
from gam_relocalizer.mapping.build import MapBuildOptions, build_map
from gam_relocalizer.scene_map import SFM, MapContent, load_map, save_map

if TYPE_CHECKING:
    from pathlib import Path

    from click.testing import Result

HANDCRAFTED = ('--matcher', 'nn-ratio', '--matcher', 'nn-cross')


@dataclass(frozen=True)
class Corner:
    """A map and the images it was built from."""

    path: Path
    images: Path

    @property
    def arguments(self) -> tuple[str, ...]:
        return ('--map', str(self.path), '--images', str(self.images))


@pytest.fixture(scope='module')
def corner(tmp_path_factory: pytest.TempPathFactory) -> Corner:
    folder = tmp_path_factory.mktemp('evaluate')
    poses = write_room_images(folder / 'images', count=4)
    options = MapBuildOptions(camera=CAMERA, poses=poses, poses_are_metric=False, max_keypoints=300)
    build_map(folder / 'images', folder / 'corner', options)
    return Corner(folder / 'corner', folder / 'images')


def run(*arguments: str) -> Result:
    return CliRunner().invoke(app, ['evaluate', 'matching', *arguments])


def test_prints_a_table_and_writes_the_same(corner: Corner, tmp_path: Path) -> None:
    done = run(*corner.arguments, *HANDCRAFTED, '--out', str(tmp_path / 'a' / 'b'))

    assert done.exit_code == 0
    assert done.stdout == (tmp_path / 'a' / 'b' / 'matching.md').read_text()
    assert 'Map corner (not metric), 4 images:' in done.stdout
    assert '| nn-ratio |' in done.stdout
    content = json.loads((tmp_path / 'a' / 'b' / 'matching.json').read_text())
    (only,) = content['maps']
    assert list(only['matchers']) == ['nn-ratio', 'nn-cross', TRUE_CANDIDATES]
    for score in only['matchers'].values():
        assert score['precision'] > 0.5
        assert score['recall'] > 0.5
        assert score['poses'] == 1.0
        assert score['position_permille'] < 20.0


def test_maps_and_images_are_given_in_pairs(corner: Corner) -> None:
    twice = run(*corner.arguments, *corner.arguments, *HANDCRAFTED, '--every', '2')

    assert twice.exit_code == 0
    assert 'Mean over 2 maps:' in twice.stdout
    assert twice.stdout.count('Map corner (not metric), 2 images:') == 2


def test_keypoints_can_be_fewer_than_in_the_map(corner: Corner, tmp_path: Path) -> None:
    done = run(
        *(*corner.arguments, '--matcher', 'nn-cross', '--keypoints', '50'),
        *('--out', str(tmp_path)),
    )

    assert done.exit_code == 0
    content = json.loads((tmp_path / 'matching.json').read_text())
    assert content['keypoints'] == 50
    assert 0 < content['maps'][0]['matchers']['nn-cross']['matches'] <= 50


def test_draws_the_figure_over_k(corner: Corner, tmp_path: Path) -> None:
    done = run(
        *(*corner.arguments, '--matcher', 'nn-ratio', '--every', '4'),
        *('--neighbours', 'bmnet', '--out', str(tmp_path)),
    )

    assert done.exit_code == 0
    assert (tmp_path / 'neighbours.png').is_file()
    curves = json.loads((tmp_path / 'matching.json').read_text())['neighbours']
    assert curves['matcher'] == 'bmnet'
    every_neighbour, by_ratio = curves['mean']['kNN'], curves['mean']['kNN ratio']
    assert len(every_neighbour) == len(by_ratio) == 8
    # the nearest neighbour is a candidate at any ratio
    assert every_neighbour[0] == by_ratio[0]
    assert every_neighbour[7] != by_ratio[7]


def test_same_command_gives_the_same_bytes(corner: Corner, tmp_path: Path) -> None:
    for name in ('once', 'again'):
        assert run(*corner.arguments, *HANDCRAFTED, '--out', str(tmp_path / name)).exit_code == 0
    once, again = ((tmp_path / name / 'matching.json').read_bytes() for name in ('once', 'again'))
    assert once == again


@pytest.mark.parametrize(
    'arguments',
    [
        ('--matcher', 'magic'),
        ('--neighbours', 'bmnet'),
        ('--neighbours', 'nn-ratio', '--out', 'OUT'),
        ('--map', 'MAP'),
        ('--images', 'IMAGES'),
        ('--map', 'MAP', '--images', 'OUT/nowhere'),
        ('--out', 'MAP/manifest.yaml'),
    ],
)
def test_arguments_that_cannot_be_used_are_usage_errors(
    corner: Corner, tmp_path: Path, arguments: tuple[str, ...]
) -> None:
    places = {'MAP': str(corner.path), 'IMAGES': str(corner.images), 'OUT': str(tmp_path / 'out')}
    words = []
    for argument in arguments:
        head, *rest = argument.split('/')
        words.append('/'.join([places.get(head, head), *rest]))

    done = run(*corner.arguments, *HANDCRAFTED, *words)

    assert isinstance(done.exception, UsageError)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    'arguments', [('--keypoints', '0'), ('--every', '0'), ('--every', 'x'), ('--map',)]
)
def test_impossible_values_exit_with_2(corner: Corner, arguments: tuple[str, ...]) -> None:
    assert run(*corner.arguments, *arguments).exit_code == 2


def test_maps_are_required() -> None:
    assert run().exit_code == 2


def test_a_folder_that_is_no_map_is_a_map_error(corner: Corner) -> None:
    done = run('--map', str(corner.images), '--images', str(corner.images), *HANDCRAFTED)
    assert isinstance(done.exception, MapError)


def test_a_map_without_model_is_a_map_error(corner: Corner, tmp_path: Path) -> None:
    bare = tmp_path / 'bare'
    _save_without_model(corner.path, bare)
    done = run('--map', str(bare), '--images', str(corner.images), *HANDCRAFTED)
    assert isinstance(done.exception, MapError)
    assert SFM in str(done.exception)


def test_other_images_are_an_image_error(corner: Corner, tmp_path: Path) -> None:
    first, second, *_ = sorted(path.name for path in corner.images.iterdir())
    shutil.copytree(corner.images, tmp_path / 'images')
    shutil.copy(corner.images / first, tmp_path / 'images' / second)
    done = run('--map', str(corner.path), '--images', str(tmp_path / 'images'), *HANDCRAFTED)
    assert isinstance(done.exception, ImageError)
    assert second in str(done.exception)


def _save_without_model(path: Path, bare: Path) -> None:
    scene_map = load_map(path)
    sfm_from_map = scene_map.manifest.frame.map_from_sfm.inverse()
    content = MapContent(
        image_names=scene_map.image_names,
        camera_from_sfm=tuple(
            sfm_from_map.transform_camera_world(pose) for pose in scene_map.camera_from_map
        ),
        points=sfm_from_map * scene_map.points,
        descriptors=scene_map.descriptors,
        observation_offsets=scene_map.observation_offsets,
        observation_points=scene_map.observation_points,
        global_descriptors=scene_map.global_descriptors,
        codebook=scene_map.codebook,
    )
    save_map(bare, content, scene_map.manifest, None)
