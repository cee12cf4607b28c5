# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The process of the node: start, spin, and a clean end whatever ends it."""

from __future__ import annotations

import os
import signal
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.parameter import Parameter
from rclpy.utilities import ok, try_shutdown

from gam_relocalizer.errors import UsageError
from gam_relocalizer.ros.executor import GatheringExecutor
from gam_relocalizer.ros.node import RelocalizerNode

if TYPE_CHECKING:
    from collections.abc import Sequence

SIGNALS = (signal.SIGINT, signal.SIGTERM)
LONGEST_WAIT_S = 0.5
LOG_PLACES = ('ROS_LOG_DIR', 'ROS_HOME', 'HOME')


def run(args: Sequence[str], map_path: str | None = None) -> None:
    """Runs the node until SIGINT, SIGTERM or the end of the ROS context.

    Args:
        args: ROS arguments (`--ros-args ...`).
        map_path: Value of the parameter `map`, before that of `args`.

    Raises:
        UsageError: Arguments or parameters that cannot be used.
    """
    _give_logs_a_place()
    overrides = [] if map_path is None else [Parameter('map', value=map_path)]
    _leave_signals_to_ros()
    _init(args)
    node = None
    try:
        node = RelocalizerNode(overrides)
        node.start()
        _spin(node)
    except ExternalShutdownException:
        pass
    except Exception:
        if ok():  # else it is an echo of the shutdown: everything fails without a context
            raise
    finally:
        if node is not None:
            node.destroy_node()
        try_shutdown()
        for number in SIGNALS:  # Python gives its own handlers back before it is gone itself
            signal.signal(number, signal.SIG_IGN)


def _leave_signals_to_ros() -> None:
    """Makes SIGINT and SIGTERM do nothing but what ROS adds: shut its context down.

    A launch file sends several in a row. Python would raise KeyboardInterrupt wherever it is, in
    the middle of the clean-up too, and the logging library inside pycolmap aborts on SIGTERM.
    """
    for number in SIGNALS:
        signal.signal(number, lambda _number, _frame: None)


def _init(args: Sequence[str]) -> None:
    try:
        rclpy.init(args=list(args))
    except (
        rclpy_implementation.UnknownROSArgsError,
        rclpy_implementation.RCLError,
    ) as err:
        msg = f'ROS arguments {" ".join(args)}: {err}'
        raise UsageError(msg) from err


def _spin(node: RelocalizerNode) -> None:
    """Spins until the context ends."""
    executor = GatheringExecutor()
    executor.add_node(node)
    while ok():
        _spin_once(executor, node)


def _spin_once(executor: GatheringExecutor, node: RelocalizerNode) -> None:
    """Waits for something to do, and does it.

    The wait is bounded: now and then the end of the context wakes no wait that is about to begin,
    and under a clock that stands still nothing else would wake it either.

    A request for a transition that the present state does not allow raises in rclpy's own callback,
    and must not end the node.
    """
    try:
        executor.spin_once(timeout_sec=LONGEST_WAIT_S)
    except rclpy_implementation.RCLError as err:
        if not ok() or 'transition' not in str(err):
            raise
        node.get_logger().error(f'request refused: {err}')


def _give_logs_a_place() -> None:
    """ROS refuses to start when it knows no folder for its logs, as under a bare service."""
    if not any(os.environ.get(name) for name in LOG_PLACES):
        os.environ['ROS_LOG_DIR'] = str(Path(tempfile.gettempdir(), 'gam_relocalizer_log'))
