# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Odometry at a time, and the gate: one wrong fix never passes, and no fix is silenced for good."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gam_relocalizer.geometry import pose_error, rigid3d_from_rotation, rotation_of
from gam_relocalizer.localization.odometry import (
    DOUBT_AFTER,
    HOLD_NS,
    MAX_GAP_NS,
    Fix,
    OdometryGate,
    OdometryReading,
    OdometryTrack,
    disagreement,
    fused,
    predict,
)
from gam_relocalizer.localization.robot_pose import RobotPose

if TYPE_CHECKING:
    from collections.abc import Sequence

SECOND = 10**9
DRIFT = 0.05
STD = 0.03
COVARIANCE = np.diag([STD**2 / 3] * 6)
EXAMPLES = settings(max_examples=50, deadline=None)


def planar(x: float, y: float, yaw_deg: float) -> pycolmap.Rigid3d:
    turn = Rotation.from_euler('z', yaw_deg, degrees=True)
    return rigid3d_from_rotation(turn, [x, y, 0.0])


def moved_by(metres: float) -> pycolmap.Rigid3d:
    return planar(metres, 0.0, 0.0)


def assert_close(found: pycolmap.Rigid3d, expected: pycolmap.Rigid3d) -> None:
    error = pose_error(found.inverse(), expected.inverse())
    assert error.position < 1e-9
    assert error.rotation_deg < 1e-5


def circling_at(seconds: float) -> pycolmap.Rigid3d:
    """Ten degrees a second, on a spot that moves by half a metre a second."""
    return planar(0.5 * seconds, 0.0, 10.0 * seconds)


def track_of(*seconds: float) -> OdometryTrack:
    track = OdometryTrack()
    for second in seconds:
        track.add(round(second * SECOND), circling_at(second))
    return track


@EXAMPLES
@given(st.floats(0.0, 10.0))
def test_odometry_is_interpolated_at_any_time_in_it(second: float) -> None:
    stamp_ns = round(second * SECOND)
    reading = track_of(*np.arange(0.0, 10.1, 0.4)).at(stamp_ns)
    assert reading is not None
    assert_close(reading.odom_from_base, circling_at(stamp_ns / SECOND))


def test_beyond_its_samples_odometry_is_held_for_a_moment_and_not_extrapolated() -> None:
    track = track_of(5.0, 5.5)
    for stamp_ns, second in ((5 * SECOND - HOLD_NS, 5.0), (5.5 * SECOND + HOLD_NS, 5.5)):
        reading = track.at(round(stamp_ns))
        assert reading is not None
        assert_close(reading.odom_from_base, circling_at(second))
    assert track.at(5 * SECOND - HOLD_NS - 1) is None
    assert track.at(round(5.5 * SECOND) + HOLD_NS + 1) is None


def test_an_empty_track_knows_nothing() -> None:
    assert OdometryTrack().at(0) is None
    assert OdometryTrack().is_empty


