# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`gam_relocalizer evaluate` on a map of a few rendered images."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pycolmap
import pytest
from corner_room import CAMERA, CornerRoom, looking_into_the_corner, write_room_images
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from gam_relocalizer.cameras import format_camera
from gam_relocalizer.cli.main import app
from gam_relocalizer.errors import (
    CameraError,
    ImageError,
    MapError,
    PosesFileError,
    UsageError,
)
from gam_relocalizer.evaluation.localization_report import DEFAULT_MATCHERS
from gam_relocalizer.evaluation.matching import TRUE_CANDIDATES
from gam_relocalizer.geometry import write_poses
from gam_relocalizer.image_set import ImageSet
from gam_relocalizer.mapping.build import MapBuildOptions, build_map
from gam_relocalizer.scene_map import SFM, load_content, load_map, save_map

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
    images = ImageSet.of_folder(folder / 'images', CAMERA, poses, metric=False)
    build_map(images, folder / 'corner', MapBuildOptions(max_keypoints=300))
    return Corner(folder / 'corner', folder / 'images')


@dataclass(frozen=True)
class Queries:
    """Images between those of the corner's map, in its frame and, by another unit, in a world."""

    images: Path
    truth: Path
    truth_in_world: Path
    reference_in_world: Path


WORLD_FROM_MAP = pycolmap.Sim3d(
    scale=2.0,
    rotation=pycolmap.Rotation3d(Rotation.from_euler('xyz', [0.1, 2.0, -0.7]).as_quat()),
    translation=np.array([5.0, 6.0, 7.0]),
)


@pytest.fixture(scope='module')
def queries(corner: Corner, tmp_path_factory: pytest.TempPathFactory) -> Queries:
    folder = tmp_path_factory.mktemp('queries')
    (folder / 'images').mkdir()
    room, truth = CornerRoom(), {}
    for index, step in enumerate((0.4, 0.6)):
        truth[f'{index}.png'] = looking_into_the_corner(step)
        image = cv2.cvtColor(room.render(truth[f'{index}.png']), cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(folder / 'images' / f'{index}.png'), image)
    scene_map = load_map(corner.path)
    reference = dict(zip(scene_map.image_names, scene_map.camera_from_map, strict=True))
    found = Queries(*(folder / name for name in ('images', 'truth', 'in_world', 'reference')))
    write_poses(found.truth, truth)
    write_poses(found.truth_in_world, _in_world(truth))
    write_poses(found.reference_in_world, _in_world(reference))
    return found


def _in_world(poses: dict[str, pycolmap.Rigid3d]) -> dict[str, pycolmap.Rigid3d]:
    return {name: WORLD_FROM_MAP.transform_camera_world(pose) for name, pose in poses.items()}


def run(*arguments: str) -> Result:
    return CliRunner().invoke(app, ['evaluate', 'matching', *arguments])


def localize(
    corner: Corner, queries: Queries, *arguments: str, truth: Path | None = None
) -> Result:
    given = ('--map', corner.path, '--queries', queries.images, '--truth', truth or queries.truth)
    return CliRunner().invoke(
        app, ['evaluate', 'localization', *(str(word) for word in given), *arguments]
    )


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


def test_localization_prints_tables_and_writes_the_same(
    corner: Corner, queries: Queries, tmp_path: Path
) -> None:
    out = tmp_path / 'a' / 'b'
    done = localize(corner, queries, *HANDCRAFTED, '--out', str(out))

    assert done.exit_code == 0
    assert done.stdout == (out / 'localization.md').read_text()
    assert 'Map corner (not metric), R = 10, 2 queries:' in done.stdout
    content = json.loads((out / 'localization.json').read_text())
    (only,) = content['sets']
    assert [(one['name'], one['matcher']) for one in only['methods']] == [
        ('SR1', 'nn-ratio'),
        ('SR1', 'nn-cross'),
        ('IR', 'nn-cross'),
        ('CC', 'nn-cross'),
        ('SR', 'nn-cross'),
    ]
    for method in only['methods']:
        assert method['found']['localized'] == 2
        assert method['found']['median_position'] < 0.05
        assert method['found']['median_rotation_deg'] < 1.0
    assert only['retrieval']['recall'][0] == 1.0


def test_localization_compares_the_matchers_of_the_paper(corner: Corner, queries: Queries) -> None:
    done = localize(corner, queries)
    assert done.exit_code == 0
    for name in DEFAULT_MATCHERS:
        assert f'| SR1 | {name} |' in done.stdout
    assert '| CC | gam |' in done.stdout


def test_localization_in_the_frame_of_a_reference(
    corner: Corner, queries: Queries, tmp_path: Path
) -> None:
    in_map, in_world = tmp_path / 'map', tmp_path / 'world'
    nearest = ('--matcher', 'nn-ratio')
    localize(corner, queries, *nearest, '--out', str(in_map))
    done = localize(
        *(corner, queries, *nearest, '--reference', str(queries.reference_in_world)),
        *('--out', str(in_world)),
        truth=queries.truth_in_world,
    )

    assert done.exit_code == 0
    assert 'laid over the reference' in done.stdout
    near, far = (
        json.loads((folder / 'localization.json').read_text())['sets'][0]['methods'][0]['found']
        for folder in (in_map, in_world)
    )
    assert far['median_position'] == pytest.approx(2.0 * near['median_position'], rel=1e-3)
    assert far['median_rotation_deg'] == pytest.approx(near['median_rotation_deg'], rel=1e-2)


def test_sets_are_given_together(corner: Corner, queries: Queries) -> None:
    camera = ('--camera', format_camera(CAMERA))
    second = ('--map', corner.path, '--queries', queries.images, '--truth', queries.truth)
    twice = localize(
        *(corner, queries, *map(str, second), *camera, *camera),
        *('--matcher', 'nn-ratio', '--retrieved', '1'),
    )
    assert twice.exit_code == 0
    assert 'Mean over 2 sets:' in twice.stdout
    assert twice.stdout.count('Map corner (not metric), R = 1, 2 queries:') == 4


@pytest.mark.parametrize(
    ('arguments', 'error'),
    [
        (('--map', 'MAP'), UsageError),
        (('--queries', 'IMAGES'), UsageError),
        (('--truth', 'TRUTH'), UsageError),
        (('--camera', 'FISHEYE', '--camera', 'FISHEYE'), UsageError),
        (('--reference', 'TRUTH', '--reference', 'TRUTH'), UsageError),
        (('--reference', 'TRUTH'), UsageError),
        (('--reference', 'IMAGES'), PosesFileError),
        (('--camera', 'nonsense'), CameraError),
        (('--camera', 'PINHOLE 640 480 500 500 320 240'), CameraError),
        (('--matcher', 'magic'), UsageError),
        (('--global-weights', 'TRUTH'), UsageError),
        (('--out', 'TRUTH'), UsageError),
    ],
)
def test_localization_refuses_what_does_not_fit_together(
    corner: Corner, queries: Queries, arguments: tuple[str, ...], error: type[Exception]
) -> None:
    places = {
        'MAP': str(corner.path),
        'IMAGES': str(queries.images),
        'TRUTH': str(queries.truth),
        'FISHEYE': 'OPENCV_FISHEYE 384 288 340 340 192 144 0 0 0 0',
    }
    words = [places.get(argument, argument) for argument in arguments]
    done = localize(corner, queries, '--matcher', 'nn-ratio', *words)
    assert isinstance(done.exception, error)


def _save_without_model(path: Path, bare: Path) -> None:
    manifest, content = load_content(path)
    save_map(bare, content, manifest, None)
