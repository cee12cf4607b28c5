# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""A quieter executor, for a node that hears hundreds of messages per second and needs few."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from rclpy.event_handler import EventHandler
from rclpy.executors import SingleThreadedExecutor

if TYPE_CHECKING:
    from collections.abc import Generator

    from rclpy.subscription import Subscription

# So long messages may gather before they are handled together [s].
PAUSE_S = 0.01
# Publishers and subscriptions that do not fit each other are noticed so often [s].
EVENTS_EACH_S = 0.5
# Taken of one subscription in a row; the other ones have their turn after that.
MOST_IN_A_ROW = 100


class GatheringExecutor(SingleThreadedExecutor):
    """Handles what has come by up to 100 times per second, all of it, instead of one by one.

    rclpy builds its set of everything that may be waited for anew for each wait, in Python, and
    takes one message of each topic out of it. For images, their calibration, odometry and /tf that
    takes more time than the messages themselves.

    An idle executor answers at once. Events of quality of service are looked for twice a second,
    if it is never told to wait for longer than that.
    """

    _events_are_due = True
    _next_events_s = 0.0

    def can_execute(self, entity: Any) -> bool:  # noqa: ANN401 - all kinds of entities
        """Leaves out of the wait what is looked for less often."""
        if not self._events_are_due and isinstance(entity, EventHandler):
            return False
        return bool(super().can_execute(entity))

    def _wait_for_ready_callbacks(self, *args: Any, **kwargs: Any) -> Generator[Any, None, None]:  # noqa: ANN401
        time.sleep(PAUSE_S)
        now = time.monotonic()
        self._events_are_due = now >= self._next_events_s
        if self._events_are_due:
            self._next_events_s = now + EVENTS_EACH_S
        yield from super()._wait_for_ready_callbacks(*args, **kwargs)

    def _take_subscription(self, sub: Subscription) -> Any:  # noqa: ANN401 - rclpy's
        take = super()._take_subscription
        first = take(sub)
        if first is None:
            return None

        async def handle_all() -> None:
            handle = first
            for _ in range(MOST_IN_A_ROW):
                await handle()
                handle = take(sub)
                if handle is None:
                    return
            await handle()

        return handle_all
