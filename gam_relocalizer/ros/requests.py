# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What services wait for: each request gets one answer, with what came of it.

Futures here are rclpy's, answered in the thread that spins the node.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import Enum, auto
from functools import partial
from typing import TYPE_CHECKING

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.task import Future

from gam_relocalizer.localization.result import LocalizationResult, Status

if TYPE_CHECKING:
    from collections.abc import Callable

    from rclpy.node import Node
    from rclpy.timer import Timer

    from gam_relocalizer.localization.robot_pose import RobotPose
    from gam_relocalizer.ros.attempt import Attempt

# A caller beyond these is told to come back: images are large, and waiting is of no use to anybody.
MAX_WAITING = 32
MAX_IMAGES = 4


@dataclass(frozen=True)
class Answer:
    """What a request for a pose gets.

    Attributes:
        result: The outcome.
        map_id: Identity of the map that was searched, or empty.
        stamp_ns: Stamp of the image [ns], 0 when there was none.
        pose: The pose asked for, when the result is accepted.
    """

    result: LocalizationResult
    map_id: str = ''
    stamp_ns: int = 0
    pose: RobotPose | None = None


def answered(answer: Answer) -> Future:
    """A future that has its answer."""
    future = Future()
    future.set_result(answer)
    return future


class _Stage(Enum):
    WAITS_FOR_IMAGE = auto()
    HAS_IMAGE = auto()
    UNDER_WAY = auto()


@dataclass
class _Request:
    future: Future
    stage: _Stage
    timer: Timer


class CameraRequests:
    """Requests for a pose from the next image of the node's own camera."""

    def __init__(self, node: Node, why_late: Callable[[bool], LocalizationResult]) -> None:
        """No request yet.

        Args:
            node: Whose executor runs the time-outs.
            why_late: The outcome of a request that waited too long; told whether an image came.
        """
        self._node = node
        self._why_late = why_late
        # the caller's patience goes by his own time, and /clock may stand still
        self._clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._requests: list[_Request] = []

    def add(self, timeout_s: float) -> Future:
        """A new request, for an image that has not come yet.

        Args:
            timeout_s: How long to wait for the attempt to begin.

        Returns:
            The future of an `Answer`.
        """
        if len(self._requests) >= MAX_WAITING:
            reason = f'{MAX_WAITING} requests are waiting already; ask again later'
            return answered(Answer(LocalizationResult(Status.BUSY, reason)))
        future = Future()
        timer = self._node.create_timer(timeout_s, partial(self._expire, future), clock=self._clock)
        self._requests.append(_Request(future, _Stage.WAITS_FOR_IMAGE, timer))
        return future

    def image_came(self) -> bool:
        """An image has come; hands back whether a request wants it tried."""
        self._move(_Stage.WAITS_FOR_IMAGE, _Stage.HAS_IMAGE)
        return any(request.stage is _Stage.HAS_IMAGE for request in self._requests)

    def begin(self) -> None:
        """The image that came is being tried."""
        self._move(_Stage.HAS_IMAGE, _Stage.UNDER_WAY)

    def answer(self, answer: Answer) -> None:
        """The attempt is over."""
        self._answer([r for r in self._requests if r.stage is _Stage.UNDER_WAY], answer)

    def answer_all(self, answer: Answer) -> None:
        """Nothing will be tried any more."""
        self._answer(self._requests, answer)

    def _expire(self, future: Future) -> None:
        late = [request for request in self._requests if request.future is future]
        for request in late:
            request.timer.cancel()  # it would go off again
        waiting = [request for request in late if request.stage is not _Stage.UNDER_WAY]
        for request in waiting:
            result = self._why_late(request.stage is _Stage.HAS_IMAGE)
            self._answer([request], Answer(result))

    def _move(self, before: _Stage, after: _Stage) -> None:
        for request in self._requests:
            if request.stage is before:
                request.stage = after

    def _answer(self, requests: list[_Request], answer: Answer) -> None:
        self._requests = [request for request in self._requests if request not in requests]
        for request in requests:
            self._node.destroy_timer(request.timer)
            request.future.set_result(answer)


class BroughtImages:
    """Images that callers bring along, in the order in which they came."""

    def __init__(self) -> None:
        self._waiting: deque[tuple[Attempt, Future]] = deque()
        self._under_way: Future | None = None

    @property
    def ready(self) -> bool:
        """Whether there is one to try."""
        return bool(self._waiting)

    def add(self, attempt: Attempt) -> Future:
        """One more; the future of an `Answer`."""
        if len(self._waiting) >= MAX_IMAGES:
            reason = f'{MAX_IMAGES} images are waiting already; ask again later'
            return answered(Answer(LocalizationResult(Status.BUSY, reason)))
        future = Future()
        self._waiting.append((attempt, future))
        return future

    def begin(self) -> Attempt:
        """The one to try now; ask `ready` first."""
        attempt, self._under_way = self._waiting.popleft()
        return attempt

    def answer(self, answer: Answer) -> None:
        """The attempt is over; whoever has been told something else by now hears no more."""
        if self._under_way is not None:
            self._under_way.set_result(answer)
            self._under_way = None

    def answer_all(self, answer: Answer) -> None:
        """Nothing will be tried any more."""
        self.answer(answer)
        while self._waiting:
            self._waiting.popleft()[1].set_result(answer)
