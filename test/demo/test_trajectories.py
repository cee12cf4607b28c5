# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from gam_relocalizer.demo.trajectories import BASE_FROM_CAMERA, Drive, drive, mapping_views
from gam_relocalizer.geometry import rotation_of

if TYPE_CHECKING:
    from gam_relocalizer.demo.world import World


@pytest.fixture(scope='module')
def tour(rooms: World) -> Drive:
    return drive(rooms.drive_route)


def _positions(tour: Drive, step: float = 0.05) -> np.ndarray:
    times = np.arange(0.0, tour.duration, step)
    return np.array([tour.map_from_base(float(t)).translation for t in times])


def _obstacles(world: World, low: float, high: float) -> cKDTree:
    """Points all over the surfaces that reach into a range of heights, seen from above."""
    u, v = (axis.ravel() for axis in np.meshgrid(np.linspace(0, 1, 40), np.linspace(0, 1, 40)))
    points = []
    for quad in world.quads:
        across, down = quad.corners[1] - quad.corners[0], quad.corners[3] - quad.corners[0]
        surface = quad.corners[0] + u[:, None] * across + v[:, None] * down
        points.append(surface[(surface[:, 2] > low) & (surface[:, 2] < high), :2])
    return cKDTree(np.vstack(points))


def test_drive_takes_about_a_minute_at_walking_pace(tour: Drive) -> None:
    assert 60.0 <= tour.duration <= 75.0
    speeds, turns = np.array(
        [tour.velocity(float(t)) for t in np.arange(0.0, tour.duration, 0.1)]
    ).T
    assert 0.4 < speeds.mean() < 0.6
    assert speeds.max() < 0.7
    assert np.abs(turns).max() < 1.0


def test_base_stays_on_the_floor_and_looks_where_it_drives(tour: Drive) -> None:
    for t in np.arange(1.0, tour.duration - 1.0, 0.7):
        map_from_base = tour.map_from_base(float(t))
        assert map_from_base.translation[2] == 0.0
        before = tour.map_from_base(float(t) - 0.05).translation
        after = tour.map_from_base(float(t) + 0.05).translation
        direction = rotation_of(map_from_base).inv().apply(after - before)
        assert abs(np.degrees(np.arctan2(direction[1], direction[0]))) < 6.0


def test_velocity_is_the_derivative_of_the_pose(tour: Drive) -> None:
    h = 1e-3
    for t in (5.0, 17.3, 40.1):
        before, after = tour.map_from_base(t - h), tour.map_from_base(t + h)
        moved = before.inverse() * after
        forward, turn_rate = tour.velocity(t)
        assert np.linalg.norm(moved.translation) / (2 * h) == pytest.approx(forward, rel=1e-3)
        yaw = rotation_of(moved).as_euler('ZYX')[0]
        assert yaw / (2 * h) == pytest.approx(turn_rate, abs=1e-3)


def test_pose_is_held_before_the_start_and_after_the_end(tour: Drive) -> None:
    start, end = tour.map_from_base(0.0), tour.map_from_base(tour.duration)
    np.testing.assert_array_equal(tour.map_from_base(-3.0).translation, start.translation)
    np.testing.assert_array_equal(
        tour.map_from_base(tour.duration + 3.0).translation, end.translation
    )


def test_camera_rides_on_the_base(tour: Drive) -> None:
    map_from_camera = tour.camera_from_map(12.0).inverse()
    expected = tour.map_from_base(12.0) * BASE_FROM_CAMERA
    np.testing.assert_allclose(map_from_camera.matrix(), expected.matrix(), atol=1e-12)


def test_mount_is_raised_and_looks_ahead_up_and_left() -> None:
    np.testing.assert_allclose(BASE_FROM_CAMERA.translation, (0.12, -0.05, 0.9))
    x, y, z = rotation_of(BASE_FROM_CAMERA).apply((0.0, 0.0, 1.0))
    assert np.degrees(np.arctan2(y, x)) == pytest.approx(15.0)
    assert np.degrees(np.arcsin(z)) == pytest.approx(10.0)
    right = rotation_of(BASE_FROM_CAMERA).apply((1.0, 0.0, 0.0))
    assert right[2] == pytest.approx(0.0, abs=1e-12)
    assert right[1] < 0


def test_drive_keeps_clear_of_walls_and_furniture(rooms: World, tour: Drive) -> None:
    distance, _ = _obstacles(rooms, 0.03, 1.3).query(_positions(tour)[:, :2])
    assert distance.min() > 0.28


def test_mapping_walk_keeps_clear_of_walls_and_furniture(rooms: World) -> None:
    views = mapping_views(rooms.mapping_route)
    places = np.array([view.tgt_origin_in_src()[:2] for view in views])
    distance, _ = _obstacles(rooms, 0.03, 1.8).query(places)
    assert distance.min() > 0.2


def test_mapping_walk_has_views_enough_but_not_too_many(rooms: World) -> None:
    assert 120 <= len(mapping_views(rooms.mapping_route)) <= 200


def test_drive_is_near_mapped_views_but_never_on_them(rooms: World, tour: Drive) -> None:
    views = mapping_views(rooms.mapping_route)
    centres = np.array([view.tgt_origin_in_src() for view in views])
    axes = np.array([rotation_of(view).inv().apply((0.0, 0.0, 1.0)) for view in views])
    for t in np.arange(0.0, tour.duration, 0.5):
        query = tour.camera_from_map(float(t))
        distance = np.linalg.norm(centres - query.tgt_origin_in_src(), axis=1)
        assert 0.2 < distance.min() < 1.2
        axis = rotation_of(query).inv().apply((0.0, 0.0, 1.0))
        alike = np.degrees(np.arccos(np.clip(axes @ axis, -1, 1))) < 40.0
        assert distance[alike].min() < 1.6


def test_views_of_a_stop_spread_over_the_full_circle(tiny: World) -> None:
    views = mapping_views(tiny.mapping_route, directions=3)
    for first in range(0, len(views), 3):
        axes = [rotation_of(view).inv().apply((0, 0, 1)) for view in views[first : first + 3]]
        yaws = np.degrees([np.arctan2(axis[1], axis[0]) for axis in axes])
        gaps = np.sort(np.mod(yaws - yaws[0], 360.0))
        np.testing.assert_allclose(gaps, (0.0, 120.0, 240.0), atol=3.0)


def test_mapping_camera_is_upright(tiny: World) -> None:
    for view in mapping_views(tiny.mapping_route):
        down = rotation_of(view).inv().apply((0.0, 1.0, 0.0))
        assert down[2] < -0.95
        assert Rotation.from_matrix(view.rotation.matrix()).magnitude() > 0.5
