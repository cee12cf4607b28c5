# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Feeds a tree of transforms from /tf and /tf_static."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from gam_relocalizer.errors import TransformError
from gam_relocalizer.ros.conversions import nanoseconds_from, rigid3d_from_message
from gam_relocalizer.ros.inputs import incompatible_qos
from gam_relocalizer.transforms import TransformTree

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # an installation of ROS 2 from pip has no tf2_msgs of its own
    TFMessage = None

if TYPE_CHECKING:
    from geometry_msgs.msg import TransformStamped
    from rclpy.node import Node
    from rclpy.subscription import Subscription

# Those of tf2_ros.
TF_QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
TF_STATIC_QOS = QoSProfile(
    depth=100,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
WARN_EACH_S = 10.0


class TransformListener:
    """Subscribes to /tf and /tf_static."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self.tree = TransformTree()
        self._subscriptions: list[Subscription] = []
        if TFMessage is None:
            node.get_logger().warning(
                'the package tf2_msgs is not installed, so /tf and /tf_static cannot be read: '
                'install it, or give the mount of the camera in the parameter `base_from_camera`'
            )
            return
        self._subscribe('/tf', TF_QOS, static=False)
        self._subscribe('/tf_static', TF_STATIC_QOS, static=True)

    def destroy(self) -> None:
        """Ends the subscriptions."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions.clear()

    def _subscribe(self, topic: str, qos: QoSProfile, *, static: bool) -> None:
        cure = f'publish {topic} as tf2_ros does'
        self._subscriptions.append(
            self._node.create_subscription(
                TFMessage,
                topic,
                partial(self._take_in, static=static),
                qos,
                event_callbacks=incompatible_qos(self._node, topic, cure),
            )
        )

    def _take_in(self, message: Any, *, static: bool) -> None:  # noqa: ANN401 - optional type
        for transform in message.transforms:
            self._take_in_one(transform, static=static)

    def _take_in_one(self, transform: TransformStamped, *, static: bool) -> None:
        try:
            self.tree.add(
                transform.header.frame_id,
                transform.child_frame_id,
                rigid3d_from_message(transform.transform),
                nanoseconds_from(transform.header.stamp),
                static=static,
            )
        except TransformError as err:
            self._node.get_logger().warning(
                f'ignored from {"/tf_static" if static else "/tf"}: {err}',
                throttle_duration_sec=WARN_EACH_S,
            )
