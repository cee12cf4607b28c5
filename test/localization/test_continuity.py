# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What one query tells the next: hints that move with the robot, gravity, and fixes held back."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gam_relocalizer.geometry import rigid3d_from, rigid3d_from_rotation
from gam_relocalizer.localization.continuity import (
    MAX_SPEED,
    MIN_HINT_RADIUS,
    Continuity,
    ContinuityOptions,
    is_odometry_of,
)
from gam_relocalizer.localization.prior import PositionHint, Prior
from gam_relocalizer.localization.result import LocalizationResult, Status
from gam_relocalizer.localization.robot_pose import RobotPose

if TYPE_CHECKING:
    import pycolmap

SECOND = 10**9
ACCEPTED = LocalizationResult(Status.ACCEPTED, 'good')
# optical frame (z forward, y down) at the height of a head, looking along the base's x axis
BASE_FROM_CAMERA = rigid3d_from((0.5, -0.5, 0.5, -0.5), (0.2, 0.0, 1.5))


def planar(x: float, y: float, yaw_deg: float = 0.0) -> pycolmap.Rigid3d:
    turn = Rotation.from_euler('z', yaw_deg, degrees=True)
    return rigid3d_from_rotation(turn, [x, y, 0.0])


def robot_at(map_from_base: pycolmap.Rigid3d, std: float = 0.01) -> RobotPose:
    return RobotPose(map_from_base, np.diag([std**2] * 6))


def fix(continuity: Continuity, second: float, map_from_base: pycolmap.Rigid3d) -> Status:
    """The verdict on a fix."""
    return continuity.judge(round(second * SECOND), ACCEPTED, robot_at(map_from_base)).status


def hint(
    continuity: Continuity, second: float, mount: pycolmap.Rigid3d | None = BASE_FROM_CAMERA
) -> PositionHint:
    found = continuity.prior(round(second * SECOND), mount).hint
    assert found is not None
    return found


