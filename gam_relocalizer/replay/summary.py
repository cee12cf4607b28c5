# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The numbers of a run, replayed or live: one row per attempt, and what they add up to."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.geometry import PoseError, pose_error
from gam_relocalizer.localization.result import Status

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.localization.result import Timings
    from gam_relocalizer.localization.robot_pose import RobotPose
    from gam_relocalizer.replay.result import Attempt


@dataclass(frozen=True)
class Row:
    """One attempt, in the numbers that a report shows.

    Attributes:
        stamp_ns: Stamp of the image [ns].
        status: The verdict.
        reason: The verdict in words.
        inliers: Inliers of the best pose found.
        robot_pose: The fix, when accepted.
        truth: map_from_base at that time, when known.
        milliseconds: Time by stage; a single stage will do.
    """

    stamp_ns: int
    status: Status
    reason: str = ''
    inliers: int = 0
    robot_pose: RobotPose | None = None
    truth: pycolmap.Rigid3d | None = None
    milliseconds: Mapping[str, float] = field(default_factory=dict)

    @property
    def error(self) -> PoseError | None:
        """Against the truth, when there are both."""
        if self.robot_pose is None or self.truth is None:
            return None
        return pose_error(self.robot_pose.map_from_base.inverse(), self.truth.inverse())

    @property
    def position_std(self) -> float | None:
        """Root of the summed variances of x, y and z [map units]."""
        if self.robot_pose is None:
            return None
        return float(np.sqrt(np.trace(self.robot_pose.covariance[:3, :3])))

    @property
    def orientation_std_deg(self) -> float | None:
        """Root of the summed variances about x, y and z [deg]."""
        if self.robot_pose is None:
            return None
        return float(np.degrees(np.sqrt(np.trace(self.robot_pose.covariance[3:, 3:]))))

    @property
    def total_milliseconds(self) -> float:
        """Sum over the stages."""
        return sum(self.milliseconds.values())


@dataclass(frozen=True)
class Spread:
    """A sample in three numbers."""

    median: float
    p95: float
    max: float

    @staticmethod
    def of(values: Sequence[float]) -> Spread | None:
        """None of no values."""
        if not values:
            return None
        median, p95, largest = (float(np.quantile(values, share)) for share in (0.5, 0.95, 1.0))
        return Spread(median, p95, largest)


@dataclass(frozen=True)
class Summary:
    """What the rows of a run add up to.

    Attributes:
        attempts: Number of rows.
        accepted: Number of fixes.
        statuses: How often each status came, by its name.
        position_error: Of the fixes with a known truth [map units].
        rotation_error_deg: Of the fixes with a known truth [deg].
        milliseconds: By stage, of the attempts that came so far.
        total_milliseconds: Of all stages of an attempt.
    """

    attempts: int
    accepted: int
    statuses: Mapping[str, int]
    position_error: Spread | None
    rotation_error_deg: Spread | None
    milliseconds: Mapping[str, Spread]
    total_milliseconds: Spread | None


def row_of(attempt: Attempt) -> Row:
    """An attempt of a replay as a row."""
    return Row(
        stamp_ns=attempt.stamp_ns,
        status=attempt.result.status,
        reason=attempt.result.reason,
        inliers=attempt.result.inliers,
        robot_pose=attempt.robot_pose,
        truth=attempt.truth,
        milliseconds=_by_stage(attempt.result.timings),
    )


def summarise(rows: Sequence[Row]) -> Summary:
    """Adds up the rows of a run."""
    errors = [error for row in rows if (error := row.error) is not None]
    timed = [row for row in rows if row.total_milliseconds > 0]
    stages = dict.fromkeys(stage for row in timed for stage in row.milliseconds)
    by_stage = {
        stage: Spread.of([row.milliseconds.get(stage, 0.0) for row in timed]) for stage in stages
    }
    statuses = Counter(row.status for row in rows)
    return Summary(
        attempts=len(rows),
        accepted=statuses[Status.ACCEPTED],
        statuses={status.name: statuses[status] for status in Status if statuses[status]},
        position_error=Spread.of([error.position for error in errors]),
        rotation_error_deg=Spread.of([error.rotation_deg for error in errors]),
        milliseconds={stage: spread for stage, spread in by_stage.items() if spread},
        total_milliseconds=Spread.of([row.total_milliseconds for row in timed]),
    )


def position_between(
    stamp_ns: int, poses: Sequence[tuple[int, pycolmap.Rigid3d]]
) -> NDArray[np.float64] | None:
    """[3] between the poses before and after, by time; None when there are no poses.

    Args:
        stamp_ns: When [ns].
        poses: map_from_base by rising stamps [ns].
    """
    if not poses:
        return None
    begin_ns = poses[0][0]  # seconds since then are exact enough, stamps as floats are not
    seconds = [(stamp - begin_ns) / 1e9 for stamp, _ in poses]
    places = np.array([pose.translation for _, pose in poses])
    return np.array([np.interp((stamp_ns - begin_ns) / 1e9, seconds, axis) for axis in places.T])


def _by_stage(timings: Timings) -> dict[str, float]:
    return {
        'extraction': timings.extraction,
        'retrieval': timings.retrieval,
        'matching': timings.matching,
        'pose': timings.pose,
        'verdict': timings.verdict,
    }
