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
from scipy.spatial.transform import Rotation

from gam_relocalizer.geometry import (
    PoseError,
    pose_error,
    rigid3d_from_rotation,
    rotation_of,
    skew,
    symmetric,
)
from gam_relocalizer.localization.robot_pose import RobotPose
from gam_relocalizer.transforms import interpolated

if TYPE_CHECKING:
    import pycolmap
    from numpy.typing import NDArray

# Odometry is asked for the stamp of an image when the attempt is over: longer than that takes.
HISTORY_NS = 30 * 10**9
# So close to a sample, the robot is where the sample says (5 cm off at 1 m/s).
HOLD_NS = 50 * 10**6
# Between samples further apart nobody knows what the robot did.
MAX_GAP_NS = 10**9
# A sample this much older than the last one is no straggler: time has jumped back.
RESTART_NS = 10**9
# No robot is that quick [m/s, deg/s]: odometry that is has jumped, as when it restarts at zero.
JUMP_SPEED = 20.0
JUMP_TURN_RATE = 720.0

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
        self._unbroken_since_ns = 0

    @property
    def unbroken_since_ns(self) -> int:
        """From when on odometry counts from where it counts now [ns].

        After more than `MAX_GAP_NS` without samples it may have been started anew, and after a step
        that no robot makes in the time it has been.
        """
        return self._unbroken_since_ns

    @property
    def is_empty(self) -> bool:
        """Whether nothing is known at any time."""
        return not self._stamps

    def went_back(self, stamp_ns: int) -> bool:
        """Whether a stamp lies so far before the last sample that time has jumped back."""
        return bool(self._stamps) and stamp_ns < self._stamps[-1] - RESTART_NS

    def is_behind(self, stamp_ns: int) -> bool:
        """Whether samples come, but those for a time are still to come."""
        return bool(self._stamps) and HOLD_NS < stamp_ns - self._stamps[-1] <= MAX_GAP_NS

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
        if self._stamps and self._breaks_off(stamp_ns, odom_from_base):
            self._unbroken_since_ns = stamp_ns
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
        self._unbroken_since_ns = 0

    def _breaks_off(self, stamp_ns: int, odom_from_base: pycolmap.Rigid3d) -> bool:
        """Whether a new sample is not the last one, moved on."""
        elapsed_ns = stamp_ns - self._stamps[-1]
        moved = _moved(self._readings[-1].odom_from_base, odom_from_base)
        return (
            elapsed_ns > MAX_GAP_NS
            or moved.position > POSITION_FLOOR + JUMP_SPEED * elapsed_ns / 1e9
            or moved.rotation_deg > ROTATION_FLOOR_DEG + JUMP_TURN_RATE * elapsed_ns / 1e9
        )

    def _measured(self, odom_from_base: pycolmap.Rigid3d) -> OdometryReading:
        """A sample with the way to it, in strides: so small steps that they may be noise wait."""
        if self._stride is None:
            self._stride = OdometryReading(odom_from_base, 0.0, 0.0)
        stride = self._stride
        moved = _moved(stride.odom_from_base, odom_from_base)
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


