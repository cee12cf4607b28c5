# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What the node counts of itself, for its diagnostics; what follows from it is in conditions.py."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass, field
from enum import Enum, unique
from typing import TYPE_CHECKING

from gam_relocalizer.localization.result import Status, Timings

if TYPE_CHECKING:
    from collections.abc import Callable

    from gam_relocalizer.localization.result import LocalizationResult
    from gam_relocalizer.scene_map import SceneMap

SECOND = 10**9
# Rates, medians and shares are of so many images or attempts.
RECENT = 20
JUMPS = 3
# What came from somebody else and should not counts for so long after it was last seen.
RECENTLY_NS = 10 * SECOND
# Attempts that could not be made: what is wrong is what comes in, not what the camera sees.
UNUSABLE = frozenset(
    {
        Status.UNDECODABLE_IMAGE,
        Status.NO_CALIBRATION,
        Status.NO_TRANSFORM,
        Status.STALE_IMAGE,
    }
)


@unique
class State(Enum):
    """State of the managed node."""

    UNCONFIGURED = 'unconfigured'
    INACTIVE = 'inactive'
    ACTIVE = 'active'
    FINALIZED = 'finalized'


@dataclass(frozen=True)
class MapFacts:
    """What is told of a map.

    Attributes:
        path: Directory of the bundle.
        map_id: Identity of exactly this map.
        images: Number of reference images.
        points: Number of points.
        metric: Whether a map unit is a metre.
    """

    path: str
    map_id: str
    images: int
    points: int
    metric: bool


@dataclass
class Images:
    """What came from the camera.

    Attributes:
        topic: Resolved name of the topic.
        publishers: How many publish there.
        count: How many images came.
        last_ns: When the last one came.
        arrivals_ns: When the last ones came.
        delays_ns: By how much their stamps were behind the node's clock then.
        jumps: How often time jumped back.
        jumps_ns: When it last did.
    """

    topic: str = ''
    publishers: int = 0
    count: int = 0
    last_ns: int | None = None
    arrivals_ns: deque[int] = field(default_factory=lambda: deque(maxlen=RECENT))
    delays_ns: deque[int] = field(default_factory=lambda: deque(maxlen=RECENT))
    jumps: int = 0
    jumps_ns: deque[int] = field(default_factory=lambda: deque(maxlen=JUMPS))


@dataclass
class Attempts:
    """What came of the images that were tried.

    Attributes:
        count: How many there were, those that could not be made included.
        fixes: How many gave a fix.
        last_fix_ns: When the last fix was published.
        recent: The last verdicts.
        timings: Of the last attempts that reached the model.
        reason: The last verdict in words.
        refusals: Refusals in a row.
        unusable: Attempts in a row that could not be made.
        unusable_since_ns: When the first of these was.
        periods_missed: How often the worker was still busy when the next attempt was due.
    """

    count: int = 0
    fixes: int = 0
    last_fix_ns: int | None = None
    recent: deque[Status] = field(default_factory=lambda: deque(maxlen=RECENT))
    timings: deque[Timings] = field(default_factory=lambda: deque(maxlen=RECENT))
    reason: str = ''
    refusals: int = 0
    unusable: int = 0
    unusable_since_ns: int = 0
    periods_missed: int = 0

    def add(self, result: LocalizationResult, now_ns: int) -> None:
        """Takes in the verdict on one image, as it was published."""
        self.count += 1
        self.recent.append(result.status)
        self.reason = result.reason
        if result.timings.total > 0:
            self.timings.append(result.timings)
        if result.accepted:
            self.fixes += 1
            self.last_fix_ns = now_ns
            self.refusals = 0
        else:
            self.refusals += 1
        if result.status not in UNUSABLE:
            self.unusable = 0
            return
        if not self.unusable:
            self.unusable_since_ns = now_ns
        self.unusable += 1


@dataclass
class Odometry:
    """What came of the odometry.

    Attributes:
        last_ns: When the last usable message came.
        other_body: Whose odometry came instead, if any did.
        other_body_ns: When that last came.
        missing: Fixes in a row at whose stamps there was none, though there is odometry.
        doubted: Whether fixes pass although it speaks against them.
    """

    last_ns: int | None = None
    other_body: str = ''
    other_body_ns: int = 0
    missing: int = 0
    doubted: bool = False