def drive(continuity: Continuity, first: int, last: int, metres_per_second: float) -> None:
    """Odometry of a straight drive; it counts from elsewhere than the map does."""
    for tenth in range(10 * first, 10 * last + 1):
        odom_from_base = planar(5.0, 5.0, 90.0) * planar(metres_per_second * tenth / 10.0, 0.0)
        continuity.add_odometry(tenth * SECOND // 10, odom_from_base)


def test_nothing_is_known_before_the_first_fix() -> None:
    assert Continuity().prior(0, BASE_FROM_CAMERA) == Prior()


def test_the_hint_is_where_odometry_has_brought_the_camera_since_the_last_fix() -> None:
    continuity = Continuity()
    drive(continuity, 0, 10, 1.0)
    fix(continuity, 2.0, planar(-3.0, 0.0, 180.0))
    moved = hint(continuity, 6.0)
    np.testing.assert_allclose(moved.position, [-7.2, 0.0, 1.5], atol=1e-9)
    np.testing.assert_allclose(hint(continuity, 6.0, None).position, [-7.0, 0.0, 0.0], atol=1e-9)


def test_its_radius_grows_with_the_way() -> None:
    continuity = Continuity(ContinuityOptions(drift=0.5))
    drive(continuity, 0, 30, 2.0)
    fix(continuity, 0.0, planar(0.0, 0.0))
    assert hint(continuity, 0.5).radius == MIN_HINT_RADIUS
    assert hint(continuity, 10.0).radius > 10.0
    assert hint(continuity, 20.0).radius > hint(continuity, 10.0).radius


def test_without_odometry_the_hint_stays_and_its_radius_grows_with_time() -> None:
    continuity = Continuity()
    fix(continuity, 1.0, planar(4.0, 0.0))
    late = hint(continuity, 11.0)
    np.testing.assert_allclose(late.position, [4.2, 0.0, 1.5], atol=1e-9)
    assert late.radius >= MAX_SPEED * 10.0
    assert hint(continuity, 1.1).radius == MIN_HINT_RADIUS


@pytest.mark.parametrize('second', [0.0, 10.0])
def test_a_suggestion_is_the_hint_until_the_next_fix(second: float) -> None:
    """However long ago it was made: from the next image on."""
    continuity = Continuity()
    continuity.suggest(robot_at(planar(8.0, 0.0), std=2.0))
    suggested = hint(continuity, second)
    np.testing.assert_allclose(suggested.position, [8.2, 0.0, 1.5], atol=1e-9)
    assert suggested.radius == pytest.approx(3.0 * 2.0 * np.sqrt(3.0))
    fix(continuity, second + 1.0, planar(0.0, 0.0))
    np.testing.assert_allclose(hint(continuity, second + 1.0).position, [0.2, 0.0, 1.5], atol=1e-9)


def test_a_suggestion_is_carried_on_by_odometry() -> None:
    continuity = Continuity()
    drive(continuity, 0, 10, 1.0)
    continuity.suggest(robot_at(planar(8.0, 0.0)))
    hint(continuity, 2.0)
    np.testing.assert_allclose(hint(continuity, 5.0).position, [11.2, 0.0, 1.5], atol=1e-9)


def test_a_suggestion_has_no_say_in_which_fix_passes() -> None:
    continuity = Continuity()
    drive(continuity, 0, 10, 1.0)
    continuity.suggest(robot_at(planar(50.0, 0.0)))
    continuity.prior(0, None)
    assert fix(continuity, 0.0, planar(0.0, 0.0)) is Status.ACCEPTED
    continuity.suggest(robot_at(planar(50.0, 0.0)))
    continuity.prior(SECOND, None)
    assert fix(continuity, 1.0, planar(50.0, 0.0)) is Status.IMPLAUSIBLE
    assert fix(continuity, 2.0, planar(2.0, 0.0)) is Status.ACCEPTED


def test_a_fix_that_odometry_speaks_against_is_held_back_until_it_is_confirmed() -> None:
    continuity = Continuity()
    drive(continuity, 0, 10, 1.0)
    assert fix(continuity, 0.0, planar(0.0, 0.0)) is Status.ACCEPTED
    held = continuity.judge(2 * SECOND, ACCEPTED, robot_at(planar(32.0, 0.0)))
    assert held.status is Status.IMPLAUSIBLE
    assert '30.00 m' in held.reason
    assert continuity.prior(3 * SECOND, None).hint is None  # two places compete
    assert fix(continuity, 4.0, planar(34.0, 0.0)) is Status.ACCEPTED
    np.testing.assert_allclose(hint(continuity, 5.0, None).position, [35.0, 0.0, 0.0], atol=1e-9)


def test_without_odometry_at_its_time_a_fix_passes() -> None:
    continuity = Continuity()
    assert not continuity.misses_odometry(0)
    assert fix(continuity, 0.0, planar(0.0, 0.0)) is Status.ACCEPTED
    assert fix(continuity, 1.0, planar(50.0, 0.0)) is Status.ACCEPTED
    drive(continuity, 2, 10, 1.0)
    assert fix(continuity, 3.0, planar(0.0, 0.0)) is Status.ACCEPTED
    assert continuity.misses_odometry(20 * SECOND)
    assert fix(continuity, 20.0, planar(50.0, 0.0)) is Status.ACCEPTED


def test_odometry_whose_stamps_jump_back_starts_anew() -> None:
    continuity = Continuity()
    drive(continuity, 100, 110, 1.0)
    fix(continuity, 105.0, planar(0.0, 0.0))
    drive(continuity, 50, 60, 1.0)
    assert continuity.prior(55 * SECOND, None) == Prior()
    assert fix(continuity, 55.0, planar(70.0, 0.0)) is Status.ACCEPTED


def test_clearing_forgets_everything() -> None:
    continuity = Continuity()
    drive(continuity, 0, 10, 1.0)
    fix(continuity, 1.0, planar(0.0, 0.0))
    continuity.suggest(robot_at(planar(8.0, 0.0)))
    continuity.clear()
    assert continuity.prior(2 * SECOND, None) == Prior()
    assert not continuity.misses_odometry(2 * SECOND)
    assert fix(continuity, 2.0, planar(70.0, 0.0)) is Status.ACCEPTED


def test_in_a_map_without_metres_nothing_is_known() -> None:
    continuity = Continuity(ContinuityOptions(metric=False, max_tilt_deg=10.0))
    drive(continuity, 0, 10, 1.0)
    continuity.suggest(robot_at(planar(8.0, 0.0)))
    assert fix(continuity, 0.0, planar(0.0, 0.0)) is Status.ACCEPTED
    assert fix(continuity, 1.0, planar(50.0, 0.0)) is Status.ACCEPTED
    assert continuity.prior(2 * SECOND, BASE_FROM_CAMERA) == Prior()


def test_up_is_up_for_a_camera_on_a_level_base() -> None:
    gravity = Continuity(ContinuityOptions(max_tilt_deg=12.0)).prior(0, BASE_FROM_CAMERA).gravity
    assert gravity is not None
    np.testing.assert_allclose(gravity.up_in_camera, [0.0, -1.0, 0.0], atol=1e-12)
    assert gravity.tolerance_deg == 12.0


@given(st.floats(0.0, 179.0), st.floats(0.0, 360.0))
def test_a_base_that_leans_is_off_gravity_by_its_tilt(tilt_deg: float, azimuth: float) -> None:
    axis = [np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth)), 0.0]
    lean = Rotation.from_rotvec(np.multiply(tilt_deg, axis), degrees=True)
    map_from_camera = rigid3d_from_rotation(lean, np.zeros(3)) * BASE_FROM_CAMERA
    gravity = Continuity(ContinuityOptions(max_tilt_deg=12.0)).prior(0, BASE_FROM_CAMERA).gravity
    assert gravity is not None
    up_in_map = map_from_camera.rotation.matrix() @ gravity.up_in_camera
    assert np.degrees(np.arccos(np.clip(up_in_map[2], -1.0, 1.0))) == pytest.approx(
        tilt_deg, abs=1e-4
    )