def _moved(before: pycolmap.Rigid3d, after: pycolmap.Rigid3d) -> PoseError:
    """As `pose_error`, and quicker: it is asked for every sample."""
    before_from_after = before.inverse() * after
    return PoseError(
        float(np.linalg.norm(before_from_after.translation)),
        math.degrees(before_from_after.rotation.angle()),
    )


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
        covariance: [6,6], order of REP-103.
    """

    map_from_base: pycolmap.Rigid3d
    margin: PoseError
    covariance: NDArray[np.float64]


@dataclass(frozen=True)
class Disagreement:
    """How far a fix is from where odometry has brought the robot since another one.

    Attributes:
        found: The difference.
        allowed: How large each part may be where the other is nothing.
    """

    found: PoseError
    allowed: PoseError

    def __str__(self) -> str:
        return (
            f'{self.found.position:.2f} m and {self.found.rotation_deg:.1f} deg; up to '
            f'{self.allowed.position:.2f} m or {self.allowed.rotation_deg:.1f} deg are allowed, '
            f'and less of both together'
        )


def predict(fix: Fix, odometry: OdometryReading, drift: float) -> Prediction:
    """Carries a fix on by odometry.

    The margin of the position is `POSITION_FLOOR`, 3 sigma of the fix (its orientation swings the
    way since), and the drift's share of the way. That of the rotation is `ROTATION_FLOOR_DEG`,
    3 sigma, and the drift's share of the turns and of the way (see `METRES_PER_RADIAN`). The
    covariance is that of the fix, carried on, and the same shares as standard deviations.

    Args:
        fix: From where.
        odometry: Of the time wanted.
        drift: Share of the way, and of the turns, that odometry may be off.
    """
    base_before_from_base = fix.odometry.odom_from_base.inverse() * odometry.odom_from_base
    map_from_base = fix.pose.map_from_base * base_before_from_base
    travelled = abs(odometry.travelled - fix.odometry.travelled)
    turned_deg = abs(odometry.turned_deg - fix.odometry.turned_deg)
    drifted = PoseError(
        drift * travelled, drift * (turned_deg + math.degrees(travelled / METRES_PER_RADIAN))
    )
    position_std, rotation_std = _deviations(fix.pose)
    swing = rotation_std * float(np.linalg.norm(base_before_from_base.translation))
    return Prediction(
        map_from_base,
        PoseError(
            POSITION_FLOOR + SIGMAS * math.hypot(position_std, swing) + drifted.position,
            ROTATION_FLOOR_DEG + SIGMAS * math.degrees(rotation_std) + drifted.rotation_deg,
        ),
        _carried_on(fix.pose, map_from_base, drifted),
    )


def _carried_on(
    pose: RobotPose, map_from_base: pycolmap.Rigid3d, drifted: PoseError
) -> NDArray[np.float64]:
    """Covariance of a pose after a motion that may be off; its orientation swings the way."""
    jacobian = np.eye(6)
    jacobian[:3, 3:] = -skew(map_from_base.translation - pose.map_from_base.translation)
    std = np.repeat([drifted.position, math.radians(drifted.rotation_deg)], 3)
    return symmetric(jacobian @ pose.covariance @ jacobian.T + np.diag(np.square(std)))


def fused(before: Fix, fix: Fix, drift: float) -> Fix:
    """What a fix and the one before make of each other: the better one counts for more.

    The update of a Kalman filter. A precise fix is hardly changed; one of a far wall, which is off
    by many centimetres and says so, hardly changes what is known.

    Args:
        before: The earlier fix.
        fix: A later one that agrees with it.
        drift: See `predict`.

    Returns:
        The better pose at the time of the later one.
    """
    prediction = predict(before, fix.odometry, drift)
    predicted, found = prediction.map_from_base, fix.pose.map_from_base
    turned = rotation_of(found) * rotation_of(predicted).inv()
    moved = np.concatenate([found.translation - predicted.translation, turned.as_rotvec()])
    gain = np.linalg.solve(prediction.covariance + fix.pose.covariance, prediction.covariance).T
    step = gain @ moved
    map_from_base = rigid3d_from_rotation(
        Rotation.from_rotvec(step[3:]) * rotation_of(predicted), predicted.translation + step[:3]
    )
    covariance = symmetric(gain @ fix.pose.covariance)
    return Fix(RobotPose(map_from_base, covariance), fix.odometry)


def disagreement(before: Fix, fix: Fix, drift: float) -> Disagreement | None:
    """What two fixes have against each other, by the odometry between them.

    Args:
        before: The earlier fix.
        fix: The later one.
        drift: See `predict`.

    Returns:
        None when they agree, within the margin of the prediction and 3 sigma of the later fix:
        position and rotation by what share each uses up of that, in square, and no more than 1.
    """
    prediction = predict(before, fix.odometry, drift)
    found = pose_error(fix.pose.map_from_base.inverse(), prediction.map_from_base.inverse())
    position_std, rotation_std = _deviations(fix.pose)
    allowed = PoseError(
        prediction.margin.position + SIGMAS * position_std,
        prediction.margin.rotation_deg + SIGMAS * math.degrees(rotation_std),
    )
    share = math.hypot(found.position / allowed.position, found.rotation_deg / allowed.rotation_deg)
    return None if share <= 1.0 else Disagreement(found, allowed)


class OdometryGate:
    """Holds back fixes that disagree with the odometry, until they are confirmed.

    - The first fix passes: there is nothing to compare it with.
    - A fix that agrees with the last one that passed, passes. The last one is what all that agreed
      make of each other (`fused`).
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
        self._agreed = False

    @property
    def doubts_odometry(self) -> bool:
        """Whether fixes pass although they disagree."""
        return self._doubted

    @property
    def agreed(self) -> Fix | None:
        """What the fixes that agree make of each other, at the time of the last one that passed.

        None when that one agreed with no other, as the first one.
        """
        return self._last if self._agreed else None

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
        fellow = self._last if against is None else self._confirming(fix, drift)
        if fellow is not None:
            self._pass(fused(fellow, fix, drift))
            self._agreed = True
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
        self._agreed = False

    def _confirming(self, fix: Fix, drift: float) -> Fix | None:
        """One that was held back and agrees."""
        recent = list(self._held)[-RECENTLY_HELD:]
        return next((held for held in recent if disagreement(held, fix, drift) is None), None)

    def _pass(self, fix: Fix) -> None:
        self._last = fix
        self._held.clear()
        self._doubted = False
        self._agreed = False


def _deviations(pose: RobotPose) -> tuple[float, float]:
    """Standard deviations of position [m] and orientation [rad], each over all three axes."""
    variances = np.diag(pose.covariance)
    return math.sqrt(float(variances[:3].sum())), math.sqrt(float(variances[3:].sum()))