def test_nobody_knows_what_the_robot_did_in_a_long_gap() -> None:
    gap = MAX_GAP_NS / SECOND
    assert track_of(0.0, gap).at(SECOND // 2) is not None
    silent = track_of(0.0, gap + 0.1)
    assert silent.at(SECOND // 2) is None
    assert silent.at(HOLD_NS) is not None
    assert silent.at(round((gap + 0.1) * SECOND)) is not None


def test_old_odometry_is_forgotten() -> None:
    track = OdometryTrack(history_ns=2 * SECOND)
    for second in range(10):
        track.add(second * SECOND, moved_by(second))
    assert track.at(6 * SECOND) is None
    assert track.at(7 * SECOND) is not None


def test_stragglers_change_nothing() -> None:
    track = track_of(0.0, 0.5, 1.0)
    track.add(SECOND // 2, moved_by(100.0))
    reading = track.at(SECOND // 2)
    assert reading is not None
    assert_close(reading.odom_from_base, circling_at(0.5))


def test_odometry_is_behind_while_it_comes_but_has_not_got_there() -> None:
    track = track_of(0.0, 0.5)
    half = SECOND // 2
    assert not OdometryTrack().is_behind(half)
    assert not track.is_behind(half + HOLD_NS)
    assert track.is_behind(half + HOLD_NS + 1)
    assert track.is_behind(half + MAX_GAP_NS)
    assert not track.is_behind(half + MAX_GAP_NS + 1)


def test_a_jump_back_in_time_starts_anew() -> None:
    track = track_of(100.0, 100.5)
    assert not track.went_back(100 * SECOND)
    assert track.went_back(50 * SECOND)
    track.add(50 * SECOND, moved_by(1.0))
    assert track.at(100 * SECOND) is None
    assert track.at(50 * SECOND) is not None


def test_the_way_is_as_long_as_it_was_driven() -> None:
    """Forth and back: the robot is where it was, and has travelled."""
    track = OdometryTrack()
    positions = [*np.arange(0.0, 3.0, 0.02), *np.arange(3.0, -0.001, -0.02)]
    for index, position in enumerate(positions):
        track.add(index * SECOND // 20, planar(position, 0.0, 10.0 * position))
    reading = track.at((len(positions) - 1) * SECOND // 20)
    assert reading is not None
    assert reading.travelled == pytest.approx(6.0, abs=0.15)
    assert reading.turned_deg == pytest.approx(60.0, abs=1.5)


def test_a_robot_that_trembles_on_the_spot_travels_nowhere() -> None:
    rng = np.random.default_rng(0)
    track = OdometryTrack()
    for index in range(1000):
        x, y, yaw = rng.normal(0.0, [0.002, 0.002, 0.1])
        track.add(index * SECOND // 50, planar(x, y, yaw))
    reading = track.at(999 * SECOND // 50)
    assert reading is not None
    assert (reading.travelled, reading.turned_deg) == (0.0, 0.0)


def fix_of(map_from_base: pycolmap.Rigid3d, odometry: OdometryReading) -> Fix:
    return Fix(RobotPose(map_from_base, COVARIANCE), odometry)


STANDING = OdometryReading(pycolmap.Rigid3d(), 0.0, 0.0)


def test_a_prediction_carries_the_fix_on_by_the_odometry_in_the_frame_of_the_robot() -> None:
    """Ahead for the odometry is ahead for the robot, wherever both count from."""
    before = OdometryReading(planar(7.0, 7.0, 90.0), 0.0, 0.0)
    after = OdometryReading(planar(7.0, 9.0, 135.0), 2.0, 45.0)
    prediction = predict(fix_of(planar(1.0, 0.0, 0.0), before), after, DRIFT)
    assert_close(prediction.map_from_base, planar(3.0, 0.0, 45.0))


def test_the_margin_grows_with_the_way_the_drift_and_the_uncertainty_of_the_fix() -> None:
    def margin(travelled: float, drift: float, std: float) -> tuple[float, float]:
        pose = RobotPose(pycolmap.Rigid3d(), np.diag([std**2] * 6))
        after = OdometryReading(moved_by(travelled), travelled, 0.0)
        found = predict(Fix(pose, STANDING), after, drift).margin
        return found.position, found.rotation_deg

    near = margin(1.0, 0.05, 0.01)
    for larger in (margin(2.0, 0.05, 0.01), margin(1.0, 0.1, 0.01), margin(1.0, 0.05, 0.02)):
        assert larger[0] > near[0]
        assert larger[1] > near[1]


def agree(
    before: RobotPose, later: RobotPose, way: pycolmap.Rigid3d, turned_deg: float = 0.0
) -> bool:
    """Whether two fixes do, with odometry that went straight or turned on the spot between."""
    after = OdometryReading(way, float(np.linalg.norm(way.translation)), turned_deg)
    return disagreement(Fix(before, STANDING), Fix(later, after), DRIFT) is None


def test_fixes_agree_that_differ_as_much_as_either_is_uncertain() -> None:
    def robot(metres: float, std: float) -> RobotPose:
        return RobotPose(moved_by(metres), np.diag([std**2] * 3 + [1e-6] * 3))

    stay = pycolmap.Rigid3d()
    assert not agree(robot(0.0, 0.01), robot(0.5, 0.01), stay)
    assert agree(robot(0.0, 0.2), robot(0.5, 0.01), stay)
    assert agree(robot(0.0, 0.01), robot(0.5, 0.2), stay)


def test_a_fix_of_uncertain_heading_agrees_with_one_beside_its_way() -> None:
    def robot(x: float, y: float) -> RobotPose:
        return RobotPose(planar(x, y, 0.0), np.diag([1e-6] * 3 + [0.05**2] * 3))

    assert agree(robot(0.0, 0.0), robot(10.0, 1.5), moved_by(10.0))
    assert not agree(robot(0.0, 0.0), robot(1.0, 1.5), moved_by(1.0))


@pytest.mark.parametrize(('way', 'turned_deg'), [(moved_by(10.0), 0.0), (moved_by(0.0), 360.0)])
def test_heading_drifts_with_the_way_and_with_the_turns(
    way: pycolmap.Rigid3d, turned_deg: float
) -> None:
    start = RobotPose(pycolmap.Rigid3d(), COVARIANCE)
    still_off, moved_off = planar(0.0, 0.0, 20.0), way * planar(0.0, 0.0, 20.0)
    assert not agree(start, RobotPose(still_off, COVARIANCE), pycolmap.Rigid3d())
    assert agree(start, RobotPose(moved_off, COVARIANCE), way, turned_deg)


@dataclass(frozen=True)
class Drive:
    """Fixes and odometry of a drive, both as good as they claim to be."""

    fixes: tuple[pycolmap.Rigid3d, ...]
    odometry: tuple[OdometryReading, ...]

    def fix(self, index: int, shift: pycolmap.Rigid3d | None = None) -> Fix:
        """A fix, in a place that is shifted."""
        map_from_base = (shift or pycolmap.Rigid3d()) * self.fixes[index]
        return fix_of(map_from_base, self.odometry[index])

    def __len__(self) -> int:
        return len(self.fixes)


@st.composite
def drives(draw: st.DrawFn, least: int = 3) -> Drive:
    """Some metres and a turn between two fixes; drift within the bounds, noise within 2 sigma."""
    step = st.tuples(st.floats(0.0, 3.0), st.floats(-90.0, 90.0))
    steps = draw(st.lists(step, min_size=least, max_size=least + 6))
    scale, turn_scale = (1.0 + draw(st.floats(-0.8, 0.8)) * DRIFT for _ in range(2))
    rng = np.random.default_rng(draw(st.integers(0, 1000)))
    odom_from_map = planar(*draw(st.tuples(*[st.floats(-50.0, 50.0)] * 3)))
    true, measured = [pycolmap.Rigid3d()], [STANDING]
    for metres, degrees in steps:
        true.append(true[-1] * planar(metres, 0.0, degrees))
        before = measured[-1]
        measured.append(
            OdometryReading(
                before.odom_from_base * planar(scale * metres, 0.0, turn_scale * degrees),
                before.travelled + scale * metres,
                before.turned_deg + turn_scale * abs(degrees),
            )
        )
    odometry = [
        OdometryReading(odom_from_map * m.odom_from_base, m.travelled, m.turned_deg)
        for m in measured
    ]
    return Drive(tuple(noisy(pose, rng) for pose in true), tuple(odometry))


def noisy(pose: pycolmap.Rigid3d, rng: np.random.Generator) -> pycolmap.Rigid3d:
    moved, turned = (2.0 * STD * rng.uniform() * direction(rng) for _ in range(2))
    turn = Rotation.from_rotvec(turned) * rotation_of(pose)
    return rigid3d_from_rotation(turn, pose.translation + moved)


def direction(rng: np.random.Generator) -> np.ndarray:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


@st.composite
def wrong_places(draw: st.DrawFn) -> pycolmap.Rigid3d:
    """A motion of the map that takes every pose elsewhere."""
    metres, angle = draw(st.floats(3.0, 100.0)), draw(st.floats(0.0, 2.0 * np.pi))
    return planar(metres * np.cos(angle), metres * np.sin(angle), 0.0)


def fix_with(map_from_base: pycolmap.Rigid3d, std: float, odometry: OdometryReading) -> Fix:
    return Fix(RobotPose(map_from_base, np.diag([std**2] * 6)), odometry)


@EXAMPLES
@given(drives())
def test_two_fixes_are_better_than_either(drive: Drive) -> None:
    before, fix = drive.fix(0), drive.fix(len(drive) - 1)
    both = fused(before, fix, DRIFT).pose.covariance
    prediction = predict(before, fix.odometry, DRIFT)
    np.testing.assert_array_equal(both, both.T)
    assert np.linalg.eigvalsh(both).min() > 0.0
    for alone in (fix.pose.covariance, prediction.covariance):
        assert np.linalg.eigvalsh(alone - both).min() > -1e-12


@EXAMPLES
@given(drives(), st.tuples(*[st.floats(-180.0, 180.0)] * 3))
def test_what_two_fixes_make_of_each_other_does_not_depend_on_the_axes_of_the_map(
    drive: Drive, angles: tuple[float, float, float]
) -> None:
    turn = Rotation.from_euler('ZYX', angles, degrees=True)
    other_from_map = rigid3d_from_rotation(turn, [3.0, -20.0, 1.0])
    axes = np.kron(np.eye(2), turn.as_matrix())

    def moved(fix: Fix) -> Fix:
        covariance = axes @ fix.pose.covariance @ axes.T
        return Fix(RobotPose(other_from_map * fix.pose.map_from_base, covariance), fix.odometry)

    before, fix = drive.fix(0), drive.fix(len(drive) - 1)
    found = fused(moved(before), moved(fix), DRIFT).pose
    expected = moved(fused(before, fix, DRIFT)).pose
    assert_close(found.map_from_base, expected.map_from_base)
    np.testing.assert_allclose(found.covariance, expected.covariance, atol=1e-12)


def test_of_a_precise_and_a_poor_fix_the_precise_one_counts() -> None:
    after = OdometryReading(moved_by(0.1), 0.1, 0.0)
    for std_before, std, x in ((1e-4, 1.0, 0.1), (1.0, 1e-4, 0.3)):
        start = fix_with(moved_by(0.0), std_before, STANDING)
        found = fused(start, fix_with(moved_by(0.3), std, after), DRIFT).pose.map_from_base
        np.testing.assert_allclose(found.translation, [x, 0.0, 0.0], atol=1e-4)


def test_odometry_that_may_be_off_further_has_less_of_a_say() -> None:
    def found_after(metres: float) -> float:
        after = OdometryReading(moved_by(metres), metres, 0.0)
        late = fix_with(planar(metres, 0.1, 0.0), 0.03, after)
        start = fix_with(moved_by(0.0), 0.03, STANDING)
        return float(fused(start, late, DRIFT).pose.map_from_base.translation[1])

    assert found_after(0.0) == pytest.approx(0.05)
    assert found_after(0.0) < found_after(1.0) < found_after(5.0) < 0.1


def test_fixes_of_a_robot_that_stands_still_are_averaged() -> None:
    gate, offsets = OdometryGate(), [0.03, -0.02, 0.05, 0.0, -0.01]
    for offset in offsets:
        assert (
            gate.judge(fix_with(planar(offset, -offset, 100.0 * offset), STD, STANDING), DRIFT)
            is None
        )
    assert gate.agreed is not None
    mean = float(np.mean(offsets))
    assert_close(gate.agreed.pose.map_from_base, planar(mean, -mean, 100.0 * mean))
    expected = np.diag([STD**2 / len(offsets)] * 6)
    np.testing.assert_allclose(gate.agreed.pose.covariance, expected, atol=1e-12)


def test_the_first_fix_agrees_with_none_nor_does_one_that_passes_in_doubt() -> None:
    gate = OdometryGate()
    for index in range(DOUBT_AFTER + 3):
        gate.judge(fix_of(moved_by(10.0 * index), STANDING), DRIFT)
        assert gate.agreed is None
    assert gate.doubts_odometry


def verdicts(gate: OdometryGate, fixes: Sequence[Fix]) -> list[bool]:
    """Which of them pass."""
    return [gate.judge(fix, DRIFT) is None for fix in fixes]


@EXAMPLES
@given(drives())
def test_drift_within_its_bounds_never_holds_a_fix_back(drive: Drive) -> None:
    assert all(verdicts(OdometryGate(), [drive.fix(i) for i in range(len(drive))]))


@EXAMPLES
@given(drives(), wrong_places(), st.data())
def test_one_wrong_fix_among_good_ones_never_passes(
    drive: Drive, wrong: pycolmap.Rigid3d, data: st.DataObject
) -> None:
    at = data.draw(st.integers(1, len(drive) - 1))
    fixes = [drive.fix(i, wrong if i == at else None) for i in range(len(drive))]
    assert verdicts(OdometryGate(), fixes) == [i != at for i in range(len(drive))]


@EXAMPLES
@given(wrong_places())
def test_a_good_fix_ends_the_claim_of_a_wrong_place(wrong: pycolmap.Rigid3d) -> None:
    good, other = fix_of(pycolmap.Rigid3d(), STANDING), fix_of(wrong, STANDING)
    assert verdicts(OdometryGate(), [good, other] * 5) == [True, False] * 5


@EXAMPLES
@given(drives(), wrong_places())
def test_a_wrong_first_fix_is_corrected_by_the_second_good_one(
    drive: Drive, wrong: pycolmap.Rigid3d
) -> None:
    fixes = [drive.fix(i, wrong if i == 0 else None) for i in range(len(drive))]
    assert verdicts(OdometryGate(), fixes) == [i != 1 for i in range(len(drive))]


@EXAMPLES
@given(drives(), wrong_places(), st.data())
def test_a_carried_robot_is_back_with_its_second_fix(
    drive: Drive, elsewhere: pycolmap.Rigid3d, data: st.DataObject
) -> None:
    at = data.draw(st.integers(1, len(drive) - 2))
    fixes = [drive.fix(i, elsewhere if i >= at else None) for i in range(len(drive))]
    assert verdicts(OdometryGate(), fixes) == [i != at for i in range(len(drive))]


@EXAMPLES
@given(drives(least=5), wrong_places(), wrong_places(), st.data())
def test_a_carried_robot_is_back_with_its_third_fix_though_one_between_is_wrong(
    drive: Drive, elsewhere: pycolmap.Rigid3d, wrong: pycolmap.Rigid3d, data: st.DataObject
) -> None:
    at = data.draw(st.integers(1, len(drive) - 3))
    fixes = [drive.fix(i, elsewhere if i >= at else None) for i in range(len(drive))]
    fixes[at + 1] = drive.fix(at + 1, elsewhere * wrong)
    # the wrong one is neither where the robot was nor where it is
    assume(all(disagreement(f, fixes[at + 1], DRIFT) for f in (fixes[at - 1], fixes[at])))
    assert verdicts(OdometryGate(), fixes) == [i not in {at, at + 1} for i in range(len(drive))]


@EXAMPLES
@given(st.lists(st.floats(3.0, 100.0), min_size=10, max_size=20))
def test_odometry_that_stands_still_does_not_silence_a_robot_that_drives(
    metres: list[float],
) -> None:
    fixes = [fix_of(moved_by(x), STANDING) for x in accumulate(metres)]
    expected = [True] + [False] * DOUBT_AFTER + [True] * (len(fixes) - DOUBT_AFTER - 1)
    assert verdicts(OdometryGate(), fixes) == expected


def test_odometry_that_was_doubted_is_believed_again_when_two_fixes_agree_by_it() -> None:
    gate = OdometryGate()
    elsewhere = [fix_of(moved_by(10.0 * i), STANDING) for i in range(DOUBT_AFTER + 2)]
    passed = verdicts(gate, elsewhere)
    assert passed == [True, *[False] * DOUBT_AFTER, True]
    assert gate.doubts_odometry
    assert verdicts(gate, [fix_of(moved_by(-10.0), STANDING)] * 2) == [True, True]
    assert not gate.doubts_odometry
    assert verdicts(gate, [fix_of(moved_by(30.0), STANDING)]) == [False]


def test_a_turned_fix_is_held_back_as_a_shifted_one() -> None:
    gate = OdometryGate()
    turned = fix_of(planar(0.0, 0.0, 20.0), STANDING)
    against = [gate.judge(fix, DRIFT) for fix in (fix_of(planar(0.0, 0.0, 0.0), STANDING), turned)]
    assert against[0] is None
    assert against[1] is not None
    assert against[1].found.rotation_deg == pytest.approx(20.0)
    assert against[1].allowed.rotation_deg < 20.0


def test_a_fix_that_is_both_shifted_and_turned_is_held_back_sooner() -> None:
    before = fix_of(planar(0.0, 0.0, 0.0), STANDING)
    far = disagreement(before, fix_of(planar(50.0, 0.0, 0.0), STANDING), DRIFT)
    assert far is not None
    shift, turn = 0.8 * far.allowed.position, 0.8 * far.allowed.rotation_deg
    assert disagreement(before, fix_of(planar(shift, 0.0, 0.0), STANDING), DRIFT) is None
    assert disagreement(before, fix_of(planar(0.0, 0.0, turn), STANDING), DRIFT) is None
    assert disagreement(before, fix_of(planar(shift, 0.0, turn), STANDING), DRIFT) is not None


def test_a_cleared_gate_has_nothing_to_compare_with() -> None:
    gate = OdometryGate()
    assert verdicts(gate, [fix_of(moved_by(0.0), STANDING)]) == [True]
    gate.clear()
    assert verdicts(gate, [fix_of(moved_by(50.0), STANDING)]) == [True]
