# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from map_content import with_points
from recorded_drive import camera_from_map_at
from scipy.spatial.transform import Rotation

from gam_relocalizer.geometry import rigid3d_from_rotation
from gam_relocalizer.plots import View, png
from gam_relocalizer.replay.figures import trajectory_figure

if TYPE_CHECKING:
    from gam_relocalizer.scene_map import SceneMap


def turned(scene_map: SceneMap, turn: Rotation) -> SceneMap:
    """The same place in a map frame that is turned."""
    other_from_map = rigid3d_from_rotation(turn, np.zeros(3))
    poses = tuple(pose * other_from_map.inverse() for pose in scene_map.camera_from_map)
    return with_points(replace(scene_map, camera_from_map=poses), turn.apply(scene_map.points))


def test_upright_map_is_seen_along_its_own_axes(wall_map: SceneMap) -> None:
    view = View.from_above(wall_map)
    np.testing.assert_array_equal(view.axes, [[1, 0, 0], [0, 1, 0]])
    assert view.labels == ('x [m]', 'y [m]')


@given(st.tuples(*[st.floats(-180.0, 180.0)] * 3))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_map_in_any_frame_is_seen_from_above(
    wall_map: SceneMap, angles: tuple[float, float, float]
) -> None:
    turn = Rotation.from_euler('xyz', angles, degrees=True)
    view = View.from_above(turned(wall_map, turn))
    np.testing.assert_allclose(view.axes @ view.axes.T, np.eye(2), atol=1e-12)
    downward = -np.cross(*view.axes)
    tilt = np.arccos(np.clip(downward @ turn.apply([0.0, 0.0, -1.0]), -1.0, 1.0))
    assert np.degrees(tilt) < 30.0 + 1e-6


def test_map_without_images_is_seen_along_its_own_axes(wall_map: SceneMap) -> None:
    view = View.from_above(replace(wall_map, camera_from_map=()))
    np.testing.assert_array_equal(view.axes, np.eye(3)[:2])


def test_one_far_point_does_not_shrink_the_picture(wall_map: SceneMap) -> None:
    far = np.concatenate([wall_map.points, [[1e6, 1e6, 0.0]]])
    axes = trajectory_figure([], with_points(wall_map, far), View.from_above(wall_map)).axes[0]
    assert max(map(abs, axes.get_xlim())) < 10.0


def test_camera_that_knows_no_direction_up_is_no_failure(wall_map: SceneMap) -> None:
    opposite = pycolmap.Rigid3d(
        rotation=pycolmap.Rotation3d(Rotation.from_euler('x', 180, degrees=True).as_quat()),
        translation=np.zeros(3),
    )
    first = camera_from_map_at(0)
    pair = replace(wall_map, camera_from_map=(first, opposite * first))
    np.testing.assert_array_equal(View.from_above(pair).axes, np.eye(3)[:2])


@pytest.mark.parametrize('count', [0, 1, 200_000])
def test_any_number_of_points_makes_a_picture(wall_map: SceneMap, count: int) -> None:
    points = np.random.default_rng(0).normal(size=(count, 3))
    assert png(
        trajectory_figure([], with_points(wall_map, points), View.from_above(wall_map))
    ).startswith(b'\x89PNG')