@dataclass
class Broadcast:
    """The transform map -> odom.

    Attributes:
        wanted: Whether this node is to publish it.
        last_ns: When it last did.
        obstacle: Why it cannot, whatever the fixes are; empty while it can.
        obstacle_since_ns: When there was an obstacle for the first time since there was none.
    """

    wanted: bool = False
    last_ns: int | None = None
    obstacle: str = ''
    obstacle_since_ns: int = 0


@dataclass
class Activity:
    """One stretch in which the node is active.

    Attributes:
        since_ns: When it began, or was last enabled: ages count from then at the earliest.
    """

    since_ns: int = 0
    images: Images = field(default_factory=Images)
    attempts: Attempts = field(default_factory=Attempts)
    odometry: Odometry = field(default_factory=Odometry)
    broadcast: Broadcast = field(default_factory=Broadcast)


class Health:
    """Counts what happens. Bounded in memory; all methods are for one thread.

    Ages are counted by a steady clock, so that no correction of the system's clock changes them,
    less the time in which the node's own clock stands: in a paused bag nothing is late.

    Attributes:
        state: State of the node.
        error: Why the last transition failed; empty since one succeeded.
        enabled: Whether attempts are made without being asked for.
        period_s: Time between two attempts [s]; to be set when it changes.
        device: Where the networks run.
        map: The map in use.
        map_error: Why another map was not taken; empty since one was.
        activity: What happened since activation; None while the node is not active.
        clock_ns: What the node's clock read last.
    """

    def __init__(self, steady_ns: Callable[[], int] = time.monotonic_ns) -> None:
        """Unconfigured.

        Args:
            steady_ns: The steady clock [ns].
        """
        self.state = State.UNCONFIGURED
        self.error = ''
        self.enabled = True
        self.period_s = 0.0
        self.device = ''
        self.map: MapFacts | None = None
        self.map_error = ''
        self.activity: Activity | None = None
        self.clock_ns = 0
        self._steady_ns = steady_ns
        self._read_ns = self._moved_ns = steady_ns()
        self._stood_ns = 0

    @property
    def now_ns(self) -> int:
        """The time that ages are counted by; falls by up to the time between two `observe`."""
        return self._steady_ns() - self._stood_ns

    @property
    def clock_stands_s(self) -> float:
        """For how long the node's clock has read the same [s]."""
        return (self._read_ns - self._moved_ns) / SECOND

    def seconds_without(self, last_ns: int | None) -> float:
        """For how long something has not come, while it should have [s].

        Args:
            last_ns: When it last did; None for never.
        """
        since_ns = self.now_ns if self.activity is None else self.activity.since_ns
        return max(0, self.now_ns - max(since_ns, last_ns or since_ns)) / SECOND

    def is_recent(self, at_ns: int) -> bool:
        """Whether something that was seen still counts."""
        return self.now_ns - at_ns < RECENTLY_NS

    def observe(self, clock_ns: int, image_publishers: int) -> None:
        """Takes in what has to be looked up, once before each report.

        Args:
            clock_ns: What the node's clock reads.
            image_publishers: How many publish on the topic of the images.
        """
        steady_ns = self._steady_ns()
        if clock_ns == self.clock_ns:
            self._stood_ns += steady_ns - self._read_ns
        else:
            self.clock_ns, self._moved_ns = clock_ns, steady_ns
        self._read_ns = steady_ns
        if self.activity is not None:
            self.activity.images.publishers = image_publishers

    # States

    def failed(self, error: str) -> None:
        """A transition came to nothing."""
        self.error = error

    def map_loaded(self, scene_map: SceneMap, device: str) -> None:
        """A map is in use from now on: the first one, or another.

        Args:
            scene_map: The map; nothing of it is kept.
            device: Where the networks run, such as `cpu, 4 threads`.
        """
        manifest = scene_map.manifest
        self.map = MapFacts(
            str(scene_map.path),
            manifest.map_id,
            scene_map.num_images,
            scene_map.num_points,
            manifest.frame.metric,
        )
        self.device = device
        self.error = self.map_error = ''
        if self.state is State.UNCONFIGURED:
            self.state = State.INACTIVE

    def map_refused(self, error: str) -> None:
        """Another map could not be loaded; the one in use stays."""
        self.map_error = error

    def activated(self, image_topic: str, period_s: float, *, broadcasts: bool) -> None:
        """The node listens, and counting starts anew.

        Args:
            image_topic: Resolved name.
            period_s: Time between two attempts [s].
            broadcasts: Whether map -> odom is to be published.
        """
        self.state, self.error, self.enabled, self.period_s = State.ACTIVE, '', True, period_s
        self.activity = Activity(
            self.now_ns, Images(image_topic), broadcast=Broadcast(wanted=broadcasts)
        )

    def set_enabled(self, *, enabled: bool) -> None:
        """Attempts are made again, or no longer, without being asked for."""
        if enabled and not self.enabled and self.activity is not None:
            self.activity.since_ns = self.now_ns
        self.enabled = enabled

    def deactivated(self) -> None:
        """The node no longer listens."""
        self.activity = None
        if self.state is State.ACTIVE:
            self.state = State.INACTIVE

    def unloaded(self) -> None:
        """The node is unconfigured."""
        self.deactivated()
        self.state, self.map, self.map_error, self.device = State.UNCONFIGURED, None, '', ''

    def shut_down(self) -> None:
        """The node does nothing any more, whatever it is asked for."""
        self.unloaded()
        self.state, self.error = State.FINALIZED, ''

    # What happens while the node is active; of what comes late, nothing is kept

    def image_came(self, delay_ns: int) -> None:
        """An image came, whether it will be tried or not.

        Args:
            delay_ns: By how much its stamp is behind the node's clock.
        """
        if self.activity is not None:
            images = self.activity.images
            images.count += 1
            images.last_ns = self.now_ns
            images.arrivals_ns.append(images.last_ns)
            images.delays_ns.append(delay_ns)

    def time_jumped(self) -> None:
        """Time, or the stamps of the images, jumped back."""
        if self.activity is not None:
            self.activity.images.jumps += 1
            self.activity.images.jumps_ns.append(self.now_ns)

    def period_over(self, *, busy: bool) -> None:
        """An attempt is due.

        Args:
            busy: Whether the worker is still at another one.
        """
        if self.activity is not None and busy:
            self.activity.attempts.periods_missed += 1

    def attempt_finished(self, result: LocalizationResult) -> None:
        """The verdict on an image of the camera was published.

        Args:
            result: As it was published; only status, reason and timings are kept.
        """
        if self.activity is not None:
            self.activity.attempts.add(result, self.now_ns)

    def odometry_came(self) -> None:
        """A message that can be used came."""
        if self.activity is not None:
            self.activity.odometry.last_ns = self.now_ns

    def odometry_was_of(self, other_body: str) -> None:
        """A message came that is of another frame than that of the poses."""
        if self.activity is not None:
            self.activity.odometry.other_body = other_body
            self.activity.odometry.other_body_ns = self.now_ns

    def fix_compared(self, *, missing: bool, doubted: bool) -> None:
        """A fix was compared with the odometry.

        Args:
            missing: There is odometry, but none at its stamp.
            doubted: The odometry is thought to be wrong.
        """
        if self.activity is not None:
            odometry = self.activity.odometry
            odometry.missing = odometry.missing + 1 if missing else 0
            odometry.doubted = doubted

    def map_to_odom_was_due(self, obstacle: str, *, sent: bool) -> None:
        """The transform map -> odom was to be broadcast.

        Args:
            obstacle: Why it cannot be, whatever the fixes are; empty if it can.
            sent: Whether it was.
        """
        if self.activity is None:
            return
        broadcast = self.activity.broadcast
        if obstacle and not broadcast.obstacle:
            broadcast.obstacle_since_ns = self.now_ns
        broadcast.obstacle = obstacle
        if sent:
            broadcast.last_ns = self.now_ns
