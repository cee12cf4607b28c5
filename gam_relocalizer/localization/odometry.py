# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What odometry says about fixes: where the robot should be by now, and which fix to doubt.

Odometry drifts, but it does not jump; a fix does not drift, but a wrong one is anywhere. So what
one wrong fix would change is held back until a second one confirms it.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.geometry import PoseError, pose_error
from gam_relocalizer.transforms import interpolated

if TYPE_CHECKING:
    import pycolmap

    from gam_relocalizer.localization.robot_pose import RobotPose

# Odometry is asked for the stamp of an image when the attempt is over: longer than that takes.
HISTORY_NS = 30 * 10**9
# So close to a sample, the robot is where the sample says (5 cm off at 1 m/s).
HOLD_NS = 50 * 10**6
# Between samples further apart nobody knows what the robot did.
MAX_GAP_NS = 10**9
# A sample this much older than the last one is no straggler: time has jumped back.
RESTART_NS = 10**9

# Odometry that trembles where the robot stands is no way travelled.
STRIDE = 0.05
STRIDE_DEG = 3.0

DEFAULT_DRIFT = 0.05
# Odometry that is off by a share of the way is off in heading, too: by that share of a radian each
# so many metres (at 5 %, a degree per metre).
METRES_PER_RADIAN = 3.0
# What stamps that do not quite fit, a mount that is not quite right and a map do at standstill.
POSITION_FLOOR = 0.1
ROTATION_FLOOR_DEG = 3.0
SIGMAS = 3.0

# A new place wins with 2 fixes of the last 3: the newest and one of the two held back before it.
RECENTLY_HELD = 2
# So many fixes in a row that fit neither each other nor the last one: odometry is what is wrong.
DOUBT_AFTER = 5


@dataclass(frozen=True)
class OdometryReading:
    """Odometry at one time.

    Attributes:
        odom_from_base: The pose of the base.
        travelled: Length of the way since the track began [m].
        turned_deg: Sum of all turns since the track began [deg].
    """

    odom_from_base: pycolmap.Rigid3d
    travelled: float
    turned_deg: float


class OdometryTrack:
    """The recent odometry, at any time in it. Not thread-safe: feed it and ask it in one thread."""

    def __init__(self, history_ns: int = HISTORY_NS) -> None:
        self._history_ns = history_ns
        self._stamps: list[int] = []
        self._readings: list[OdometryReading] = []
        self._stride: OdometryReading | None = None

    @property
    def is_empty(self) -> bool:
        """Whether nothing is known at any time."""
        return not self._stamps

    def went_back(self, stamp_ns: int) -> bool:
        """Whether a stamp lies so far before the last sample that time has jumped back."""
        return bool(self._stamps) and stamp_ns < self._stamps[-1] - RESTART_NS

    def add(self, stamp_ns: int, odom_from_base: pycolmap.Rigid3d) -> None:
        """Takes in one sample; stragglers are left out.

        Args:
            stamp_ns: When it holds [ns]; a jump back (`went_back`) starts the track anew.
            odom_from_base: The pose of the base.
        """
        if self.went_back(stamp_ns):
            self.clear()
        if self._stamps and stamp_ns <= self._stamps[-1]:
            return
        self._stamps.append(stamp_ns)
        self._readings.append(self._measured(odom_from_base))
        expired = bisect_left(self._stamps, stamp_ns - self._history_ns)
        del self._stamps[:expired], self._readings[:expired]

    def at(self, stamp_ns: int) -> OdometryReading | None:
        """The odometry at a time, interpolated.

        Returns:
            None when it is not known: there are no samples around that time, or they are further
            apart than `MAX_GAP_NS`. Beyond the samples it is that of the nearest one for
            `HOLD_NS`; nothing is extrapolated.
        """
        after = bisect_left(self._stamps, stamp_ns)
        inside = 0 < after < len(self._stamps)
        if inside and self._stamps[after] - self._stamps[after - 1] <= MAX_GAP_NS:
            return self._between(after - 1, after, stamp_ns)
        near = (
            self._readings[index]
            for index in range(max(0, after - 1), min(after + 1, len(self._stamps)))
            if abs(self._stamps[index] - stamp_ns) <= HOLD_NS
        )
        return next(near, None)

    def clear(self) -> None:
        """Forgets everything, as when time jumped back."""
        self._stamps.clear()
        self._readings.clear()
        self._stride = None

    def _measured(self, odom_from_base: pycolmap.Rigid3d) -> OdometryReading:
        """A sample with the way to it, in strides: so small steps that they may be noise wait."""
        if self._stride is None:
            self._stride = OdometryReading(odom_from_base, 0.0, 0.0)
        stride = self._stride
        moved = pose_error(odom_from_base.inverse(), stride.odom_from_base.inverse())
        if moved.position < STRIDE and moved.rotation_deg < STRIDE_DEG:
            return OdometryReading(odom_from_base, stride.travelled, stride.turned_deg)
        self._stride = OdometryReading(
            odom_from_base,
            stride.travelled + moved.position,
            stride.turned_deg + moved.rotation_deg,
        )
        return self._stride

    def _between(self, before: int, after: int, stamp_ns: int) -> OdometryReading:
        begin, end = self._stamps[before], self._stamps[after]
        earlier, later = self._readings[before], self._readings[after]
        odom_from_base = interpolated(
            earlier.odom_from_base, later.odom_from_base, (stamp_ns - begin) / (end - begin)
        )
        return OdometryReading(odom_from_base, earlier.travelled, earlier.turned_deg)


