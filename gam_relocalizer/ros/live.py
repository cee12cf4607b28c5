# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Runs the real node as its own process, plays a bag into it over DDS, and collects its answers."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.utilities import try_shutdown

from gam_relocalizer.errors import RelocalizerError
from gam_relocalizer.geometry import rigid3d_from
from gam_relocalizer.localization.result import Status
from gam_relocalizer.localization.robot_pose import RobotPose
from gam_relocalizer.replay.bag import nanoseconds
from gam_relocalizer.replay.summary import Row
from gam_relocalizer.ros.player import BagPlayer
from gam_relocalizer_msgs.msg import RelocalizationStatus

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    import pycolmap
    from rclpy.node import Node

NODE_NAME = 'gam_relocalizer'
PLAYED_TOPICS = ('/tf_static', '/odom', '/camera/image', '/camera/camera_info')
START_LIMIT_S = 90.0
ANSWER_LIMIT_S = 20.0
QUIET_S = 3.0
# Our side knows of a match before the node does, in one start of twenty by up to 3.5 s.
SETTLE_S = 5.0
STOP_LIMIT_S = 20.0


@dataclass(frozen=True)
class LiveOptions:
    """How to run the node.

    Attributes:
        period: Seconds between attempts (bag time).
        truth: map_from_base by stamp [ns], for the rows.
        rate: Bag seconds per second of the wall clock.
        torch_threads: Threads of the node's network.
    """

    period: float
    truth: Mapping[int, pycolmap.Rigid3d]
    rate: float = 1.0
    torch_threads: int = 2


def run_live(
    bag: Path,
    map_path: Path,
    log: Path,
    options: LiveOptions,
    on_answer: Callable[[Row], None],
) -> tuple[Row, ...]:
    """Starts the node, plays the bag, stops the node.

    Args:
        bag: A bag with the topics in `PLAYED_TOPICS`.
        map_path: The map bundle that the node loads.
        log: File for the output of the node.
        options: How to run.
        on_answer: Called from another thread as soon as an attempt is complete.

    Returns:
        One row per attempt, in the order of their stamps.

    Raises:
        RelocalizerError: The node does not come up, dies, or does not stop cleanly.
    """
    with _ros_node('gam_relocalizer_player') as node:
        listener = _Listener(node, options.truth, on_answer)
        player = BagPlayer(node, bag, PLAYED_TOPICS)
        with node_process(map_path, log, options) as process:
            _wait_until_listening(player, process, log)
            player.play(options.rate)
            listener.wait_for_the_last()
    return listener.answers()


@contextmanager
def node_process(
    map_path: Path, log: Path, options: LiveOptions
) -> Iterator[subprocess.Popen[bytes]]:
    """The node as its own process; stopped with SIGINT, as a launch file or Ctrl-C would.

    Raises:
        RelocalizerError: It did not stop, or stopped with another exit code than 0.
    """
    command = [
        sys.executable, '-m', 'gam_relocalizer', 'node', '--map', str(map_path), '--ros-args',
        *_parameter('use_sim_time', 'true'),
        *_parameter('period', f'{options.period:.3f}'),
        *_parameter('image_reliability', 'reliable'),
        *_parameter('torch_threads', str(options.torch_threads)),
        '-r', 'image:=/camera/image',
        '-r', 'camera_info:=/camera/camera_info',
    ]  # fmt: skip
    with log.open('wb') as output:
        process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
            command, stdout=output, stderr=subprocess.STDOUT
        )
        try:
            yield process
            process.send_signal(signal.SIGINT)
            code = process.wait(timeout=STOP_LIMIT_S)
        except subprocess.TimeoutExpired as err:
            msg = f'the node did not stop within {STOP_LIMIT_S:.0f} s of SIGINT; see {log}'
            raise RelocalizerError(msg) from err
        finally:
            process.kill()
            process.wait()
    if code != 0:
        msg = f'the node ended with exit code {code}; see {log}'
        raise RelocalizerError(msg)


