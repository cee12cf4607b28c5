# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Feeds what is known beside the images: odometry, and where somebody says that the robot is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.localization.continuity import is_odometry_of
from gam_relocalizer.localization.robot_pose import RobotPose
from gam_relocalizer.replay.messages import rigid_in
from gam_relocalizer.ros.conversions import nanoseconds_from
from gam_relocalizer.ros.inputs import incompatible_qos
from gam_relocalizer.ros.interface import Topic

if TYPE_CHECKING:
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from nav_msgs.msg import Odometry
    from rclpy.node import Node

    from gam_relocalizer.localization.continuity import Continuity
    from gam_relocalizer.ros.health import Health
    from gam_relocalizer.ros.parameters import NodeParameters

SAY_EACH_S = 10.0
SAY_INITIAL_POSE_EACH_S = 1.0


class PriorListener:
    """Subscribes to `odom` and `initialpose`."""

    def __init__(
        self, node: Node, parameters: NodeParameters, continuity: Continuity, health: Health
    ) -> None:
        self._node = node
        self._log = node.get_logger()
        self._map_frame = parameters.map_frame
        self._base_frame = parameters.base_frame
        self._continuity = continuity
        self._health = health
        self._odometry_frame: str | None = None
        self._odometry = node.create_subscription(
            Topic.ODOMETRY.kind, Topic.ODOMETRY.topic, self._on_odometry, Topic.ODOMETRY.qos
        )
        topic = node.resolve_topic_name(Topic.INITIAL_POSE.topic)
        cure = 'publish it reliably'
        self._initial_pose = node.create_subscription(
            Topic.INITIAL_POSE.kind,
            topic,
            self._on_initial_pose,
            Topic.INITIAL_POSE.qos,
            event_callbacks=incompatible_qos(node, topic, cure),
        )

    @property
    def odometry_topic(self) -> str:
        """Resolved name of the topic of the odometry."""
        name: str = self._odometry.topic_name
        return name

    @property
    def odometry_frame(self) -> str | None:
        """Frame that the odometry in use is in; None before any has come."""
        return self._odometry_frame

    def destroy(self) -> None:
        """Ends the subscriptions."""
        self._node.destroy_subscription(self._odometry)
        self._node.destroy_subscription(self._initial_pose)

    def _on_odometry(self, message: Odometry) -> None:
        if not is_odometry_of(message.child_frame_id, self._base_frame):
            self._health.odometry_was_of(message.child_frame_id)
            self._say_other_body(message.child_frame_id)
            return
        try:
            odom_from_base = rigid_in(message.pose.pose.position, message.pose.pose.orientation)
        except ValueError as err:
            self._log.warning(
                f'ignored from {self.odometry_topic}: a pose that is none: {err}',
                throttle_duration_sec=SAY_EACH_S,
            )
            return
        self._follow(message.header.frame_id.strip('/'))
        self._health.odometry_came()
        self._continuity.add_odometry(nanoseconds_from(message.header.stamp), odom_from_base)

    def _follow(self, frame: str) -> None:
        """Starts anew with another frame: what is known of one says nothing about another."""
        if self._odometry_frame not in {None, frame}:
            self._continuity.clear()
            self._log.warning(
                f'the odometry on {self.odometry_topic} was in frame `{self._odometry_frame}` and '
                f'is in `{frame}` now: starting anew; if this comes again, two publish there',
                throttle_duration_sec=SAY_EACH_S,
            )
        self._odometry_frame = frame

    def _say_other_body(self, child_frame: str) -> None:
        body = f'`{self._base_frame}`' if self._base_frame else 'the camera'
        self._log.warning(
            f'the odometry on {self.odometry_topic} is that of `{child_frame}`, the poses are '
            f'those of {body}: it is not used; set `base_frame` to `{child_frame}`, or remap '
            f'`odom` to odometry of {body}',
            once=True,
        )

    def _on_initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        topic, frame = self._initial_pose.topic_name, message.header.frame_id.strip('/')
        if frame != self._map_frame.strip('/'):
            self._log.warning(
                f'ignored from {topic}: a pose in frame `{frame}`; expected one in '
                f'`{self._map_frame}` (in RViz: the fixed frame)'
            )
            return
        covariance = np.array(message.pose.covariance, dtype=np.float64).reshape(6, 6)
        try:
            map_from_base = rigid_in(message.pose.pose.position, message.pose.pose.orientation)
        except ValueError as err:
            self._log.warning(f'ignored from {topic}: a pose that is none: {err}')
            return
        if not np.isfinite(covariance).all() or (np.diag(covariance) < 0).any():
            self._log.warning(
                f'ignored from {topic}: a covariance with negative variances, or numbers that '
                f'are not finite'
            )
            return
        self._continuity.suggest(RobotPose(map_from_base, covariance))
        x, y, z = map_from_base.translation
        self._log.info(
            f'looking around {x:.3f} {y:.3f} {z:.3f} first, from {topic}',
            throttle_duration_sec=SAY_INITIAL_POSE_EACH_S,
        )
