# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""A drive with odometry that drifts: what it says alone, and what fixes make of it."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gam_relocalizer.geometry import pose_error, rigid3d_from_rotation
from gam_relocalizer.localization.correction import Correction
from gam_relocalizer.localization.odometry import MAX_GAP_NS
from gam_relocalizer.localization.result import LocalizationResult, Status
from gam_relocalizer.localization.robot_pose import RobotPose
from gam_relocalizer.replay.drift import TimedPose, TrajectoryError, corrected, trajectories_of
from gam_relocalizer.replay.result import Attempt, OdometrySample

SECOND = 10**9
STEP_NS = SECOND // 20
FIX = LocalizationResult(Status.ACCEPTED, 'good')
REFUSAL = LocalizationResult(Status.TOO_FEW_INLIERS, 'few')
ODOM_FROM_START = rigid3d_from_rotation(Rotation.from_euler('z', 1.0), [7.0, -3.0, 0.0])


def planar(x: float, y: float, yaw: float) -> pycolmap.Rigid3d:
    return rigid3d_from_rotation(Rotation.from_euler('z', yaw), [x, y, 0.0])


def truth_at(second: float) -> pycolmap.Rigid3d:
    """A circle of 2 m, at half a metre a second."""
    angle = 0.25 * second
    return planar(2.0 * np.sin(angle), 2.0 - 2.0 * np.cos(angle), angle)


def drive(
    seconds: float = 20.0, *, scale: float = 1.02, yaw_rate: float = 0.01
) -> list[OdometrySample]:
    """Odometry that counts from elsewhere, measures the way too long and turns too far."""
    stamps = range(0, round(seconds * SECOND) + 1, STEP_NS)
    samples = [OdometrySample(0, ODOM_FROM_START, truth_at(0.0))]
    for before, stamp_ns in pairwise(stamps):
        truth = truth_at(stamp_ns / SECOND)
        moved = truth_at(before / SECOND).inverse() * truth
        slip = planar(0.0, 0.0, yaw_rate * STEP_NS / SECOND)
        measured = rigid3d_from_rotation(
            Rotation.from_quat(moved.rotation.quat), scale * moved.translation
        )
        odom_from_base = samples[-1].odom_from_base * measured * slip
        samples.append(OdometrySample(stamp_ns, odom_from_base, truth))
    return samples


def fix_at(sample: OdometrySample, *, corrects: bool = True) -> Attempt:
    """The truth, at the time of a sample."""
    truth = sample.truth
    assert truth is not None
    correction = Correction(truth * sample.odom_from_base.inverse(), sample.stamp_ns)
    pose = RobotPose(truth, np.eye(6))
    return Attempt(sample.stamp_ns, FIX, pose, truth, correction if corrects else None)


def stamps_of(poses: tuple[TimedPose, ...] | list[TimedPose]) -> list[int]:
    return [pose.stamp_ns for pose in poses]


def errors_of(poses: tuple[TimedPose, ...] | list[TimedPose]) -> list[float]:
    errors = [pose.error for pose in poses]
    return [error.position for error in errors if error is not None]


def test_odometry_alone_starts_at_the_truth_and_drifts() -> None:
    trajectories = trajectories_of(drive(), [])
    assert trajectories is not None
    errors = errors_of(trajectories.odometry)
    assert errors[0] < 1e-9
    assert max(errors) > 0.2
    assert trajectories.fixes == trajectories.corrected == ()


def test_odometry_alone_is_laid_on_the_first_truth_there_is() -> None:
    late = [
        replace(sample, truth=None) if sample.stamp_ns < 5 * SECOND else sample
        for sample in drive(scale=1.0, yaw_rate=0.0)
    ]
    trajectories = trajectories_of(late, [])
    assert trajectories is not None
    assert len(trajectories.odometry) == len(late)
    for pose in trajectories.odometry:
        error = pose_error(pose.map_from_base.inverse(), truth_at(pose.stamp_ns / SECOND).inverse())
        assert error.position < 1e-9


