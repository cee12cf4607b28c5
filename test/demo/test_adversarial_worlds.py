# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from gam_relocalizer.demo.adversarial_worlds import (
    BAY,
    WIDTH,
    along_views,
    bay_views,
    corridor_walk,
    corridor_world,
    end_views,
    picture_views,
    random_views,
)
from gam_relocalizer.demo.recording import mapping_appearance
from gam_relocalizer.demo.renderer import Appearance, Renderer
from gam_relocalizer.demo.world import ROOM_HEIGHT, ROOMS, World

BAYS = 5
LENGTH = BAYS * BAY


@pytest.fixture(scope='module')
def corridor() -> World:
    return corridor_world(bays=BAYS)


def without_ends(world: World) -> World:
    """The corridor with nothing but the dark at its ends."""
    quads = tuple(
        quad
        for quad in world.quads
        if quad.corners[:, 0].max() > 0.1 and quad.corners[:, 0].min() < LENGTH - 0.1
    )
    assert len(quads) < len(world.quads)
    return replace(world, quads=quads)


def rendered(
    world: World, camera: pycolmap.Camera, views: list[pycolmap.Rigid3d]
) -> list[np.ndarray]:
    # Lamps further off light bays unequally; what hangs there is to be the same.
    renderer = Renderer(world, Appearance(lights=(), ambient=(0.7, 0.7, 0.7)))
    return [renderer.render(camera, [view]).astype(float) for view in views]


def shifted(view: pycolmap.Rigid3d, x: float) -> pycolmap.Rigid3d:
    """The same camera further along the corridor."""
    back = pycolmap.Rigid3d(rotation=pycolmap.Rotation3d(), translation=np.array([-x, 0.0, 0.0]))
    return view * back


def about_the_middle(view: pycolmap.Rigid3d) -> pycolmap.Rigid3d:
    """The same camera after half a turn of the corridor about its middle."""
    half_turn = pycolmap.Rigid3d(
        rotation=pycolmap.Rotation3d(np.array([0.0, 0.0, 1.0, 0.0])),
        translation=np.array([LENGTH, WIDTH, 0.0]),
    )
    return view * half_turn


def test_every_bay_looks_like_the_next(corridor: World, small_camera: pycolmap.Camera) -> None:
    views = bay_views(corridor, 6, np.random.default_rng(0))
    # Towards the middle, where no end comes into view.
    steps = [BAY if view.tgt_origin_in_src()[0] < LENGTH / 2 else -BAY for view in views]
    next_views = [shifted(view, step) for view, step in zip(views, steps, strict=True)]
    there = rendered(corridor, small_camera, next_views)
    for one, other in zip(rendered(corridor, small_camera, views), there, strict=True):
        assert np.abs(one - other).mean() < 0.2


def test_both_sides_look_alike(corridor: World, small_camera: pycolmap.Camera) -> None:
    views = bay_views(corridor, 6, np.random.default_rng(1))
    turned = rendered(corridor, small_camera, [about_the_middle(view) for view in views])
    for one, other in zip(rendered(corridor, small_camera, views), turned, strict=True):
        assert np.abs(one - other).mean() < 0.2


def test_views_of_bays_show_no_end(corridor: World, small_camera: pycolmap.Camera) -> None:
    views = bay_views(corridor, 20, np.random.default_rng(2))
    dark = rendered(without_ends(corridor), small_camera, views)
    for one, other in zip(rendered(corridor, small_camera, views), dark, strict=True):
        np.testing.assert_allclose(one, other, atol=1.0)


def test_views_of_ends_and_along_show_one(corridor: World, small_camera: pycolmap.Camera) -> None:
    rng = np.random.default_rng(3)
    for views, share in ((end_views(corridor, 6, rng), 0.15), (along_views(corridor, 6, rng), 0.0)):
        dark = rendered(without_ends(corridor), small_camera, views)
        for one, other in zip(rendered(corridor, small_camera, views), dark, strict=True):
            assert (np.abs(one - other) > 1.0).any(axis=2).mean() > share


def test_the_ends_differ(corridor: World, small_camera: pycolmap.Camera) -> None:
    views = end_views(corridor, 4, np.random.default_rng(4))
    turned = rendered(corridor, small_camera, [about_the_middle(view) for view in views])
    for one, other in zip(rendered(corridor, small_camera, views), turned, strict=True):
        assert np.corrcoef(one.ravel(), other.ravel())[0, 1] < 0.8


def test_a_walk_maps_all_of_the_walls(corridor: World, small_camera: pycolmap.Camera) -> None:
    """Every place at the height of an eye, on both sides, is seen twice or more."""
    walk = corridor_walk(corridor, spacing=0.8)
    for y in (0.0, WIDTH):
        places = np.column_stack(
            [np.linspace(0.4, LENGTH - 0.4, 60), np.full(60, y), np.full(60, 1.4)]
        )
        in_cameras = np.stack([view * places for view in walk])
        pixels = np.stack([small_camera.img_from_cam(one) for one in in_cameras])
        inside = (pixels >= 0) & (pixels <= (small_camera.width, small_camera.height))
        seen = np.all(inside, axis=2) & (in_cameras[..., 2] > 0)
        assert seen.sum(axis=0).min() >= 2


def test_same_seed_gives_the_same_corridor(corridor: World) -> None:
    again, other = corridor_world(bays=BAYS), corridor_world(seed=1, bays=BAYS)
    for one, same in zip(corridor.textures, again.textures, strict=True):
        np.testing.assert_array_equal(one, same)
    assert any(
        one.shape != new.shape or (one != new).any()
        for one, new in zip(corridor.textures, other.textures, strict=True)
    )


def test_views_are_from_within(corridor: World, rooms: World) -> None:
    rng = np.random.default_rng(5)
    for make in (bay_views, end_views, along_views):
        for view in make(corridor, 50, rng):
            x, y, z = view.tgt_origin_in_src()
            assert 0.5 < x < LENGTH - 0.5
            assert 0.5 < y < WIDTH - 0.5
            assert 1.0 < z < ROOM_HEIGHT - 0.5
    west, east = min(room.x[0] for room in ROOMS), max(room.x[1] for room in ROOMS)
    south, north = min(room.y[0] for room in ROOMS), max(room.y[1] for room in ROOMS)
    places = np.array([view.tgt_origin_in_src() for view in random_views(rooms, 200, rng)])
    assert np.all((places[:, 0] > west) & (places[:, 0] < east))
    assert np.all((places[:, 1] > south) & (places[:, 1] < north))


def test_a_picture_is_all_that_is_seen_of_it(tiny: World, small_camera: pycolmap.Camera) -> None:
    views = picture_views(tiny, small_camera, np.random.default_rng(6))
    assert len(views) == 6
    renderer = Renderer(tiny, mapping_appearance(tiny))
    for view in views:
        depth = renderer.depth(small_camera, view)
        # A plane's inverse depth is linear in the pixel.
        rows, columns = np.indices(depth.shape)
        basis = np.stack([columns.ravel(), rows.ravel(), np.ones(depth.size)], axis=1)
        inverse = 1.0 / depth.ravel()
        off = inverse - basis @ np.linalg.lstsq(basis, inverse, rcond=None)[0]
        assert (np.abs(off) < 0.01 * inverse.mean()).mean() > 0.95
