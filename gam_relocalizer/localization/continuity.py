# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What one query tells the next: where to look first, and which fix to hold back.

The node and the replay of a bag both go through here, between the arrival of an image and what is
published.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pycolmap

from gam_relocalizer.geometry import rotation_of
from gam_relocalizer.localization.correction import Correction, correction_by
from gam_relocalizer.localization.odometry import (
    DEFAULT_DRIFT,
    SIGMAS,
    Fix,
    OdometryGate,
    OdometryReading,
    OdometryTrack,
    predict,
)
from gam_relocalizer.localization.prior import Expectation, Gravity, PositionHint, Prior
from gam_relocalizer.localization.result import Status

if TYPE_CHECKING:
    from gam_relocalizer.localization.result import LocalizationResult
    from gam_relocalizer.localization.robot_pose import RobotPose

# Without odometry the robot may be as far as a quick one gets [m/s].
MAX_SPEED = 2.0
# Images taken further apart than that hardly show the same [m].
MIN_HINT_RADIUS = 3.0
ANY_TILT_DEG = 180.0
# Odometry that may be off further is no evidence for a pose [m].
MAX_EXPECTED_POSITION = 1.0


@dataclass(frozen=True)
class ContinuityOptions:
    """What is known about the robot and its map.

    Attributes:
        metric: Whether a map unit is a metre and z points up; if not, neither odometry nor speed
            nor gravity says anything about the map, and nothing is known beforehand.
        drift: Share of the way that odometry may be off; see `odometry.predict`.
        max_tilt_deg: The base never leans further from upright; 180 says nothing.
    """

    metric: bool = True
    drift: float = DEFAULT_DRIFT
    max_tilt_deg: float = ANY_TILT_DEG


def is_odometry_of(child_frame: str, base_frame: str) -> bool:
    """Whether odometry moves as the poses do; that of another body swings about this one.

    Args:
        child_frame: Of the odometry; empty: its sender does not say, and is taken at his word.
        base_frame: Whose poses are wanted; empty for the camera, which odometry is never of.
    """
    base_frame = base_frame.strip('/')
    return bool(base_frame) and child_frame.strip('/') in {'', base_frame}


@dataclass(frozen=True)
class _Place:
    """Where the robot was, and when; by a fix, or because somebody says so."""

    stamp_ns: int
    pose: RobotPose
    odometry: OdometryReading | None
    is_fix: bool


