# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Feeds a tree of transforms from /tf and /tf_static."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

from gam_relocalizer.errors import TransformError
from gam_relocalizer.ros.conversions import nanoseconds_from, rigid3d_from_message
from gam_relocalizer.ros.inputs import incompatible_qos
from gam_relocalizer.ros.interface import TFMessage, Topic
from gam_relocalizer.transforms import TransformTree

if TYPE_CHECKING:
    from collections.abc import Callable

    from geometry_msgs.msg import TransformStamped
    from rclpy.node import Node
    from rclpy.subscription import Subscription

    # is called with a transform, and whether it is a static one
    Watcher = Callable[[TransformStamped, bool], None]

WARN_EACH_S = 10.0


class TransformListener:
    """Subscribes to /tf and /tf_static as soon as somebody wants to know."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self.tree = TransformTree()
        self._watchers: list[Watcher] = []
        self._subscriptions: list[Subscription] = []
        self._listens = False

    def listen(self) -> None:
        """Subscribes, from the first call on."""
        if self._listens:
            return
        self._listens = True
        if TFMessage is None:
            self._node.get_logger().warning(
                'the package tf2_msgs is not installed, so /tf and /tf_static can be neither read '
                'nor written: install it, or give the mount of the camera in the parameter '
                '`base_from_camera` and leave `publish_map_odom` off'
            )
            return
        self._subscribe(Topic.TF, static=False)
        self._subscribe(Topic.TF_STATIC, static=True)

    def watch(self, watcher: Watcher) -> None:
        """Subscribes, and shows somebody every transform as it comes."""
        self._watchers.append(watcher)
        self.listen()

    def destroy(self) -> None:
        """Ends the subscriptions."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions.clear()

    def _subscribe(self, topic: Topic, *, static: bool) -> None:
        name = self._node.resolve_topic_name(topic.topic)
        cure = f'publish {topic.topic} as tf2_ros does'
        self._subscriptions.append(
            self._node.create_subscription(
                topic.kind,
                name,
                partial(self._take_in, topic=name, static=static),
                topic.qos,
                event_callbacks=incompatible_qos(self._node, name, cure),
            )
        )

    def _take_in(self, message: Any, *, topic: str, static: bool) -> None:  # noqa: ANN401 - optional type
        for transform in message.transforms:
            self._take_in_one(transform, topic, static=static)
            for watcher in self._watchers:
                watcher(transform, static)

    def _take_in_one(self, transform: TransformStamped, topic: str, *, static: bool) -> None:
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
                f'ignored from {topic}: {err}', throttle_duration_sec=WARN_EACH_S
            )
