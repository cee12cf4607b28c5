# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Maps that are built, and searched, by NetVLAD."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from corner_room import CAMERA, CornerRoom, looking_into_the_corner
from netvlad_file import NO_FEATURES, random_layers, write_netvlad_file
from typer.testing import CliRunner

from gam_relocalizer.cameras import format_camera
from gam_relocalizer.cli.map import app
from gam_relocalizer.errors import MapError, UsageError, WeightsError
from gam_relocalizer.features.netvlad import NetVlad
from gam_relocalizer.geometry import pose_error
from gam_relocalizer.images import read_image
from gam_relocalizer.localization.localizer import Localizer, LocalizerOptions
from gam_relocalizer.scene_map import load_map, sha256_of

if TYPE_CHECKING:
    from click.testing import Result
    from conftest import Room

RUNNER = CliRunner()
SHIPPED_MAP = Path(__file__).parents[2] / 'maps' / 'demo'


@pytest.fixture(scope='module')
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_netvlad_file(tmp_path_factory.mktemp('weights') / 'netvlad.mat')


@pytest.fixture(scope='module')
def other_weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp('weights') / 'other.mat'
    return write_netvlad_file(path, random_layers(seed=1))


@pytest.fixture(scope='module')
def netvlad_map(room: Room, weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built by the command, from images, camera and poses."""
    path = tmp_path_factory.mktemp('maps') / 'netvlad'
    done = build(room, path, '--global', 'netvlad', '--global-weights', str(weights))
    assert done.exit_code == 0, done.output
    return path


def build(room: Room, out: Path, *arguments: str) -> Result:
    poses = str(room.images.parent / 'poses.txt')
    given = ['--images', str(room.images), '--out', str(out), '--camera', format_camera(CAMERA)]
    options = ['--poses', poses, '--max-keypoints', '600', *arguments]
    return RUNNER.invoke(app, ['build', *given, *options])


def load(path: Path, weights: Path | None) -> Localizer:
    options = LocalizerOptions(
        retrieved_images=1, max_scenes=1, max_keypoints=600, global_weights=weights
    )
    return Localizer.load(path, options)


def test_a_map_remembers_the_weights_and_what_they_made_of_its_images(
    room: Room, netvlad_map: Path, weights: Path
) -> None:
    scene_map, net = load_map(netvlad_map), NetVlad.load(weights)

    assert scene_map.manifest.retrieval == 'netvlad'
    assert scene_map.manifest.retrieval_weights_sha256 == sha256_of(weights)
    for index, name in enumerate(scene_map.image_names):
        described = net.describe(read_image(room.images / name), NO_FEATURES)
        # the bundle keeps four bits of each number
        assert scene_map.likeness(described)[index] == pytest.approx(1.0, abs=0.01)


def test_info_tells_the_weights(netvlad_map: Path, weights: Path) -> None:
    done = RUNNER.invoke(app, ['info', str(netvlad_map)])

    assert 'netvlad' in done.stdout
    assert sha256_of(weights)[:12] in done.stdout


def test_images_are_looked_for_where_netvlad_finds_them(netvlad_map: Path, weights: Path) -> None:
    localizer, net, room = load(netvlad_map, weights), NetVlad.load(weights), CornerRoom()
    scene_map = localizer.scene_map
    scenes = []
    for step in (0.05, 0.9):
        image, truth = room.render(looking_into_the_corner(step)), looking_into_the_corner(step)

        result = localizer.localize(image, CAMERA)

        described = net.describe(image, NO_FEATURES)
        best = int(scene_map.likeness(described).argmax())
        assert result.scene == scene_map.image_names[best]
        assert result.accepted
        assert pose_error(result.estimate.camera_from_map, truth).position < 0.1
        scenes.append(result.scene)
    assert len(set(scenes)) > 1


def test_a_map_is_refused_without_the_very_weights_that_it_was_built_with(
    netvlad_map: Path, weights: Path, other_weights: Path
) -> None:
    expected = sha256_of(weights)
    with pytest.raises(MapError, match=rf'{expected}.*--global-weights'):
        load(netvlad_map, None)
    with pytest.raises(MapError, match=rf'{expected}.*{sha256_of(other_weights)}'):
        load(netvlad_map, other_weights)
    with pytest.raises(WeightsError, match=r'nowhere\.mat'):
        load(netvlad_map, weights.with_name('nowhere.mat'))


def test_a_map_of_a_release_that_knew_vlad_alone_is_searched_by_vlad(weights: Path) -> None:
    load(SHIPPED_MAP, None)
    with pytest.raises(UsageError, match='vlad'):
        load(SHIPPED_MAP, weights)


@pytest.mark.parametrize(
    ('arguments', 'error'),
    [
        (['--global', 'netvlad'], UsageError),
        (['--global', 'bag-of-words'], UsageError),
        (['--global-weights', 'netvlad.mat'], UsageError),
        (['--global', 'netvlad', '--global-weights', 'nowhere.mat'], WeightsError),
    ],
)
def test_what_cannot_be_built_is_refused_before_the_work(
    room: Room, tmp_path: Path, arguments: list[str], error: type[Exception]
) -> None:
    done = build(room, tmp_path / 'map', *arguments)

    assert isinstance(done.exception, error)
    assert not list(tmp_path.iterdir())
