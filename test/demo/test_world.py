# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from gam_relocalizer.demo.world import ROOM_HEIGHT, ROOMS, World, demo_world, tiny_world


def _corners(world: World) -> np.ndarray:
    return np.stack([quad.corners for quad in world.quads])


def test_quads_are_parallelograms_with_textures(rooms: World) -> None:
    corners = _corners(rooms)
    np.testing.assert_allclose(
        corners[:, 0] + corners[:, 2], corners[:, 1] + corners[:, 3], atol=1e-9
    )
    areas = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]), axis=1
    )
    assert areas.min() > 1e-6
    used = {quad.texture for quad in rooms.quads}
    assert used <= set(range(len(rooms.textures)))
    assert all(image.dtype == np.uint8 and image.shape[2] == 3 for image in rooms.textures)


def test_rooms_are_metric_with_z_up(rooms: World) -> None:
    corners = _corners(rooms).reshape(-1, 3)
    np.testing.assert_allclose(corners.min(axis=0)[:2], 0.0, atol=0.3)
    np.testing.assert_allclose(corners.max(axis=0), (14.0, 9.0, ROOM_HEIGHT), atol=0.3)


def test_floors_face_up_and_ceilings_down(rooms: World) -> None:
    corners = _corners(rooms)
    normals = np.cross(corners[:, 3] - corners[:, 0], corners[:, 1] - corners[:, 0])
    height = corners[:, :, 2]
    height[np.linalg.norm(normals, axis=1) < 10.0] = np.nan
    floors = np.all(height == 0.0, axis=1)
    ceilings = np.all(height == ROOM_HEIGHT, axis=1)
    assert floors.sum() == ceilings.sum() == len(ROOMS)
    assert np.all(normals[floors, 2] > 0)
    assert np.all(normals[ceilings, 2] < 0)


def test_walls_look_into_their_room() -> None:
    world = tiny_world()
    middle = np.array([2.0, 1.5, ROOM_HEIGHT / 2])
    # The shell comes first: four walls, the floor and the ceiling.
    for quad in world.quads[:6]:
        normal = np.cross(quad.corners[3] - quad.corners[0], quad.corners[1] - quad.corners[0])
        assert normal @ (middle - quad.corners[0]) > 0


def test_some_things_look_the_same_in_several_places(rooms: World) -> None:
    painting_places: dict[int, list[np.ndarray]] = {}
    for quad in rooms.quads:
        painting_places.setdefault(quad.texture, []).append(quad.corners.mean(axis=0))
    spread = [np.ptp(places, axis=0).max() for places in painting_places.values()]
    assert sum(distance > 3.0 for distance in spread) > 20


def test_same_seed_gives_the_same_world(tiny: World) -> None:
    again = tiny_world()
    np.testing.assert_array_equal(_corners(again), _corners(tiny))
    for one, other in zip(again.textures, tiny.textures, strict=True):
        np.testing.assert_array_equal(one, other)


def test_another_seed_gives_another_world(tiny: World) -> None:
    assert (_corners(tiny_world(seed=1)) != _corners(tiny)).any()


def test_rearranging_moves_loose_things_only(rooms: World) -> None:
    moved = demo_world(rearranged=True)
    assert len(moved.quads) == len(rooms.quads)
    for one, other in zip(moved.textures, rooms.textures, strict=True):
        np.testing.assert_array_equal(one, other)
    is_moved = np.any(_corners(moved) != _corners(rooms), axis=(1, 2))
    assert 0.2 < is_moved.mean() < 0.8
    sizes = np.ptp(_corners(rooms), axis=1).max(axis=1)
    assert sizes[is_moved].max() < 0.7


@pytest.mark.parametrize('route', ['drive_route', 'mapping_route'])
def test_routes_visit_every_room(rooms: World, route: str) -> None:
    points = getattr(rooms, route)
    for room in ROOMS:
        inside = (
            (points[:, 0] > room.x[0])
            & (points[:, 0] < room.x[1])
            & (points[:, 1] > room.y[0])
            & (points[:, 1] < room.y[1])
        )
        assert inside.sum() >= 3
