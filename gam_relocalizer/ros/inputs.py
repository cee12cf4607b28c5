# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The subscriptions to images and calibrations."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_policy_name_from_kind

from gam_relocalizer.ros.interface import Topic

if TYPE_CHECKING:
    from collections.abc import Callable

    from rclpy.node import Node
    from sensor_msgs.msg import CameraInfo

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
        image = Topic.COMPRESSED_IMAGE if compressed else Topic.IMAGE
        # image transports append to the name that `image` is remapped to
        suffix = image.topic.removeprefix(Topic.IMAGE.topic)
        topic = node.resolve_topic_name(Topic.IMAGE.topic) + suffix
        self._image = node.create_subscription(
            image.kind,
            topic,
            on_image,
            QoSProfile(
                depth=image.qos.depth,
                reliability=ReliabilityPolicy[parameters.image_reliability.upper()],
            ),
            event_callbacks=incompatible_qos(
                node,
                topic,
                'set the parameter `image_reliability` to best_effort, or have it publish reliable',
            ),
        )
        self._camera_info = node.create_subscription(
            Topic.CAMERA_INFO.kind,
            Topic.CAMERA_INFO.topic,
            on_camera_info,
            Topic.CAMERA_INFO.qos,
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
