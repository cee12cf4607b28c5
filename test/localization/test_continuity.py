# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What one query tells the next: hints that move with the robot, gravity, and fixes held back."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gam_relocalizer.geometry import pose_error, rigid3d_from, rigid3d_from_rotation
from gam_relocalizer.localization.continuity import (
    MAX_SPEED,
    MIN_HINT_RADIUS,
    Continuity,
    ContinuityOptions,
    is_odometry_of,
)
from gam_relocalizer.localization.odometry import DOUBT_AFTER, JUMP_SPEED, MAX_GAP_NS
from gam_relocalizer.localization.prior import PositionHint, Prior
from gam_relocalizer.localization.result import LocalizationResult, Status
from gam_relocalizer.localization.robot_pose import RobotPose

if TYPE_CHECKING:
    from random import Random

    import pycolmap

    from gam_relocalizer.localization.correction import Correction

SECOND = 10**9
EXAMPLES = settings(max_examples=50, deadline=None)
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


ODOM_FROM_START = planar(5.0, 5.0, 90.0)
MAP_FROM_START = planar(-3.0, 1.0, 30.0)
MAP_FROM_ODOM = MAP_FROM_START * ODOM_FROM_START.inverse()
SPEED = 0.5


def way(second: float) -> pycolmap.Rigid3d:
    """How far a straight drive has come."""
    return planar(SPEED * second, 0.0)


def driving(first: int = 0, last: int = 20) -> Continuity:
    """Odometry without drift; `MAP_FROM_ODOM` is what lays it on the true way."""
    continuity = Continuity()
    feed(continuity, first, last, ODOM_FROM_START)
    return continuity


