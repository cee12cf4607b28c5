# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Right or silent: whatever is held in front of the camera, no wrong pose is accepted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest

from gam_relocalizer.demo import recording, trajectories
from gam_relocalizer.demo.adversarial_worlds import (
    along_views,
    bay_views,
    corridor_walk,
    corridor_world,
    end_views,
    picture_views,
)
from gam_relocalizer.demo.renderer import Renderer
from gam_relocalizer.demo.shipped import demo_map_path
from gam_relocalizer.demo.world import demo_world, tiny_world
from gam_relocalizer.errors import MapError
from gam_relocalizer.evaluation.adversaries import (
    ADVERSARIES,
    View,
    another_building,
    is_false_accept,
    with_mixed_up_descriptors,
)
from gam_relocalizer.evaluation.exact_map import KnownImage, save_exact_map
from gam_relocalizer.features.registry import create_extractor
from gam_relocalizer.localization.localizer import Localizer
from gam_relocalizer.matching.registry import create_matcher
from gam_relocalizer.scene_map import load_map

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from tiny_place import TinyPlace

    from gam_relocalizer.features.local import LocalExtractor
    from gam_relocalizer.localization.result import LocalizationResult
    from gam_relocalizer.matching.matcher import Matcher

METRE = 1.0
KEYPOINTS = 1024
SMALL_CAMERA = pycolmap.Camera(
    camera_id=1, model='PINHOLE', width=480, height=360, params=[322.0, 322.0, 241.0, 178.5]
)


@dataclass(frozen=True)
class Networks:
    """What localizers of all maps share."""

    extractor: LocalExtractor
    matcher: Matcher

    def localizer(self, map_path: Path) -> Localizer:
        return Localizer(load_map(map_path), self.extractor, self.matcher)


@dataclass(frozen=True)
class Corridor:
    """A corridor of identical doors, its map, and views of it."""

    localizer: Localizer
    bays: tuple[View, ...]
    ends: tuple[View, ...]
    along: tuple[View, ...]


@pytest.fixture(scope='module')
def networks() -> Networks:
    return Networks(create_extractor('xfeat', KEYPOINTS), create_matcher('gam', extractor='xfeat'))


@pytest.fixture(scope='module')
def room(networks: Networks, tiny_place: TinyPlace) -> Localizer:
    return networks.localizer(tiny_place.map_path)


@pytest.fixture(scope='module')
def demo(networks: Networks) -> Localizer:
    return networks.localizer(demo_map_path())