def test_nothing_is_said_about_gravity_without_a_mount_or_a_limit() -> None:
    assert Continuity(ContinuityOptions(max_tilt_deg=12.0)).prior(0, None).gravity is None
    assert Continuity().prior(0, BASE_FROM_CAMERA).gravity is None


def test_odometry_counts_only_for_the_body_whose_poses_are_wanted() -> None:
    assert is_odometry_of('base_link', 'base_link')
    assert is_odometry_of('/base_link', 'base_link')
    assert is_odometry_of('', 'base_link')
    assert not is_odometry_of('camera', 'base_link')
    assert not is_odometry_of('', '')


def test_after_a_fix_the_pose_that_odometry_makes_of_it_is_expected() -> None:
    continuity = Continuity()
    drive(continuity, 0, 10, 1.0)
    fix(continuity, 2.0, planar(-3.0, 0.0, 180.0))
    expected = continuity.prior(6 * SECOND, BASE_FROM_CAMERA).expectation
    assert expected is not None
    moved = (planar(-7.0, 0.0, 180.0) * BASE_FROM_CAMERA).inverse()
    assert expected.agrees_with(moved)
    aside = (planar(-7.0, expected.position_margin + 0.01, 180.0) * BASE_FROM_CAMERA).inverse()
    assert not expected.agrees_with(aside)
    turned = (planar(-7.0, 0.0, 181.0 + expected.rotation_margin_deg) * BASE_FROM_CAMERA).inverse()
    assert not expected.agrees_with(turned)


def test_nothing_is_expected_without_a_fix_and_odometry_and_the_mount() -> None:
    continuity = Continuity()
    fix(continuity, 0.0, planar(0.0, 0.0))
    assert continuity.prior(SECOND, BASE_FROM_CAMERA).expectation is None
    drive(continuity, 0, 10, 1.0)
    assert continuity.prior(SECOND, BASE_FROM_CAMERA).expectation is None
    fix(continuity, 2.0, planar(2.0, 0.0))
    assert continuity.prior(3 * SECOND, None).expectation is None
    assert continuity.prior(3 * SECOND, BASE_FROM_CAMERA).expectation is not None
    continuity.suggest(robot_at(planar(3.0, 0.0)))
    assert continuity.prior(3 * SECOND, BASE_FROM_CAMERA).expectation is None


def test_odometry_over_a_long_way_makes_nothing_expected() -> None:
    continuity = Continuity(ContinuityOptions(drift=0.1))
    drive(continuity, 0, 20, 1.0)
    fix(continuity, 0.0, planar(0.0, 0.0))
    assert continuity.prior(2 * SECOND, BASE_FROM_CAMERA).expectation is not None
    assert continuity.prior(19 * SECOND, BASE_FROM_CAMERA).expectation is None
