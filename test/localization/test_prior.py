# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What is known beforehand: hints and directions that can be used, and the tilt of a pose."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from synthetic_place import looking

from gam_relocalizer.errors import UsageError
from gam_relocalizer.geometry import rigid3d_from
from gam_relocalizer.localization.prior import Gravity, PositionHint, tilt_deg

UP_OF_A_LEVEL_CAMERA = np.array([0.0, -1.0, 0.0])


def some_place() -> np.ndarray:
    return np.array([1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    'position', [[1.0, 2.0], [[1.0, 2.0, 3.0]], [1.0, np.nan, 3.0], [1.0, 2.0, np.inf], 'xyz', None]
)
def test_hint_without_a_position_is_refused(position: object) -> None:
    with pytest.raises(UsageError):
        PositionHint(position, 1.0)


@pytest.mark.parametrize('radius', [-1.0, -np.inf, np.nan])
def test_hint_without_a_radius_is_refused(radius: float) -> None:
    with pytest.raises(UsageError):
        PositionHint(some_place(), radius)


@pytest.mark.parametrize('radius', [0.0, 1, np.inf])
def test_radius_may_be_anything_from_nothing_to_everything(radius: float) -> None:
    assert PositionHint(some_place(), radius).radius == radius


def test_hint_keeps_its_position_when_the_array_given_changes() -> None:
    given_position = some_place()
    hint = PositionHint(given_position, 1.0)
    given_position[:] = 0.0
    np.testing.assert_array_equal(hint.position, some_place())


@pytest.mark.parametrize(
    'up', [[0.0, 0.0, 0.0], [0.0, 1.0], [np.nan, 0.0, 1.0], [np.inf, 0.0, 0.0], 'up']
)
def test_gravity_without_a_direction_is_refused(up: object) -> None:
    with pytest.raises(UsageError):
        Gravity(up, 10.0)


@pytest.mark.parametrize('tolerance_deg', [-1.0, 181.0, np.nan, np.inf])
def test_tolerance_that_is_no_angle_is_refused(tolerance_deg: float) -> None:
    with pytest.raises(UsageError):
        Gravity(UP_OF_A_LEVEL_CAMERA, tolerance_deg)


@pytest.mark.parametrize('length', [1e-300, 9.81, 1e300])
def test_up_becomes_a_unit_vector_whatever_its_length(length: float) -> None:
    gravity = Gravity(length * np.array([0.6, -0.8, 0.0]), 10.0)
    np.testing.assert_allclose(gravity.up_in_camera, [0.6, -0.8, 0.0])


@given(
    yaw=st.floats(-np.pi, np.pi),
    pitch_deg=st.floats(-90.0, 90.0),
    position=st.tuples(*[st.floats(-100.0, 100.0)] * 3),
)
def test_tilt_is_the_pitch_wherever_the_camera_is_and_looks(
    yaw: float, pitch_deg: float, position: tuple[float, float, float]
) -> None:
    camera_from_map = looking(yaw, np.array(position), np.radians(pitch_deg))
    tilt = tilt_deg(camera_from_map, Gravity(UP_OF_A_LEVEL_CAMERA, 5.0))
    assert tilt == pytest.approx(abs(pitch_deg), abs=1e-6)


def test_upside_down_is_tilted_by_half_a_turn() -> None:
    rolled = rigid3d_from([0.0, 0.0, 0.0, 1.0], [0.0] * 3) * looking(0.3, some_place())
    assert tilt_deg(rolled, Gravity(UP_OF_A_LEVEL_CAMERA, 5.0)) == pytest.approx(180.0)