def feed(
    continuity: Continuity, first: float, last: float, odom_from_start: pycolmap.Rigid3d
) -> None:
    for tenth in range(round(10 * first), round(10 * last) + 1):
        continuity.add_odometry(tenth * SECOND // 10, odom_from_start * way(tenth / 10.0))


def true_fix(continuity: Continuity, second: float) -> Status:
    return fix(continuity, second, MAP_FROM_START * way(second))


def wrong_fix(
    continuity: Continuity, second: float, shift: pycolmap.Rigid3d | None = None
) -> Status:
    return fix(continuity, second, (shift or planar(8.0, 9.0, 70.0)) * MAP_FROM_START * way(second))


def assert_lays(
    correction: Correction | None, map_from_odom: pycolmap.Rigid3d, second: float
) -> None:
    assert correction is not None
    error = pose_error(correction.map_from_odom.inverse(), map_from_odom.inverse())
    assert error.position < 1e-9
    assert error.rotation_deg < 1e-5
    assert correction.stamp_ns == round(second * SECOND)


@EXAMPLES
@given(st.tuples(*[st.floats(-50.0, 50.0)] * 3), st.floats(0.0, 9.0), st.floats(0.1, 9.0))
def test_the_correction_lays_the_odometry_at_the_stamp_of_the_image_on_the_fix(
    start: tuple[float, float, float], first: float, later: float
) -> None:
    """Between two samples of the odometry, wherever it counts from."""
    continuity = Continuity()
    odom_from_start = planar(*start)
    feed(continuity, 0.0, 20.0, odom_from_start)
    true_fix(continuity, first)
    true_fix(continuity, first + later)
    assert_lays(continuity.correction, MAP_FROM_START * odom_from_start.inverse(), first + later)


def test_a_fix_that_no_other_one_agrees_with_corrects_nothing() -> None:
    continuity = driving()
    assert continuity.correction is None
    assert true_fix(continuity, 1.0) is Status.ACCEPTED
    assert continuity.correction is None


def test_a_wrong_first_fix_never_corrects() -> None:
    continuity = driving()
    assert wrong_fix(continuity, 1.0) is Status.ACCEPTED
    assert true_fix(continuity, 3.0) is Status.IMPLAUSIBLE
    assert continuity.correction is None
    assert true_fix(continuity, 5.0) is Status.ACCEPTED
    assert_lays(continuity.correction, MAP_FROM_ODOM, 5.0)


@EXAMPLES
@given(st.lists(st.booleans(), max_size=12), st.randoms(use_true_random=False))
def test_single_wrong_fixes_never_move_the_correction(wanted: list[bool], random: Random) -> None:
    """Wrong ones anywhere, each followed by two good ones, the very first included."""
    continuity = driving()
    wrong = [False] * (len(wanted) + 2)
    for index, is_wrong in enumerate(wanted):
        wrong[index] = is_wrong and not any(wrong[max(0, index - 2) : index])
    for index, is_wrong in enumerate(wrong):
        if is_wrong:
            shift = planar(random.uniform(3.0, 50.0), random.uniform(3.0, 50.0))
            wrong_fix(continuity, float(index), shift)
        else:
            true_fix(continuity, float(index))
        if continuity.correction is not None:
            newest = continuity.correction.stamp_ns / SECOND
            assert_lays(continuity.correction, MAP_FROM_ODOM, newest)
            assert not wrong[round(newest)]
    assert continuity.correction is not None


def test_a_correction_stays_while_a_fix_is_held_back() -> None:
    continuity = driving()
    true_fix(continuity, 1.0)
    true_fix(continuity, 2.0)
    assert wrong_fix(continuity, 3.0) is Status.IMPLAUSIBLE
    assert_lays(continuity.correction, MAP_FROM_ODOM, 2.0)


def test_a_fix_that_says_that_it_is_poor_hardly_moves_the_correction() -> None:
    """A far wall tells the distance to it badly."""
    continuity = driving()
    true_fix(continuity, 1.0)
    true_fix(continuity, 2.0)
    place = MAP_FROM_START * way(3.0)
    poor = robot_at(planar(0.3, 0.0) * place, std=0.2)
    assert continuity.judge(3 * SECOND, ACCEPTED, poor).status is Status.ACCEPTED
    assert continuity.correction is not None
    found = continuity.correction.map_from_odom * ODOM_FROM_START * way(3.0)
    assert 0.0 < pose_error(found.inverse(), place.inverse()).position < 0.03


def test_a_carried_robot_is_corrected_by_the_second_fix_of_the_new_place() -> None:
    continuity = driving()
    elsewhere = planar(20.0, 0.0, 45.0)
    true_fix(continuity, 1.0)
    true_fix(continuity, 2.0)
    wrong_fix(continuity, 3.0, elsewhere)
    wrong_fix(continuity, 4.0, elsewhere)
    assert_lays(continuity.correction, elsewhere * MAP_FROM_ODOM, 4.0)


def test_there_is_no_correction_while_odometry_is_doubted() -> None:
    continuity = driving()
    true_fix(continuity, 0.0)
    true_fix(continuity, 1.0)
    for index in range(2, DOUBT_AFTER + 2):
        assert wrong_fix(continuity, float(index), planar(10.0 * index, 0.0)) is Status.IMPLAUSIBLE
        assert_lays(continuity.correction, MAP_FROM_ODOM, 1.0)
    assert wrong_fix(continuity, 8.0, planar(90.0, 0.0)) is Status.ACCEPTED
    assert continuity.doubts_odometry
    assert continuity.correction is None
    true_fix(continuity, 9.0)
    assert continuity.correction is None
    true_fix(continuity, 10.0)
    assert_lays(continuity.correction, MAP_FROM_ODOM, 10.0)


def test_odometry_that_restarts_at_zero_has_no_correction_until_two_fixes_agree_by_it() -> None:
    """In the middle of a drive, without a jump in time: what was right before is wrong at once."""
    continuity = driving(0, 10)
    true_fix(continuity, 8.0)
    true_fix(continuity, 9.0)
    odom_from_start = planar(SPEED * 10.1, 0.0).inverse()
    feed(continuity, 10.1, 20.0, odom_from_start)
    assert continuity.correction is None
    # its image was taken before, and counts for what was counted then
    true_fix(continuity, 10.0)
    assert continuity.correction is None
    true_fix(continuity, 11.0)
    assert continuity.correction is None
    true_fix(continuity, 12.0)
    assert_lays(continuity.correction, MAP_FROM_START * odom_from_start.inverse(), 12.0)


def test_after_a_gap_in_the_odometry_a_fix_has_to_confirm_the_correction() -> None:
    continuity = driving(0, 10)
    true_fix(continuity, 8.0)
    true_fix(continuity, 9.0)
    feed(continuity, 10.0 + MAX_GAP_NS / SECOND, 12.0, ODOM_FROM_START)
    assert_lays(continuity.correction, MAP_FROM_ODOM, 9.0)
    feed(continuity, 12.1 + MAX_GAP_NS / SECOND, 20.0, ODOM_FROM_START)
    assert continuity.correction is None
    true_fix(continuity, 15.0)
    assert_lays(continuity.correction, MAP_FROM_ODOM, 15.0)


def test_a_quick_robot_keeps_its_correction() -> None:
    continuity = Continuity()
    for tenth in range(51):
        speed = 0.9 * JUMP_SPEED
        continuity.add_odometry(tenth * SECOND // 10, planar(speed * tenth / 10.0, 0.0))
        if tenth in {10, 20}:
            fix(continuity, tenth / 10.0, planar(speed * tenth / 10.0, 0.0))
    assert continuity.correction is not None


def test_a_fix_without_odometry_at_its_stamp_leaves_the_correction_as_it_is() -> None:
    continuity = driving(0, 10)
    assert wrong_fix(continuity, 20.0) is Status.ACCEPTED
    assert wrong_fix(continuity, 21.0) is Status.ACCEPTED
    assert continuity.correction is None
    true_fix(continuity, 8.0)
    true_fix(continuity, 9.0)
    assert wrong_fix(continuity, 20.0) is Status.ACCEPTED
    assert_lays(continuity.correction, MAP_FROM_ODOM, 9.0)


def test_a_robot_that_stands_still_is_corrected_as_well() -> None:
    """It may have to know where it is before it can move."""
    continuity = Continuity()
    for tenth in range(100):
        continuity.add_odometry(tenth * SECOND // 10, ODOM_FROM_START)
    for second in (1.0, 2.0):
        fix(continuity, second, MAP_FROM_START)
    assert_lays(continuity.correction, MAP_FROM_ODOM, 2.0)


def test_no_correction_outlives_a_jump_back_in_time() -> None:
    continuity = driving(100, 120)
    true_fix(continuity, 101.0)
    true_fix(continuity, 102.0)
    assert continuity.correction is not None
    feed(continuity, 50.0, 50.0, ODOM_FROM_START)
    assert continuity.correction is None


def test_clearing_forgets_the_correction() -> None:
    continuity = driving()
    true_fix(continuity, 1.0)
    true_fix(continuity, 2.0)
    continuity.clear()
    assert continuity.correction is None
    feed(continuity, 0.0, 20.0, ODOM_FROM_START)
    true_fix(continuity, 3.0)
    assert continuity.correction is None


def test_a_suggestion_corrects_nothing() -> None:
    continuity = driving()
    true_fix(continuity, 1.0)
    true_fix(continuity, 2.0)
    continuity.suggest(robot_at(planar(50.0, 0.0)))
    continuity.prior(3 * SECOND, BASE_FROM_CAMERA)
    assert_lays(continuity.correction, MAP_FROM_ODOM, 2.0)


def test_in_a_map_without_metres_there_is_no_correction() -> None:
    continuity = Continuity(ContinuityOptions(metric=False))
    feed(continuity, 0.0, 20.0, ODOM_FROM_START)
    true_fix(continuity, 1.0)
    true_fix(continuity, 2.0)
    assert continuity.correction is None
