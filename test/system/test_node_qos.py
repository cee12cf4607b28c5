# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The quality of service of every topic, and what the node says when somebody's does not fit."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from live_robot import LATCHED, NODE, running_node, wait_for
from nav_msgs.msg import Odometry, Path
from rclpy.qos import (
    DurabilityPolicy,
    QoSProfile,
    ReliabilityPolicy,
    qos_profile_sensor_data,
)
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from tf2_msgs.msg import TFMessage

from gam_relocalizer_msgs.msg import RelocalizationStatus

if TYPE_CHECKING:
    from collections.abc import Iterator

    from live_robot import NodeProcess, Robot
    from rclpy.topic_endpoint_info import TopicEndpointInfo
    from tiny_place import TinyPlace

RELIABLE, BEST_EFFORT = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT
VOLATILE, TRANSIENT = DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL

OUTPUTS = {
    '/relocalized_pose': ('geometry_msgs/msg/PoseWithCovarianceStamped', RELIABLE, TRANSIENT),
    f'{NODE}/status': ('gam_relocalizer_msgs/msg/RelocalizationStatus', RELIABLE, VOLATILE),
    f'{NODE}/camera_pose': ('geometry_msgs/msg/PoseStamped', RELIABLE, VOLATILE),
    f'{NODE}/debug_image': ('sensor_msgs/msg/Image', BEST_EFFORT, VOLATILE),
    f'{NODE}/map_points': ('sensor_msgs/msg/PointCloud2', RELIABLE, TRANSIENT),
    f'{NODE}/path': ('nav_msgs/msg/Path', RELIABLE, VOLATILE),
    '/diagnostics': ('diagnostic_msgs/msg/DiagnosticArray', RELIABLE, VOLATILE),
}
INPUTS = {
    '/image': ('sensor_msgs/msg/Image', BEST_EFFORT, VOLATILE),
    '/camera_info': ('sensor_msgs/msg/CameraInfo', BEST_EFFORT, VOLATILE),
    '/odom': ('nav_msgs/msg/Odometry', BEST_EFFORT, VOLATILE),
    '/initialpose': ('geometry_msgs/msg/PoseWithCovarianceStamped', RELIABLE, VOLATILE),
    '/tf': ('tf2_msgs/msg/TFMessage', RELIABLE, VOLATILE),
    '/tf_static': ('tf2_msgs/msg/TFMessage', RELIABLE, TRANSIENT),
}


@pytest.fixture(scope='module')
def running(
    tiny_place: TinyPlace, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[NodeProcess, Robot]]:
    log = tmp_path_factory.mktemp('node') / 'node.log'
    with running_node(log, tiny_place) as node_and_robot:
        yield node_and_robot


@pytest.fixture
def node(running: tuple[NodeProcess, Robot]) -> NodeProcess:
    return running[0]


@pytest.fixture
def robot(running: tuple[NodeProcess, Robot]) -> Robot:
    return running[1]


def offered(endpoints: list[TopicEndpointInfo]) -> list[tuple[str, Any, Any]]:
    """What the relocalizer offers or asks for on a topic."""
    return [
        (endpoint.topic_type, endpoint.qos_profile.reliability, endpoint.qos_profile.durability)
        for endpoint in endpoints
        if endpoint.node_name == NODE[1:]
    ]


@pytest.mark.parametrize('topic', OUTPUTS)
def test_publishers_offer_what_the_contract_says(robot: Robot, topic: str) -> None:
    endpoints = wait_for(
        lambda: offered(robot.node.get_publishers_info_by_topic(topic)), f'a publisher on {topic}'
    )
    assert endpoints == [OUTPUTS[topic]]


@pytest.mark.parametrize('topic', INPUTS)
def test_subscriptions_ask_for_what_the_contract_says(robot: Robot, topic: str) -> None:
    kind, reliability, durability = INPUTS[topic]
    if topic == '/image':
        reliability = RELIABLE  # as these tests set `image_reliability`
    endpoints = wait_for(
        lambda: offered(robot.node.get_subscriptions_info_by_topic(topic)),
        f'a subscription to {topic}',
    )
    assert endpoints == [(kind, reliability, durability)]


@pytest.mark.parametrize(
    ('topic', 'kind', 'offered_instead', 'cure'),
    [
        ('/image', Image, QoSProfile(depth=1, reliability=BEST_EFFORT), 'image_reliability'),
        (
            '/initialpose',
            PoseWithCovarianceStamped,
            QoSProfile(depth=1, reliability=BEST_EFFORT),
            'publish it reliably',
        ),
        ('/tf', TFMessage, QoSProfile(depth=1, reliability=BEST_EFFORT), 'as tf2_ros does'),
        ('/tf_static', TFMessage, QoSProfile(depth=1), 'as tf2_ros does'),
    ],
)
def test_a_publisher_that_cannot_be_heard_is_named_with_the_cure(
    robot: Robot, node: NodeProcess, topic: str, kind: type, offered_instead: QoSProfile, cure: str
) -> None:
    publisher = robot.node.create_publisher(kind, topic, offered_instead)
    line = wait_for(
        lambda: line_of(node, f'nothing will be received from a publisher on {topic}:'), topic
    )
    robot.node.destroy_publisher(publisher)
    assert 'WARN' in line
    assert cure in line


@pytest.mark.parametrize(
    ('topic', 'kind', 'wanted'),
    [
        (f'{NODE}/status', RelocalizationStatus, LATCHED),
        (f'{NODE}/camera_pose', PoseStamped, LATCHED),
        (f'{NODE}/path', Path, LATCHED),
        (f'{NODE}/debug_image', Image, QoSProfile(depth=1, reliability=RELIABLE)),
    ],
)
def test_a_listener_that_cannot_be_served_is_named_with_the_cure(
    robot: Robot, node: NodeProcess, topic: str, kind: type, wanted: QoSProfile
) -> None:
    subscription = robot.node.create_subscription(kind, topic, lambda _message: None, wanted)
    line = wait_for(
        lambda: line_of(node, f'nothing will be sent to a subscription to {topic}:'), topic
    )
    robot.node.destroy_subscription(subscription)
    assert 'WARN' in line
    assert ('volatile' if wanted is LATCHED else 'best_effort') in line


def line_of(node: NodeProcess, text: str) -> str:
    return next((line for line in node.log.splitlines() if text in line), '')


@pytest.mark.parametrize(
    ('topic', 'kind'), [('/camera_info', CameraInfo), ('/odom', Odometry), ('/image', Image)]
)
@pytest.mark.parametrize('durability', [VOLATILE, TRANSIENT])
def test_reliable_publishers_of_sensors_are_heard(
    robot: Robot, topic: str, kind: type, durability: DurabilityPolicy
) -> None:
    publisher = robot.node.create_publisher(
        kind, topic, QoSProfile(depth=1, reliability=RELIABLE, durability=durability)
    )
    wait_for(publisher.get_subscription_count, f'the node on {topic}')
    robot.node.destroy_publisher(publisher)


@pytest.mark.parametrize('topic', ['/relocalized_pose', f'{NODE}/map_points'])
@pytest.mark.parametrize('wanted', [LATCHED, QoSProfile(depth=1), qos_profile_sensor_data], ids=str)
def test_listeners_to_what_is_latched_may_ask_for_less(
    robot: Robot, topic: str, wanted: QoSProfile
) -> None:
    kind = PointCloud2 if topic.endswith('points') else PoseWithCovarianceStamped
    subscription = robot.node.create_subscription(kind, topic, lambda _message: None, wanted)
    wait_for(subscription.get_publisher_count, f'the node on {topic}')
    robot.node.destroy_subscription(subscription)