@pytest.fixture(scope='module')
def room_views(tiny_place: TinyPlace) -> tuple[View, ...]:
    """What the robot sees on its drive, every time the same three images."""
    chosen = tiny_place.queries[:: max(1, len(tiny_place.queries) // 3)][:3]
    return tuple(View(image, tiny_place.camera, pose) for image, pose in chosen)


@pytest.fixture(scope='module')
def pictures() -> tuple[View, ...]:
    """Views of the room's pictures, so close that nothing else is seen."""
    world, camera = tiny_world(), recording.robot_camera()
    renderer = Renderer(world, recording.mapping_appearance(world))
    return rendered(renderer, camera, picture_views(world, camera, np.random.default_rng(0)))


@pytest.fixture(scope='module')
def corridor(networks: Networks, tmp_path_factory: pytest.TempPathFactory) -> Corridor:
    world, path = corridor_world(bays=4), tmp_path_factory.mktemp('corridor') / 'map'
    renderer = Renderer(world, recording.mapping_appearance(world))
    walk = corridor_walk(world, spacing=0.9)
    images = [known_image(renderer, view, seed) for seed, view in enumerate(walk)]
    save_exact_map(path, images, SMALL_CAMERA, networks.extractor)
    rng = np.random.default_rng(1)
    bays, ends, along = (
        rendered(renderer, SMALL_CAMERA, make(world, 6, rng))
        for make in (bay_views, end_views, along_views)
    )
    return Corridor(networks.localizer(path), bays, ends, along)


def known_image(renderer: Renderer, view: pycolmap.Rigid3d, seed: int) -> KnownImage:
    image = renderer.render(SMALL_CAMERA, [view], seed)
    return KnownImage(image, renderer.depth(SMALL_CAMERA, view), view)


def rendered(
    renderer: Renderer, camera: pycolmap.Camera, views: Sequence[pycolmap.Rigid3d]
) -> tuple[View, ...]:
    return tuple(
        View(renderer.render(camera, [view], 1000 + seed), camera, view)
        for seed, view in enumerate(views)
    )


def false_accepts(localizer: Localizer, views: Iterable[View]) -> list[str]:
    """Reasons of the poses that are accepted and wrong."""
    results = [(localizer.localize(view.image, view.camera), view) for view in views]
    return [result.reason for result, view in results if is_false(result, view)]


def is_false(result: LocalizationResult, view: View) -> bool:
    return result.accepted and is_false_accept(
        result.estimate.camera_from_map, view.camera_from_map, METRE
    )


def rightly_accepted(localizer: Localizer, views: Sequence[View]) -> float:
    """Share of the views that are accepted; none of them may be wrong."""
    results = [localizer.localize(view.image, view.camera) for view in views]
    assert not any(map(is_false, results, views))
    return float(np.mean([result.accepted for result in results]))


def test_views_as_they_are_are_accepted(room: Localizer, tiny_place: TinyPlace) -> None:
    views = [View(image, tiny_place.camera, pose) for image, pose in tiny_place.queries]
    assert rightly_accepted(room, views) >= 0.8


@pytest.mark.parametrize('name', ADVERSARIES)
def test_spoilt_views_lead_to_no_wrong_pose(
    room: Localizer, room_views: tuple[View, ...], name: str
) -> None:
    spoilt = [
        ADVERSARIES[name](view, np.random.default_rng(seed)) for seed, view in enumerate(room_views)
    ]
    assert not false_accepts(room, spoilt)


def test_a_map_with_mixed_up_descriptors_leads_to_no_wrong_pose(
    room: Localizer, networks: Networks, room_views: tuple[View, ...]
) -> None:
    mixed_up = with_mixed_up_descriptors(room.scene_map, np.random.default_rng(0))
    spoilt = Localizer(mixed_up, networks.extractor, networks.matcher)
    assert not false_accepts(spoilt, room_views)


def test_another_building_is_not_this_one(
    room: Localizer, demo: Localizer, corridor: Corridor, room_views: tuple[View, ...]
) -> None:
    """Other rooms have the same kinds of walls, and some have the same portraits."""
    in_corridor = [corridor.bays[0], corridor.ends[0], corridor.along[0]]
    for localizer, views in (
        (room, in_corridor),
        (demo, [*in_corridor, *room_views]),
        (corridor.localizer, room_views),
    ):
        assert not false_accepts(localizer, map(another_building, views))


def test_a_map_of_another_extractor_is_refused(networks: Networks, tmp_path: Path) -> None:
    world = tiny_world()
    renderer = Renderer(world, recording.mapping_appearance(world))
    walk = trajectories.mapping_views(world.mapping_route, spacing=0.3)[:6:3]
    images = [known_image(renderer, view, seed) for seed, view in enumerate(walk)]
    save_exact_map(tmp_path / 'sift', images, SMALL_CAMERA, create_extractor('sift', KEYPOINTS))
    with pytest.raises(MapError, match='sift'):
        networks.localizer(tmp_path / 'sift')


def test_a_map_of_other_weights_is_refused(room: Localizer, networks: Networks) -> None:
    manifest = room.scene_map.manifest
    other = replace(manifest, extractor=replace(manifest.extractor, weights_sha256=64 * '0'))
    with pytest.raises(MapError, match='xfeat'):
        Localizer(replace(room.scene_map, manifest=other), networks.extractor, networks.matcher)


def test_identical_doors_are_not_told_apart(corridor: Corridor) -> None:
    assert not false_accepts(corridor.localizer, corridor.bays)


def test_views_along_identical_doors_lead_to_no_wrong_pose(corridor: Corridor) -> None:
    assert not false_accepts(corridor.localizer, corridor.along)


def test_ends_of_a_corridor_of_identical_doors_are_known(corridor: Corridor) -> None:
    assert rightly_accepted(corridor.localizer, corridor.ends) >= 0.8


def test_rooms_with_moved_furniture_are_known(demo: Localizer) -> None:
    world = demo_world(rearranged=True)
    drive = trajectories.drive(world.drive_route)
    poses = [drive.camera_from_map(t) for t in np.linspace(3.0, drive.duration - 3.0, 5)]
    renderer = Renderer(world, recording.drive_appearance(world))
    views = rendered(renderer, recording.robot_camera(), poses)
    assert rightly_accepted(demo, views) >= 0.8


def test_a_single_picture_leads_to_no_wrong_pose(
    room: Localizer, pictures: tuple[View, ...]
) -> None:
    assert not false_accepts(room, pictures)


def test_a_picture_that_also_hangs_in_another_building_leads_nowhere(
    demo: Localizer, pictures: tuple[View, ...]
) -> None:
    assert not false_accepts(demo, map(another_building, pictures))
