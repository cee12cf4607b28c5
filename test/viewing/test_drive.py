# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Reading what a replay wrote."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from gam_relocalizer.errors import UsageError
from gam_relocalizer.geometry import pose_error, rigid3d_from
from gam_relocalizer.localization.result import Status
from gam_relocalizer.localization.robot_pose import RobotPose
from gam_relocalizer.replay.summary import Row
from gam_relocalizer.replay.writing import (
    ATTEMPTS,
    POSES,
    SUMMARY,
    write_attempts,
    write_summary,
    write_trajectory,
)
from gam_relocalizer.viewing.drive import read_drive

if TYPE_CHECKING:
    from pathlib import Path

START_NS = 1_700_000_000_123_456_789
REASON = 'the scenes of "a, b" and\n`c` disagree'


def rows() -> list[Row]:
    poses = [rigid3d_from([1, 0.1 * step, 0, 0.2], [step, 2.0, -0.5 * step]) for step in range(5)]
    return [
        Row(START_NS + step * 10**9, Status.ACCEPTED, 'fine', 50 + step, RobotPose(pose, np.eye(6)))
        if step != 2
        else Row(START_NS + step * 10**9, Status.AMBIGUOUS, REASON, 20)
        for step, pose in enumerate(poses)
    ]


def row_with_truth() -> Row:
    """15 cm off along x, and 3 degrees about z."""
    half = np.radians(1.5)
    pose, truth = rigid3d_from([1, 0, 0, 0], [1.15, 2, 3]), rigid3d_from([1, 0, 0, 0], [1, 2, 3])
    turned = rigid3d_from([np.cos(half), 0, 0, np.sin(half)], pose.translation)
    return Row(START_NS, Status.ACCEPTED, 'fine', 9, RobotPose(turned, np.eye(6)), truth)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_trajectory(tmp_path, rows())
    write_attempts(tmp_path, rows())
    write_summary(tmp_path, rows(), {'map_id': 'abc'})
    return tmp_path


def test_attempts_come_back_as_they_were_written(folder: Path) -> None:
    drive = read_drive(folder)

    assert drive.map_id == 'abc'
    assert [(one.stamp_ns, one.status, one.inliers, one.reason) for one in drive.attempts] == [
        (row.stamp_ns, row.status, row.inliers, row.reason) for row in rows()
    ]


def test_poses_come_back_with_their_attempts(folder: Path) -> None:
    drive = read_drive(folder)

    for attempt, row in zip(drive.attempts, rows(), strict=True):
        assert (attempt.map_from_base is None) == (row.robot_pose is None)
        if attempt.map_from_base is not None and row.robot_pose is not None:
            error = pose_error(
                attempt.map_from_base.inverse(), row.robot_pose.map_from_base.inverse()
            )
            assert error.position < 1e-8
            assert error.rotation_deg < 1e-6


def test_places_without_a_fix_are_guessed_between_those_with(folder: Path) -> None:
    drive = read_drive(folder)

    np.testing.assert_allclose(drive.guessed_position(START_NS + 2 * 10**9), [2.0, 2.0, -1.0])
    np.testing.assert_allclose(drive.guessed_position(START_NS - 10**9), [0.0, 2.0, 0.0])


def test_errors_come_back_where_the_truth_is_known(folder: Path) -> None:
    assert [one.error for one in read_drive(folder).attempts] == 5 * [None]

    write_attempts(folder, [row_with_truth()])
    (attempt,) = read_drive(folder).attempts

    assert attempt.error is not None
    assert attempt.error.position == pytest.approx(0.15, abs=1e-6)
    assert attempt.error.rotation_deg == pytest.approx(3.0, abs=1e-5)


@pytest.mark.parametrize('name', [ATTEMPTS, POSES, SUMMARY])
@pytest.mark.parametrize(
    'damage',
    [
        lambda file: file.unlink(),
        lambda file: file.write_bytes(b'\xff\xfe'),
        lambda file: file.write_text(file.read_text()[:-20].replace('ACCEPTED', 'FINE', 1)),
        lambda file: file.write_text('[' * 100_000),
    ],
    ids=['missing', 'binary', 'cut short', 'deep'],
)
def test_a_damaged_folder_is_a_usage_error(folder: Path, name: str, damage: object) -> None:
    damage(folder / name)

    with pytest.raises(UsageError, match=SUMMARY):
        read_drive(folder)


def test_a_folder_that_is_no_replay_is_a_usage_error(tmp_path: Path) -> None:
    with pytest.raises(UsageError):
        read_drive(tmp_path)