@dataclass(frozen=True)
class Fix:
    """A fix, with the odometry at the same time."""

    pose: RobotPose
    odometry: OdometryReading


@dataclass(frozen=True)
class Prediction:
    """Where a fix and the odometry since put the robot.

    Attributes:
        map_from_base: The pose.
        margin: How far off it may be.
    """

    map_from_base: pycolmap.Rigid3d
    margin: PoseError


@dataclass(frozen=True)
class Disagreement:
    """How far a fix is from where odometry has brought the robot since another one.

    Attributes:
        found: The difference.
        allowed: How large it may be.
    """

    found: PoseError
    allowed: PoseError

    def __str__(self) -> str:
        return (
            f'{self.found.position:.2f} m and {self.found.rotation_deg:.1f} deg; up to '
            f'{self.allowed.position:.2f} m and {self.allowed.rotation_deg:.1f} deg are allowed'
        )


def predict(fix: Fix, odometry: OdometryReading, drift: float) -> Prediction:
    """Carries a fix on by odometry.

    The margin of the position is `POSITION_FLOOR`, 3 sigma of the fix (its orientation swings the
    way since), and the drift's share of the way. That of the rotation is `ROTATION_FLOOR_DEG`,
    3 sigma, and the drift's share of the turns and of the way (see `METRES_PER_RADIAN`).

    Args:
        fix: From where.
        odometry: Of the time wanted.
        drift: Share of the way, and of the turns, that odometry may be off.
    """
    base_before_from_base = fix.odometry.odom_from_base.inverse() * odometry.odom_from_base
    travelled = abs(odometry.travelled - fix.odometry.travelled)
    turned_deg = abs(odometry.turned_deg - fix.odometry.turned_deg)
    position_std, rotation_std = _deviations(fix.pose)
    swing = rotation_std * float(np.linalg.norm(base_before_from_base.translation))
    return Prediction(
        fix.pose.map_from_base * base_before_from_base,
        PoseError(
            POSITION_FLOOR + SIGMAS * math.hypot(position_std, swing) + drift * travelled,
            ROTATION_FLOOR_DEG
            + SIGMAS * math.degrees(rotation_std)
            + drift * (turned_deg + math.degrees(travelled / METRES_PER_RADIAN)),
        ),
    )


def disagreement(before: Fix, fix: Fix, drift: float) -> Disagreement | None:
    """What two fixes have against each other, by the odometry between them.

    Args:
        before: The earlier fix.
        fix: The later one.
        drift: See `predict`.

    Returns:
        None when they agree, within the margin of the prediction and 3 sigma of the later fix.
    """
    prediction = predict(before, fix.odometry, drift)
    found = pose_error(fix.pose.map_from_base.inverse(), prediction.map_from_base.inverse())
    position_std, rotation_std = _deviations(fix.pose)
    allowed = PoseError(
        prediction.margin.position + SIGMAS * position_std,
        prediction.margin.rotation_deg + SIGMAS * math.degrees(rotation_std),
    )
    if found.position <= allowed.position and found.rotation_deg <= allowed.rotation_deg:
        return None
    return Disagreement(found, allowed)


class OdometryGate:
    """Holds back fixes that disagree with the odometry, until they are confirmed.

    - The first fix passes: there is nothing to compare it with.
    - A fix that agrees with the last one that passed, passes.
    - One that does not is held back. When one of the next two agrees with it, that one passes, and
      the new place counts (2 of the last 3): the robot has been carried, or the earlier fix was
      wrong. So one wrong fix never makes the robot jump.
    - When `DOUBT_AFTER` fixes in a row agree neither with the last one nor with each other, it is
      the odometry that is wrong (wheels slip, another frame, another robot). It is doubted: every
      fix passes until two in a row agree by it again. So odometry never silences fixes for good.
    """

    def __init__(self) -> None:
        self._last: Fix | None = None
        self._held: deque[Fix] = deque(maxlen=DOUBT_AFTER)
        self._doubted = False

    @property
    def doubts_odometry(self) -> bool:
        """Whether fixes pass although they disagree."""
        return self._doubted

    def judge(self, fix: Fix, drift: float) -> Disagreement | None:
        """Lets a fix pass or holds it back.

        Args:
            fix: The newest fix.
            drift: See `predict`.

        Returns:
            None when it passes, else what it has against the last one that passed.
        """
        if self._last is None:
            self._pass(fix)
            return None
        against = disagreement(self._last, fix, drift)
        if against is None or self._is_confirmed(fix, drift):
            self._pass(fix)
            return None
        if self._doubted or len(self._held) == DOUBT_AFTER:
            self._pass(fix)
            self._doubted = True
            return None
        self._held.append(fix)
        return against

    def clear(self) -> None:
        """Forgets all fixes."""
        self._last = None
        self._held.clear()
        self._doubted = False

    def _is_confirmed(self, fix: Fix, drift: float) -> bool:
        recent = list(self._held)[-RECENTLY_HELD:]
        return any(disagreement(held, fix, drift) is None for held in recent)

    def _pass(self, fix: Fix) -> None:
        self._last = fix
        self._held.clear()
        self._doubted = False


def _deviations(pose: RobotPose) -> tuple[float, float]:
    """Standard deviations of position [m] and orientation [rad], each over all three axes."""
    variances = np.diag(pose.covariance)
    return math.sqrt(float(variances[:3].sum())), math.sqrt(float(variances[3:].sum()))
