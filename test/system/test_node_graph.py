# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What happens to topics on a robot: cameras restart, images burst, listeners come late."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from live_robot import (
    BASE_FROM_CAMERA,
    LATCHED,
    camera_info,
    running_node,
    spinning_node,
    time_message,
    wait_for,
)
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image, PointCloud2

from gam_relocalizer.localization.result import Status
from gam_relocalizer.ros.conversions import nanoseconds_from
from gam_relocalizer.scene_map import load_map

if TYPE_CHECKING:
    from collections.abc import Iterator

    from live_robot import NodeProcess, Robot
    from tiny_place import TinyPlace

BURST = 100


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


def assert_localizes(robot: Robot, tiny_place: TinyPlace, query: int = 0) -> None:
    pixels, camera_from_map = tiny_place.queries[query]
    image = robot.shot(pixels)
    status = robot.ask(image)
    assert status.accepted, status.reason
    robot.assert_at(image, BASE_FROM_CAMERA * camera_from_map)


def test_who_comes_late_gets_the_last_pose_alone_and_the_map(
    robot: Robot, tiny_place: TinyPlace
) -> None:
    assert_localizes(robot, tiny_place)
    assert_localizes(robot, tiny_place, query=1)
    last = robot.heard.poses[-1]
    poses: list[PoseWithCovarianceStamped] = []
    clouds: list[PointCloud2] = []
    many = QoSProfile(depth=10, reliability=LATCHED.reliability, durability=LATCHED.durability)
    with spinning_node('late') as late:
        late.create_subscription(PoseWithCovarianceStamped, '/relocalized_pose', poses.append, many)
        late.create_subscription(PointCloud2, robot.topic('map_points'), clouds.append, many)
        wait_for(lambda: poses and clouds, 'pose and points')
        # whatever came before the last one would be here before the next one
        assert_localizes(robot, tiny_place)
        wait_for(lambda: len(poses) > 1, 'the next pose')
    assert poses == [last, robot.heard.poses[-1]]
    points = np.frombuffer(clouds[0].data, '<f4').reshape(-1, 3)
    np.testing.assert_allclose(points, load_map(tiny_place.map_path).points, atol=1e-5)
    assert len(clouds) == 1


def test_listeners_that_come_and_go_hold_nothing_up(robot: Robot, tiny_place: TinyPlace) -> None:
    for _ in range(3):
        with spinning_node('visitor') as visitor:
            heard: list[Image] = []
            visitor.create_subscription(Image, robot.topic('debug_image'), heard.append, 1)
            visitor.create_subscription(
                PoseWithCovarianceStamped, '/relocalized_pose', heard.append, LATCHED
            )
            wait_for(lambda heard=heard: heard, 'the last pose')
        assert_localizes(robot, tiny_place)


def test_a_camera_that_restarts_goes_on(
    robot: Robot, node: NodeProcess, tiny_place: TinyPlace
) -> None:
    robot.restart_camera()
    robot.connect(node)
    robot.wait_for_first_fix(tiny_place.queries[0][0], robot.stamps)
    assert_localizes(robot, tiny_place, query=1)


def test_a_camera_whose_stamps_start_at_zero_is_used_from_its_second_image(
    robot: Robot, node: NodeProcess, tiny_place: TinyPlace
) -> None:
    assert_localizes(robot, tiny_place)
    robot.restart_camera()
    robot.connect(node)
    pixels, camera_from_map = tiny_place.queries[1]
    robot.heard.poses.clear()
    times = iter(np.arange(0.0, 100.0, 0.25))
    robot.stamps, stamps = times, robot.stamps
    try:
        robot.wait_for_first_fix(pixels, robot.stamps)
        image = robot.shot(pixels)
        assert robot.ask(image).accepted
        robot.assert_at(image, BASE_FROM_CAMERA * camera_from_map)
        tried = [nanoseconds_from(pose.header.stamp) for pose in robot.heard.poses]
        assert tried == sorted(set(tried))
        assert max(tried) < 100 * 10**9
    finally:
        robot.stamps = stamps
    assert_localizes(robot, tiny_place)


def test_a_driver_that_stamps_nothing_is_named(robot: Robot, tiny_place: TinyPlace) -> None:
    pixels = tiny_place.queries[0][0]
    unstamped = robot.shot(pixels)
    unstamped.header.stamp = time_message(0.0)
    robot.heard.statuses.clear()
    robot.show(unstamped)  # time has jumped back: perhaps a bag that starts again
    wait_for(lambda: robot.verdict_on(unstamped), 'a verdict')
    robot.heard.statuses.clear()
    robot.show(unstamped)
    wait_for(lambda: robot.heard.statuses, 'the next verdict')
    assert robot.heard.statuses[-1].status == Status.STALE_IMAGE.value
    assert 'stamp' in robot.heard.statuses[-1].reason
    assert_localizes(robot, tiny_place)


def test_another_resolution_needs_its_own_calibration(robot: Robot, tiny_place: TinyPlace) -> None:
    full, camera_from_map = tiny_place.queries[3]
    half = cv2.resize(full, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    calibration = robot.camera_info
    smaller = camera_info(tiny_place.camera)
    smaller.binning_x = smaller.binning_y = 2
    robot.camera_info = smaller

    def refusal() -> Image | None:
        in_flight = robot.shot(full)
        return None if robot.ask(in_flight).accepted else in_flight

    try:
        in_flight = wait_for(refusal, 'the calibration to take effect')
        image = robot.shot(half)
        status = robot.ask(image)
        assert status.accepted, status.reason
        robot.assert_at(image, BASE_FROM_CAMERA * camera_from_map)
    finally:
        robot.camera_info = calibration
    verdict = robot.verdict_on(in_flight)
    assert verdict is not None
    assert verdict.status == Status.NO_CALIBRATION.value
    assert '640 x 480' in verdict.reason
    assert '320 x 240' in verdict.reason
    assert in_flight.header.stamp not in [pose.header.stamp for pose in robot.heard.poses]

    # and back again
    def refusal_of_half() -> int | None:
        status = robot.ask(robot.shot(half))
        return None if status.accepted else status.status

    refused = wait_for(refusal_of_half, 'the calibration before to take effect')
    assert refused == Status.NO_CALIBRATION.value
    robot.wait_for_first_fix(full, robot.stamps)
    assert_localizes(robot, tiny_place)


def test_of_a_burst_the_newest_image_is_tried(robot: Robot, tiny_place: TinyPlace) -> None:
    pixels, camera_from_map = tiny_place.queries[2]
    images = [robot.shot(pixels) for _ in range(BURST)]
    robot.heard.statuses.clear()
    robot.heard.poses.clear()
    publisher = robot.node.create_publisher(
        Image, '/image', QoSProfile(depth=BURST, reliability=ReliabilityPolicy.RELIABLE)
    )
    wait_for(publisher.get_subscription_count, 'the node')
    for image in images:
        publisher.publish(image)
    wait_for(lambda: robot.verdict_on(images[-1]), 'the verdict on the last image')
    robot.node.destroy_publisher(publisher)
    robot.assert_at(images[-1], BASE_FROM_CAMERA * camera_from_map)
    tried = [nanoseconds_from(status.header.stamp) for status in robot.heard.statuses]
    assert tried == sorted(set(tried))
    assert len(tried) < BURST / 2
    published = [nanoseconds_from(pose.header.stamp) for pose in robot.heard.poses]
    assert published == tried
