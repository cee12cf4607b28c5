# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.parameter import Parameter

from gam_relocalizer.ros.conditions import diagnose
from gam_relocalizer.ros.diagnostics import Diagnostics
from gam_relocalizer.ros.health import Health

if TYPE_CHECKING:
    from rclpy.node import Node
    from ros_graph import Graph


def first_report(graph: Graph, node: Node, health: Health) -> DiagnosticArray:
    heard: list[DiagnosticArray] = []
    graph.world.create_subscription(DiagnosticArray, '/diagnostics', heard.append, 10)
    Diagnostics(node, health)

    def spun() -> bool:
        rclpy.spin_once(node, timeout_sec=0.01)
        return bool(heard)

    graph.spin_until(spun, 'a report')
    node.destroy_node()
    return heard[0]


def test_nodes_of_two_robots_have_names_of_their_own(graph: Graph) -> None:
    report = first_report(graph, rclpy.create_node('relocalizer', namespace='/front'), Health())
    expected = [f'front/relocalizer: {one.part.value}' for one in diagnose(Health())]
    assert [status.name for status in report.status] == expected
    assert {status.hardware_id for status in report.status} == {'/front/image'}


def test_level_message_and_values_are_those_of_the_diagnosis(graph: Graph) -> None:
    health = Health()
    health.failed('points.npy is damaged')
    state = first_report(graph, rclpy.create_node('relocalizer'), health).status[0]
    expected = diagnose(health)[0]
    assert state.level == DiagnosticStatus.ERROR
    assert state.message == expected.message
    assert [(pair.key, pair.value) for pair in state.values] == [
        (value.key, value.text) for value in expected.values
    ]


def test_reports_come_while_the_clock_of_the_node_stands(graph: Graph) -> None:
    overrides = [Parameter('use_sim_time', value=True)]
    node = rclpy.create_node('relocalizer', parameter_overrides=overrides)
    report = first_report(graph, node, Health())
    assert (report.header.stamp.sec, report.header.stamp.nanosec) == (0, 0)
