# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The subscriptions to images and calibrations."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import (
    DurabilityPolicy,
    QoSProfile,
    ReliabilityPolicy,
    qos_policy_name_from_kind,
)
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

if TYPE_CHECKING:
    from collections.abc import Callable

    from rclpy.node import Node

    from gam_relocalizer.ros.parameters import NodeParameters


class Inputs:
    """Subscribes to the images of one camera and to its calibration."""

    def __init__(
        self,
        node: Node,
        parameters: NodeParameters,
        on_image: Callable[[Any], None],
        on_camera_info: Callable[[CameraInfo], None],
    ) -> None:
        self._node = node
        compressed = parameters.image_transport == 'compressed'
        # image transports append to the name that `image` is remapped to
        topic = node.resolve_topic_name('image') + ('/compressed' if compressed else '')
        self._image = node.create_subscription(
            CompressedImage if compressed else Image,
            topic,
            on_image,
            _sensor_data(ReliabilityPolicy[parameters.image_reliability.upper()]),
            event_callbacks=incompatible_qos(
                node,
                topic,
                'set the parameter `image_reliability` to best_effort, or have it publish reliable',
            ),
        )
        self._camera_info = node.create_subscription(
            CameraInfo, 'camera_info', on_camera_info, _sensor_data(ReliabilityPolicy.BEST_EFFORT)
        )

    @property
    def image_topic(self) -> str:
        """Resolved name of the topic of the images."""
        name: str = self._image.topic_name
        return name

    @property
    def camera_info_topic(self) -> str:
        """Resolved name of the topic of the calibration."""
        name: str = self._camera_info.topic_name
        return name

    def destroy(self) -> None:
        """Ends the subscriptions."""
        self._node.destroy_subscription(self._image)
        self._node.destroy_subscription(self._camera_info)


def incompatible_qos(node: Node, topic: str, cure: str) -> SubscriptionEventCallbacks:
    """Says in the log which publisher is not heard, and what to change."""

    def report(event: Any) -> None:  # noqa: ANN401 - a type of the extension module
        policy = qos_policy_name_from_kind(event.last_policy_kind)
        node.get_logger().warning(
            f'nothing will be received from a publisher on {topic}: its quality of service '
            f'({policy}) is not compatible; {cure}'
        )

    return SubscriptionEventCallbacks(incompatible_qos=report)


def _sensor_data(reliability: ReliabilityPolicy) -> QoSProfile:
    """SensorDataQoS with room for the newest message alone."""
    return QoSProfile(depth=1, reliability=reliability, durability=DurabilityPolicy.VOLATILE)
