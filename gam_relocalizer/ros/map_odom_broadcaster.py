# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Broadcasts map -> odom: where the frame of the odometry lies in the map (REP-105).

What others read between two fixes is the last one, so it is broadcast again and again. Its stamp
lies ahead of the clock: tf2 extrapolates nothing, and a lookup at this moment must find it.
"""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING

from geometry_msgs.msg import Transform, TransformStamped, Vector3
from std_msgs.msg import Header

from gam_relocalizer.ros.conversions import nanoseconds_from, pose_message, stamp_from
from gam_relocalizer.ros.interface import TFMessage, Topic

if TYPE_CHECKING:
    import pycolmap
    from rclpy.node import Node
    from rclpy.publisher import Publisher
    from rclpy.timer import Timer

    from gam_relocalizer.localization.continuity import Continuity
    from gam_relocalizer.ros.health import Health
    from gam_relocalizer.ros.parameters import NodeParameters
    from gam_relocalizer.ros.prior_listener import PriorListener
    from gam_relocalizer.ros.transform_listener import TransformListener

# A frame that somebody else has moved so recently [s] is his: some broadcast at 1 Hz only.
RIVAL_S = 5.0
# So many may be under way to ourselves: as many as a publisher and a subscription keep.
REMEMBERED = 2 * Topic.MAP_ODOM.qos.depth
SAY_EACH_S = 10.0
# Nothing is missed before publishers have had so long to be found [s].
PATIENCE_S = 1.0


class MapOdomBroadcaster:
    """Broadcasts the correction of the odometry, if `publish_map_odom` says so.

    Falls silent while somebody else broadcasts the same frame: with two owners a robot jumps
    between two worlds.
    """

    def __init__(
        self,
        node: Node,
        parameters: NodeParameters,
        continuity: Continuity,
        prior_listener: PriorListener,
        transforms: TransformListener,
        health: Health,
    ) -> None:
        self._node = node
        self._log = node.get_logger()
        self._parameters = parameters
        self._continuity = continuity
        self._prior_listener = prior_listener
        self._health = health
        self._owners = Owners()
        self._stamps = RisingStamps()
        self._began_s = time.monotonic()
        self._said, self._said_s = '', -math.inf
        self._publisher: Publisher | None = None
        self._timer: Timer | None = None
        if not parameters.publish_map_odom:
            return
        transforms.watch(self._on_transform)
        if TFMessage is None:  # the listener has said so
            return
        self._publisher = node.create_publisher(
            Topic.MAP_ODOM.kind, Topic.MAP_ODOM.topic, Topic.MAP_ODOM.qos
        )
        self._timer = node.create_timer(1.0 / parameters.map_odom_rate, self._on_tick)

    @property
    def has_rival(self) -> bool:
        """Whether somebody else broadcasts that frame, so that this node does not."""
        return self._owners.has_rival(self._child_frame, time.monotonic())

    def use(self, parameters: NodeParameters) -> None:
        """Takes other parameters from now on."""
        if self._timer is not None and parameters.map_odom_rate != self._parameters.map_odom_rate:
            self._timer.timer_period_ns = round(1e9 / parameters.map_odom_rate)
            self._timer.reset()
        self._parameters = parameters

    def destroy(self) -> None:
        """Ends the broadcasts."""
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
        if self._publisher is not None:
            self._node.destroy_publisher(self._publisher)

    @property
    def _map_frame(self) -> str:
        return self._parameters.map_frame.strip('/')

    @property
    def _child_frame(self) -> str:
        """Frame of the odometry; empty while it is not known."""
        return self._prior_listener.odometry_frame or ''

    def _on_transform(self, transform: TransformStamped, static: bool) -> None:  # noqa: FBT001 - of a callback
        self._owners.heard(transform, time.monotonic(), static=static)

    def _on_tick(self) -> None:
        obstacle = self._obstacle()
        if obstacle:
            self._say(obstacle, time.monotonic())
        correction = None if obstacle else self._continuity.correction
        if correction is not None:
            self._broadcast(correction.map_from_odom)
        self._health.map_to_odom_was_due(obstacle, sent=correction is not None)

    def _say(self, obstacle: str, now_s: float) -> None:
        """Says it when it is a new one, and then now and then."""
        is_new = obstacle != self._said
        if now_s < self._began_s + PATIENCE_S or (not is_new and now_s < self._said_s + SAY_EACH_S):
            return
        self._said, self._said_s = obstacle, now_s
        self._log.warning(f'`publish_map_odom` is on, and nothing is broadcast: {obstacle}')

    def _obstacle(self) -> str:
        """Why nothing can be broadcast whatever the fixes are, and what to do; empty if it can."""
        topic, child_frame = self._prior_listener.odometry_topic, self._child_frame
        if not self._continuity.options.metric:
            return 'the map is not metric, odometry is; build it with `--poses`'
        if self._prior_listener.odometry_frame is None:
            publishers = self._node.count_publishers(topic)
            return (
                f'no odometry of `{self._parameters.base_frame}` has come on {topic} yet '
                f'({publishers} publishers); remap it with `-r odom:=/your/topic`'
            )
        if child_frame in {'', self._map_frame}:
            return (
                f'the odometry on {topic} is in frame `{child_frame}`; expected the name of a '
                f'frame (its header.frame_id) other than `{self._map_frame}`, such as `odom`'
            )
        if self.has_rival:
            return (
                f'somebody else broadcasts the frame `{child_frame}` (a filter, AMCL, SLAM, a '
                f'static transform, or a bag): it has one owner; end that one, or set '
                f'`publish_map_odom` to false'
            )
        return ''

    def _broadcast(self, map_from_odom: pycolmap.Rigid3d) -> None:
        stamp_ns = self._stamps.next(
            self._node.get_clock().now().nanoseconds, self._parameters.transform_tolerance
        )
        if stamp_ns is None or self._publisher is None:
            return
        pose = pose_message(map_from_odom)
        position = Vector3(x=pose.position.x, y=pose.position.y, z=pose.position.z)
        transform = TransformStamped(
            header=Header(stamp=stamp_from(stamp_ns), frame_id=self._map_frame),
            child_frame_id=self._child_frame,
            transform=Transform(translation=position, rotation=pose.orientation),
        )
        self._owners.sent(transform)
        self._publisher.publish(TFMessage(transforms=[transform]))


class RisingStamps:
    """Stamps ahead of the clock that rise strictly until time jumps back.

    tf2 warns about every stamp that comes twice, as it would while /clock is paused.
    """

    def __init__(self) -> None:
        self._now_ns = 0
        self._last_ns = 0

    def next(self, now_ns: int, ahead_s: float) -> int | None:
        """The next stamp [ns].

        Args:
            now_ns: The clock [ns].
            ahead_s: How far ahead of it [s].

        Returns:
            None when there is no later one than the last.
        """
        if now_ns < self._now_ns:
            self._last_ns = 0
        self._now_ns = now_ns
        stamp_ns = now_ns + round(ahead_s * 1e9)
        if stamp_ns <= self._last_ns:
            return None
        self._last_ns = stamp_ns
        return stamp_ns


class Owners:
    """Remembers which frames others broadcast.

    What this node broadcasts comes back to it like all else on /tf. It is told apart by its
    content, so a relay or a bridge that repeats it is no rival.
    """

    def __init__(self) -> None:
        self._sent: dict[int, TransformStamped] = {}
        self._owned_until: dict[str, float] = {}

    def sent(self, transform: TransformStamped) -> None:
        """Remembers one of our own, the last `REMEMBERED` of them."""
        self._sent[nanoseconds_from(transform.header.stamp)] = transform
        if len(self._sent) > REMEMBERED:
            del self._sent[next(iter(self._sent))]

    def heard(self, transform: TransformStamped, now_s: float, *, static: bool) -> None:
        """Takes in what was heard of whomever.

        Args:
            transform: The transform.
            now_s: The time by whatever clock that never goes back [s].
            static: Whether it holds for good.
        """
        if self._sent.get(nanoseconds_from(transform.header.stamp)) == transform:
            return
        child_frame = transform.child_frame_id.strip('/')
        until = math.inf if static else now_s + RIVAL_S
        self._owned_until[child_frame] = max(until, self._owned_until.get(child_frame, until))

    def has_rival(self, child_frame: str, now_s: float) -> bool:
        """Whether somebody else has broadcast a frame within the last `RIVAL_S`, or for good."""
        return self._owned_until.get(child_frame, -math.inf) > now_s
