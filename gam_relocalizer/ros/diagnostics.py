# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Publishes on /diagnostics, once a second and in every state of the node."""

from __future__ import annotations

from typing import TYPE_CHECKING

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from std_msgs.msg import Header

from gam_relocalizer.ros.conditions import diagnose
from gam_relocalizer.ros.interface import Topic

if TYPE_CHECKING:
    from rclpy.node import Node

    from gam_relocalizer.ros.conditions import Diagnosis
    from gam_relocalizer.ros.health import Health

EACH_S = 1.0


class Diagnostics:
    """Reports the health of a node, until the node is destroyed.

    By a steady clock: the reports come while the clock of the node stands, too, and say so.
    """

    def __init__(self, node: Node, health: Health) -> None:
        self._node = node
        self._health = health
        # a lifecycle publisher would be silent when there is most to say
        self._publisher = node.create_publisher(
            Topic.DIAGNOSTICS.kind, Topic.DIAGNOSTICS.topic, Topic.DIAGNOSTICS.qos
        )
        # the names of two robots' nodes differ in their namespaces only
        self._name = node.get_fully_qualified_name().lstrip('/')
        self._hardware = node.resolve_topic_name(Topic.IMAGE.topic)
        node.create_timer(EACH_S, self._report, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _report(self) -> None:
        now = self._node.get_clock().now()
        self._health.observe(now.nanoseconds, self._image_publishers())
        statuses = [self._message(diagnosis) for diagnosis in diagnose(self._health)]
        self._publisher.publish(DiagnosticArray(header=Header(stamp=now.to_msg()), status=statuses))

    def _image_publishers(self) -> int:
        activity = self._health.activity
        return 0 if activity is None else self._node.count_publishers(activity.images.topic)

    def _message(self, diagnosis: Diagnosis) -> DiagnosticStatus:
        return DiagnosticStatus(
            level=bytes([diagnosis.level.value]),
            name=f'{self._name}: {diagnosis.part.value}',
            message=diagnosis.message,
            hardware_id=self._hardware,
            values=[KeyValue(key=value.key, value=value.text) for value in diagnosis.values],
        )
