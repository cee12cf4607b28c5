# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What the node publishes."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any

from nav_msgs.msg import Path
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.qos import qos_policy_name_from_kind

from gam_relocalizer.ros.conversions import (
    image_message,
    point_cloud_message,
    pose_stamped_message,
    pose_with_covariance_message,
    status_message,
)
from gam_relocalizer.ros.interface import PATH_LENGTH, Topic

if TYPE_CHECKING:
    import numpy as np
    import pycolmap
    from geometry_msgs.msg import PoseStamped
    from numpy.typing import NDArray
    from rclpy.lifecycle import LifecycleNode
    from std_msgs.msg import Header

    from gam_relocalizer.localization.result import LocalizationResult
    from gam_relocalizer.localization.robot_pose import RobotPose


class Outputs:
    """The publishers; silent while the node is not active."""

    def __init__(self, node: LifecycleNode) -> None:

        def create(topic: Topic) -> Any:  # noqa: ANN401 - untyped
            return node.create_lifecycle_publisher(
                topic.kind, topic.topic, topic.qos, event_callbacks=_incompatible_qos(node, topic)
            )

        self._pose = create(Topic.POSE)
        self._camera_pose = create(Topic.CAMERA_POSE)
        self._status = create(Topic.STATUS)
        self._path = create(Topic.PATH)
        self._map_points = create(Topic.MAP_POINTS)
        self._debug_image = create(Topic.DEBUG_IMAGE)
        self._fixes: deque[PoseStamped] = deque(maxlen=PATH_LENGTH)

    def publish_fix(
        self, header: Header, robot_pose: RobotPose, camera_from_map: pycolmap.Rigid3d
    ) -> None:
        """An accepted pose: that of the base, that of the camera, and the path so far.

        Args:
            header: Stamp of the image, frame of the map.
            robot_pose: Pose of the base.
            camera_from_map: Pose of the camera.
        """
        self._pose.publish(pose_with_covariance_message(robot_pose, header))
        self._camera_pose.publish(pose_stamped_message(camera_from_map.inverse(), header))
        self._fixes.append(pose_stamped_message(robot_pose.map_from_base, header))
        if self._path.get_subscription_count():
            self._path.publish(Path(header=header, poses=list(self._fixes)))

    def publish_status(self, header: Header, result: LocalizationResult, map_id: str) -> None:
        """The verdict on an attempt."""
        self._status.publish(status_message(result, header, map_id))

    def publish_map_points(self, header: Header, points: NDArray[np.float64]) -> None:
        """Points [N,3] of the map; late subscribers get them as well."""
        self._map_points.publish(point_cloud_message(points, header))

    @property
    def debug_image_is_wanted(self) -> bool:
        """Whether somebody listens: drawing costs time."""
        return bool(self._debug_image.get_subscription_count())

    def publish_debug_image(self, header: Header, picture: NDArray[np.uint8]) -> None:
        """A picture [H,W,3] of an attempt."""
        self._debug_image.publish(image_message(picture, header))

    def forget_path(self) -> None:
        """Starts the path anew."""
        self._fixes.clear()


def _incompatible_qos(node: LifecycleNode, topic: Topic) -> PublisherEventCallbacks:
    """Says in the log which listener is not served, and what to change."""
    name = node.resolve_topic_name(topic.topic)
    policies = topic.qos.reliability, topic.qos.durability
    reliability, durability = (policy.name.lower() for policy in policies)

    def report(event: Any) -> None:  # noqa: ANN401 - a type of the extension module
        policy = qos_policy_name_from_kind(event.last_policy_kind)
        node.get_logger().warning(
            f'nothing will be sent to a subscription to {name}: its quality of service '
            f'({policy}) is not compatible; subscribe with reliability {reliability} and '
            f'durability {durability}'
        )

    return PublisherEventCallbacks(incompatible_qos=report)
