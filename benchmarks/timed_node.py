# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The real node, with a stopwatch around the callback of its images; started by `node_load.py`.

What the product does is not touched: the executor's way of taking a message is wrapped, and the
times go to a small file that the benchmark reads while the node runs.

    python benchmarks/timed_node.py TIMES TOPIC --ros-args ...
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rclpy.executors import SingleThreadedExecutor

from gam_relocalizer.ros.main import run

if TYPE_CHECKING:
    from collections.abc import Callable

    from rclpy.subscription import Subscription

# Of the newest images, so that the file does not grow while memory is watched.
KEPT = 4096
_COLUMNS = 3


class CallbackTimes:
    """When the newest images came, and how long they took; shared between processes by a file."""

    def __init__(self, path: Path) -> None:
        """Opens the file, which `create` made."""
        self._rows = np.memmap(path, dtype=np.float64, mode='r+', shape=(KEPT + 1, _COLUMNS))

    @classmethod
    def create(cls, path: Path) -> CallbackTimes:
        """Makes the file; no image has come yet."""
        path.write_bytes(bytes(8 * _COLUMNS * (KEPT + 1)))
        return cls(path)

    @property
    def count(self) -> int:
        """Images that have come so far."""
        return int(self._rows[0, 0])

    def add(self, taken_s: float, handled_s: float) -> None:
        """One more image.

        Args:
            taken_s: Out of DDS, deserialised and turned into a Python message [s].
            handled_s: The callback of the node [s].
        """
        count = self.count
        self._rows[1 + count % KEPT] = time.monotonic(), taken_s, handled_s
        self._rows[0, 0] = count + 1

    def since(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Seconds of taking and of handling [N] of the images since there were so many."""
        last = self.count
        rows = 1 + np.arange(max(count, last - KEPT), last) % KEPT
        return np.array(self._rows[rows, 1]), np.array(self._rows[rows, 2])


def main() -> None:
    """Runs the node until it is told to stop."""
    times, topic = CallbackTimes(Path(sys.argv[1])), sys.argv[2]
    SingleThreadedExecutor._take_subscription = _timed(  # noqa: SLF001 - there is no other way in
        SingleThreadedExecutor._take_subscription,  # noqa: SLF001
        topic,
        times,
    )
    run(sys.argv[3:])


def _timed(
    take: Callable[[SingleThreadedExecutor, Subscription], Any], topic: str, times: CallbackTimes
) -> Callable[[SingleThreadedExecutor, Subscription], Any]:
    def take_timed(executor: SingleThreadedExecutor, subscription: Subscription) -> Any:  # noqa: ANN401
        if subscription.topic_name != topic:
            return take(executor, subscription)
        begin = time.perf_counter()
        handle = take(executor, subscription)
        taken_s = time.perf_counter() - begin
        if handle is None:
            return None

        async def handle_timed() -> None:
            begin = time.perf_counter()
            await handle()
            times.add(taken_s, time.perf_counter() - begin)

        return handle_timed

    return take_timed


if __name__ == '__main__':
    main()