class _Listener:
    """Joins what the node says on its status and pose topics, by stamp."""

    def __init__(
        self,
        node: Node,
        truth: Mapping[int, pycolmap.Rigid3d],
        on_answer: Callable[[Row], None],
    ) -> None:
        self._truth = truth
        self._on_answer = on_answer
        self._statuses: dict[int, RelocalizationStatus] = {}
        self._poses: dict[int, RobotPose] = {}
        self._last_heard = time.monotonic()
        self._lock = threading.Lock()
        latched = QoSProfile(
            depth=10,
            durability=DurabilityPolicy.TRANSIENT_LOCAL,
            reliability=ReliabilityPolicy.RELIABLE,
        )
        node.create_subscription(
            PoseWithCovarianceStamped, '/relocalized_pose', self._hear_pose, latched
        )
        node.create_subscription(
            RelocalizationStatus, f'/{NODE_NAME}/status', self._hear_status, 10
        )

    def answers(self) -> tuple[Row, ...]:
        """All complete answers, in the order of their stamps."""
        with self._lock:
            return tuple(self._answer(stamp) for stamp in sorted(self._statuses))

    def wait_for_the_last(self) -> None:
        """Returns when nothing has come for a while: the clock of the bag stands still."""
        give_up = time.monotonic() + ANSWER_LIMIT_S
        while time.monotonic() < min(give_up, self._last_heard + QUIET_S):
            time.sleep(0.1)

    def _hear_status(self, message: RelocalizationStatus) -> None:
        self._note(nanoseconds(message.header.stamp), status=message)

    def _hear_pose(self, message: PoseWithCovarianceStamped) -> None:
        position, orientation = message.pose.pose.position, message.pose.pose.orientation
        pose = RobotPose(
            map_from_base=rigid3d_from(
                (orientation.w, orientation.x, orientation.y, orientation.z),
                (position.x, position.y, position.z),
            ),
            covariance=np.array(message.pose.covariance).reshape(6, 6),
        )
        self._note(nanoseconds(message.header.stamp), pose=pose)

    def _note(
        self,
        stamp_ns: int,
        *,
        status: RelocalizationStatus | None = None,
        pose: RobotPose | None = None,
    ) -> None:
        """Keeps one half of an answer, and reports the answer when both halves are there."""
        with self._lock:
            self._last_heard = time.monotonic()
            if status is not None:
                self._statuses[stamp_ns] = status
            if pose is not None:
                self._poses[stamp_ns] = pose
            heard = self._statuses.get(stamp_ns)
            complete = heard is not None and (not heard.accepted or stamp_ns in self._poses)
        if complete:
            self._on_answer(self._answer(stamp_ns))

    def _answer(self, stamp_ns: int) -> Row:
        message = self._statuses[stamp_ns]
        return Row(
            stamp_ns=stamp_ns,
            status=Status(message.status),
            reason=message.reason,
            inliers=message.inliers,
            robot_pose=self._poses.get(stamp_ns),
            truth=self._truth.get(stamp_ns),
            milliseconds={
                'extraction': message.extraction_ms,
                'retrieval': message.retrieval_ms,
                'matching': message.matching_ms,
                'pose': message.pose_ms,
                'verdict': message.verdict_ms,
            },
        )


@contextmanager
def _ros_node(name: str) -> Iterator[Node]:
    """A node of this process, spun in a thread of its own."""
    context = Context()
    rclpy.init(context=context)
    node = rclpy.create_node(name, context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    spinner = threading.Thread(target=_spin, args=(executor,), daemon=True)
    spinner.start()
    try:
        yield node
    finally:
        executor.shutdown()
        spinner.join()
        node.destroy_node()
        try_shutdown(context=context)


def _spin(executor: SingleThreadedExecutor) -> None:
    try:
        executor.spin()
    except ExternalShutdownException:
        return


def _wait_until_listening(player: BagPlayer, process: subprocess.Popen[bytes], log: Path) -> None:
    """Waits until the node subscribes to the images: from then on it is active."""
    give_up = time.monotonic() + START_LIMIT_S
    while not all(player.subscriptions(topic) for topic in PLAYED_TOPICS):
        if process.poll() is not None:
            msg = f'the node ended at once (exit code {process.returncode}); see {log}'
            raise RelocalizerError(msg)
        if time.monotonic() > give_up:
            msg = f'the node did not become active within {START_LIMIT_S:.0f} s; see {log}'
            raise RelocalizerError(msg)
        time.sleep(0.05)
    time.sleep(SETTLE_S)


def _parameter(name: str, value: str) -> Sequence[str]:
    return '-p', f'{name}:={value}'