class Continuity:
    """Remembers fixes and odometry. Not thread-safe: feed it and ask it in one thread."""

    def __init__(self, options: ContinuityOptions | None = None) -> None:
        self.options = options or ContinuityOptions()
        self._track = OdometryTrack()
        self._gate = OdometryGate()
        self._place: _Place | None = None
        self._suggested: RobotPose | None = None
        self._correction: Correction | None = None

    @property
    def correction(self) -> Correction | None:
        """Where the odometry's frame lies in the map, by the newest fix that another one confirms.

        That is one that passed and agrees with another one by the odometry between them: the last
        one that passed, or one held back. So neither a wrong first fix, which passes because there
        is nothing to compare it with, nor any other single one ever moves it. The pose is what
        these fixes make of each other (`odometry.fused`). A robot that stands still gets its
        correction from two fixes of one view, which may both be wrong: it may have to know where
        it is before it can move.

        It stays while fixes are held back, refused, or come without odometry at their stamps.

        None before that; while odometry is doubted; from a gap or a jump in the odometry on
        (`OdometryTrack.unbroken_since_ns`) until such a fix after it; on a map that is not metric.
        """
        correction = self._correction
        if correction is None or correction.stamp_ns < self._track.unbroken_since_ns:
            return None
        return correction

    def add_odometry(self, stamp_ns: int, odom_from_base: pycolmap.Rigid3d) -> None:
        """Takes in one sample of odometry; when its stamps jump back, all starts anew.

        Args:
            stamp_ns: When it holds [ns].
            odom_from_base: The pose of the base [m].
        """
        if not self.options.metric:
            return
        if self._track.went_back(stamp_ns):
            self.clear()
        self._track.add(stamp_ns, odom_from_base)

    def suggest(self, pose: RobotPose) -> None:
        """Takes in where somebody says that the robot is, from the next image on.

        It is where to look first until the next fix, and has no say in which fix passes.
        """
        # when it was said means little: by a wall clock beside a bag, or not at all
        self._suggested = pose

    def prior(self, stamp_ns: int, base_from_camera: pycolmap.Rigid3d | None) -> Prior:
        """What is known about the camera at a time.

        Args:
            stamp_ns: Of the image [ns].
            base_from_camera: The mount; None when it is not known, which leaves out what would
                follow from it.
        """
        if not self.options.metric:
            return Prior()
        if self._suggested is not None:
            self._place = _Place(stamp_ns, self._suggested, self._track.at(stamp_ns), is_fix=False)
            self._suggested = None
        return Prior(
            self._hint(stamp_ns, base_from_camera),
            self._gravity(base_from_camera),
            self._expectation(stamp_ns, base_from_camera),
        )

    def judge(
        self, stamp_ns: int, result: LocalizationResult, pose: RobotPose
    ) -> LocalizationResult:
        """Holds back an accepted pose that the odometry speaks against; see `OdometryGate`.

        Without odometry at that time, every pose passes.

        Args:
            stamp_ns: Of the image [ns].
            result: An accepted one.
            pose: The pose of the base that belongs to it.

        Returns:
            The result, IMPLAUSIBLE when it is held back.
        """
        odometry = self._track.at(stamp_ns)
        if odometry is not None:
            against = self._gate.judge(Fix(pose, odometry), self.options.drift)
            if against is not None:
                # two places compete now, and there is no telling where to look first
                self._place = None
                reason = (
                    f'the pose is off from where odometry has brought the robot since the last '
                    f'fix, by {against}; held back until another one confirms it'
                )
                return result.judged(Status.IMPLAUSIBLE, reason)
            agreed = self._gate.agreed
            self._correction = None if agreed is None else correction_by(agreed, stamp_ns)
        self._place = _Place(stamp_ns, pose, odometry, is_fix=True)
        return result

    @property
    def doubts_odometry(self) -> bool:
        """Whether poses pass although odometry speaks against them; see `OdometryGate`."""
        return self._gate.doubts_odometry

    def awaits_odometry(self, stamp_ns: int) -> bool:
        """Whether the odometry at that time is still to come, as that of a VIO after its image."""
        return self._track.is_behind(stamp_ns)

    def misses_odometry(self, stamp_ns: int) -> bool:
        """Whether there is odometry, but none at that time."""
        return not self._track.is_empty and self._track.at(stamp_ns) is None

    def clear(self) -> None:
        """Forgets everything, as when time jumped back."""
        self._track.clear()
        self._gate.clear()
        self._place = None
        self._suggested = None
        self._correction = None

    def _hint(
        self, stamp_ns: int, base_from_camera: pycolmap.Rigid3d | None
    ) -> PositionHint | None:
        place, odometry = self._place, self._track.at(stamp_ns)
        if place is None:
            return None
        if place.odometry is not None and odometry is not None:
            prediction = predict(Fix(place.pose, place.odometry), odometry, self.options.drift)
            map_from_base, radius = prediction.map_from_base, prediction.margin.position
        else:
            map_from_base = place.pose.map_from_base
            seconds = max(0, stamp_ns - place.stamp_ns) / 1e9
            variance = float(np.trace(place.pose.covariance[:3, :3]))
            radius = SIGMAS * variance**0.5 + MAX_SPEED * seconds
        map_from_camera = map_from_base * (base_from_camera or pycolmap.Rigid3d())
        return PositionHint(map_from_camera.translation, max(MIN_HINT_RADIUS, radius))

    def _expectation(
        self, stamp_ns: int, base_from_camera: pycolmap.Rigid3d | None
    ) -> Expectation | None:
        """What odometry makes of the last fix; nothing when it may be off too far to tell."""
        place, odometry = self._place, self._track.at(stamp_ns)
        if base_from_camera is None or odometry is None:
            return None
        if place is None or not place.is_fix or place.odometry is None:
            return None
        prediction = predict(Fix(place.pose, place.odometry), odometry, self.options.drift)
        if prediction.margin.position > MAX_EXPECTED_POSITION:
            return None
        return Expectation(
            (prediction.map_from_base * base_from_camera).inverse(),
            prediction.margin.position,
            prediction.margin.rotation_deg,
        )

    def _gravity(self, base_from_camera: pycolmap.Rigid3d | None) -> Gravity | None:
        if base_from_camera is None or self.options.max_tilt_deg >= ANY_TILT_DEG:
            return None
        up_in_camera = rotation_of(base_from_camera).inv().apply([0.0, 0.0, 1.0])
        return Gravity(up_in_camera, self.options.max_tilt_deg)
