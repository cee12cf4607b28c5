# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Odometry that drifts, and what fixes make of it: corrected trajectories and their errors."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.geometry import PoseError, pose_error
from gam_relocalizer.localization.odometry import OdometryTrack

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    import pycolmap

    from gam_relocalizer.localization.correction import Correction
    from gam_relocalizer.replay.result import Attempt, OdometrySample


@dataclass(frozen=True)
class TimedPose:
    """One pose of a trajectory.

    Attributes:
        stamp_ns: When [ns].
        map_from_base: Where the body is said to be.
        truth: map_from_base as it was, when known.
    """

    stamp_ns: int
    map_from_base: pycolmap.Rigid3d
    truth: pycolmap.Rigid3d | None = None

    @property
    def error(self) -> PoseError | None:
        """Against the truth, when that is known."""
        if self.truth is None:
            return None
        return pose_error(self.map_from_base.inverse(), self.truth.inverse())


@dataclass(frozen=True)
class TrajectoryError:
    """Absolute trajectory error, in the frame of the map: nothing is aligned.

    Attributes:
        poses: Number of poses with a known truth.
        position_rmse: Root of the mean squared error of the position [m].
        position_median: Its median [m].
        position_max: Its largest [m].
        rotation_rmse_deg: Of the rotation [deg].
        rotation_median_deg: Its median [deg].
        rotation_max_deg: Its largest [deg].
    """

    poses: int
    position_rmse: float
    position_median: float
    position_max: float
    rotation_rmse_deg: float
    rotation_median_deg: float
    rotation_max_deg: float

    @staticmethod
    def of(trajectory: Iterable[TimedPose]) -> TrajectoryError | None:
        """None when no pose has a known truth."""
        errors = [pose.error for pose in trajectory if pose.error is not None]
        if not errors:
            return None
        positions = np.array([error.position for error in errors])
        rotations = np.array([error.rotation_deg for error in errors])
        return TrajectoryError(len(errors), *_sizes(positions), *_sizes(rotations))


@dataclass(frozen=True)
class Trajectories:
    """The three trajectories of a replay with odometry; poses in the map.

    Attributes:
        odometry: By odometry alone, which starts at the truth; empty where no truth is known.
        fixes: The fixes.
        corrected: By odometry, corrected by fixes; from the first correction on.
    """

    odometry: tuple[TimedPose, ...]
    fixes: tuple[TimedPose, ...]
    corrected: tuple[TimedPose, ...]

    def by_name(self) -> dict[str, tuple[TimedPose, ...]]:
        """All three."""
        return {'odometry': self.odometry, 'fixes': self.fixes, 'corrected': self.corrected}

    def errors(self) -> dict[str, TrajectoryError]:
        """Of those with a known truth, by name."""
        errors = {name: TrajectoryError.of(poses) for name, poses in self.by_name().items()}
        return {name: error for name, error in errors.items() if error is not None}


def trajectories_of(
    odometry: Sequence[OdometrySample], attempts: Sequence[Attempt]
) -> Trajectories | None:
    """What odometry and fixes say where the body was; None without odometry.

    Args:
        odometry: In the order of its stamps.
        attempts: In the order of their stamps.
    """
    if not odometry:
        return None
    fixes = (
        TimedPose(attempt.stamp_ns, attempt.robot_pose.map_from_base, attempt.truth)
        for attempt in attempts
        if attempt.robot_pose is not None
    )
    return Trajectories(
        tuple(_from_the_truth(odometry)), tuple(fixes), tuple(corrected(odometry, attempts))
    )


def corrected(
    odometry: Iterable[OdometrySample], attempts: Sequence[Attempt]
) -> Iterator[TimedPose]:
    """Lays each sample of the odometry on the newest correction known at that time.

    A fix counts from the stamp of its image on, as if it took no time; nothing is put right
    afterwards. There is no pose while there is no correction, nor from a gap or jump in the
    odometry to the next correction.

    Args:
        odometry: In the order of its stamps.
        attempts: In the order of their stamps.
    """
    track = OdometryTrack()
    for sample in odometry:
        track.add(sample.stamp_ns, sample.odom_from_base)
        correction = _newest_at(sample.stamp_ns, attempts)
        if correction is not None and correction.stamp_ns >= track.unbroken_since_ns:
            map_from_base = correction.map_from_odom * sample.odom_from_base
            yield TimedPose(sample.stamp_ns, map_from_base, sample.truth)


def _newest_at(stamp_ns: int, attempts: Sequence[Attempt]) -> Correction | None:
    newer = bisect_right(attempts, stamp_ns, key=lambda attempt: attempt.stamp_ns)
    return attempts[newer - 1].correction if newer else None


def _from_the_truth(odometry: Sequence[OdometrySample]) -> Iterator[TimedPose]:
    """Odometry by itself, with its origin laid on the truth where that is first known."""
    first = next((sample for sample in odometry if sample.truth is not None), None)
    if first is None or first.truth is None:
        return
    map_from_odom = first.truth * first.odom_from_base.inverse()
    for sample in odometry:
        yield TimedPose(sample.stamp_ns, map_from_odom * sample.odom_from_base, sample.truth)


def _sizes(errors: np.ndarray) -> tuple[float, float, float]:
    """Root mean square, median and largest."""
    return (
        float(np.sqrt(np.mean(np.square(errors)))),
        float(np.median(errors)),
        float(np.max(errors)),
    )