@settings(max_examples=25, deadline=None)
@given(st.floats(0.5, 8.0), st.floats(0.95, 1.05), st.floats(-0.03, 0.03))
def test_corrected_odometry_is_right_at_each_fix_and_drifts_for_one_period_only(
    period: float, scale: float, yaw_rate: float
) -> None:
    odometry = drive(scale=scale, yaw_rate=yaw_rate)
    every = max(1, round(period * SECOND / STEP_NS))
    poses = list(corrected(odometry, [fix_at(sample) for sample in odometry[::every]]))
    assert stamps_of(poses) == [sample.stamp_ns for sample in odometry]
    assert max(errors_of(poses)[::every]) < 1e-9
    # the way, too long by a share, and swung by the turns that are too far
    way = 0.5 * every * STEP_NS / SECOND
    swing = abs(yaw_rate) * every * STEP_NS / SECOND
    assert max(errors_of(poses)) <= way * (abs(scale - 1.0) + swing) + 1e-9


def test_a_fix_counts_from_its_own_time_on_and_changes_nothing_before() -> None:
    odometry = drive()
    fixes = [fix_at(odometry[100]), fix_at(odometry[200]), fix_at(odometry[300])]
    whole, part = list(corrected(odometry, fixes)), list(corrected(odometry, fixes[:2]))
    assert stamps_of(whole)[0] == odometry[100].stamp_ns
    for pose, other in zip(whole[:200], part[:200], strict=True):
        np.testing.assert_array_equal(pose.map_from_base.matrix(), other.map_from_base.matrix())
    assert errors_of(whole)[200] < 1e-9 < errors_of(part)[200]


def test_a_refused_image_leaves_the_correction_and_one_that_ends_it_ends_the_trajectory() -> None:
    odometry = drive()
    first = fix_at(odometry[100])
    refused = Attempt(odometry[200].stamp_ns, REFUSAL, correction=first.correction)
    doubtful = fix_at(odometry[300], corrects=False)
    poses = list(corrected(odometry, [first, refused, doubtful]))
    assert stamps_of(poses) == [sample.stamp_ns for sample in odometry[100:300]]


@pytest.mark.parametrize('kind', ['gap', 'jump'])
def test_nothing_is_known_from_a_break_in_the_odometry_to_the_next_correction(kind: str) -> None:
    odometry = drive()
    if kind == 'gap':
        missing = MAX_GAP_NS // STEP_NS
        odometry = [*odometry[:150], *odometry[150 + missing :]]
    else:
        restarted = odometry[150].odom_from_base.inverse()
        odometry[150:] = [
            replace(sample, odom_from_base=restarted * sample.odom_from_base)
            for sample in odometry[150:]
        ]
    poses = list(corrected(odometry, [fix_at(odometry[100]), fix_at(odometry[250])]))
    known = [sample.stamp_ns for sample in (*odometry[100:150], *odometry[250:])]
    assert stamps_of(poses) == known


def test_without_odometry_there_are_no_trajectories() -> None:
    assert trajectories_of([], [fix_at(drive(1.0)[0])]) is None


def test_without_truth_there_are_poses_and_no_errors() -> None:
    odometry = drive()
    attempts = [replace(fix_at(sample), truth=None) for sample in odometry[::100]]
    blind = [replace(sample, truth=None) for sample in odometry]
    trajectories = trajectories_of(blind, attempts)
    assert trajectories is not None
    assert (len(trajectories.fixes), len(trajectories.corrected)) == (5, len(odometry))
    assert trajectories.odometry == ()
    assert trajectories.errors() == {}


def test_the_trajectory_error_is_over_poses_with_a_truth() -> None:
    shifts = [(3.0, 0.0), (4.0, 90.0), (0.0, 0.0)]
    poses = [
        TimedPose(index, planar(shift, 0.0, np.radians(turn)), pycolmap.Rigid3d())
        for index, (shift, turn) in enumerate(shifts)
    ]
    error = TrajectoryError.of([*poses, TimedPose(9, planar(99.0, 0.0, 0.0))])
    assert error is not None
    assert error.poses == 3
    assert error.position_rmse == pytest.approx(5.0 / np.sqrt(3.0))
    assert (error.position_median, error.position_max) == pytest.approx((3.0, 4.0))
    assert error.rotation_rmse_deg == pytest.approx(90.0 / np.sqrt(3.0))
    assert (error.rotation_median_deg, error.rotation_max_deg) == pytest.approx((0.0, 90.0))
