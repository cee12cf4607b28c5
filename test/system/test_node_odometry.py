# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What the node knows beside the images: odometry, and where somebody says that the robot is."""

from __future__ import annotations

import time
from itertools import count
from typing import TYPE_CHECKING

import numpy as np
import pytest
from geometry_msgs.msg import Point, Pose, PoseWithCovariance, PoseWithCovarianceStamped
from live_robot import (
    NodeProcess,
    Robot,
    camera_info,
    image_message,
    spinning_node,
    time_message,
    wait_for,
)
from nav_msgs.msg import Odometry
from std_msgs.msg import Header

from gam_relocalizer.localization.result import Status

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rclpy.node import Node
    from sensor_msgs.msg import Image
    from tiny_place import TinyPlace

VIO_TAKES_S = 0.2
# they rise over all tests of this file, which share a node
STAMPS = count(1000.0, 0.25)


class Parked:
    """A robot whose odometry says that it stands."""

    def __init__(self, robot: Robot, base: Node, node: NodeProcess, tiny_place: TinyPlace) -> None:
        self.robot = robot
        self.node = node
        self._here, self._elsewhere = tiny_place.queries[0][0], tiny_place.queries[-1][0]
        # by a node of its own, as on a robot: beside large images small messages get lost
        self._odometry = base.create_publisher(Odometry, '/odom', 10)
        self._initial_pose = base.create_publisher(PoseWithCovarianceStamped, '/initialpose', 10)

    def see(self, *, elsewhere: bool = False, stamp: float | None = None) -> tuple[Image, Status]:
        """Shows an image of where it stands or of another place, and hears the verdict."""
        stamp = stamp or next(STAMPS)
        image = image_message(self._elsewhere if elsewhere else self._here, stamp)
        for moment in np.linspace(stamp - 0.1, stamp + 0.1, 5):
            self.say_odometry(moment)
        return image, Status(self.robot.ask(image).status)

    def see_elsewhere_before_the_odometry(self) -> tuple[Image, Status]:
        """As with a VIO, which needs the image to tell where the robot was."""
        stamp = next(STAMPS)
        image = image_message(self._elsewhere, stamp)
        self.robot.show(image)
        time.sleep(VIO_TAKES_S)
        for moment in np.linspace(stamp - 0.1, stamp + 0.1, 5):
            self.say_odometry(moment)
        verdict = wait_for(lambda: self.robot.verdict_on(image), 'a verdict')
        return image, Status(verdict.status)

    def say_odometry(self, stamp: float, child_frame: str = 'base_link') -> None:
        pose = PoseWithCovariance(pose=Pose(position=Point(x=3.0, y=-2.0)))
        header = Header(stamp=time_message(stamp), frame_id='odom')
        self._odometry.publish(Odometry(header=header, child_frame_id=child_frame, pose=pose))

    def say_initial_pose(self, frame: str) -> None:
        pose = PoseWithCovariance(pose=Pose(position=Point(x=1.0, y=1.0)))
        self._initial_pose.publish(
            PoseWithCovarianceStamped(header=Header(frame_id=frame), pose=pose)
        )

    def was_published(self, image: Image) -> bool:
        """Whether there was a pose for it; asks after a later fix, which would come after it."""
        later, status = self.see()
        assert status is Status.ACCEPTED
        self.robot.fix_of(later)
        stamps = [pose.header.stamp for pose in self.robot.heard.poses]
        return image.header.stamp in stamps

    def log_of(self, text: str) -> str:
        return next((line for line in self.node.log.splitlines() if text in line), '')


@pytest.fixture(scope='module')
def parked(tiny_place: TinyPlace, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Parked]:
    log = tmp_path_factory.mktemp('node') / 'node.log'
    node = NodeProcess(log, '--map', str(tiny_place.map_path))
    with spinning_node('robot') as own, spinning_node('base') as base:
        robot = Robot(own)
        parked = Parked(robot, base, node, tiny_place)
        robot.mount_camera()
        robot.connect(node)
        robot.camera_info = camera_info(tiny_place.camera)

        def is_heard() -> str:
            parked.say_odometry(1.0, child_frame='trailer')
            return parked.log_of('trailer')

        wait_for(is_heard, 'the odometry to be heard')
        robot.wait_for_first_fix(tiny_place.queries[0][0], STAMPS)
        yield parked
    assert node.stop() == 0, node.log


def test_odometry_of_another_body_is_named_once(parked: Parked) -> None:
    assert '`base_link`' in parked.log_of('trailer')
    parked.say_odometry(2.0, child_frame='trailer')
    parked.see()
    assert parked.node.log.count('that of `trailer`') == 1


def test_one_fix_that_odometry_speaks_against_is_held_back(parked: Parked) -> None:
    assert parked.see()[1] is Status.ACCEPTED
    image, status = parked.see(elsewhere=True)
    assert status is Status.IMPLAUSIBLE
    assert not parked.was_published(image)


def test_odometry_that_comes_after_the_image_speaks_against_a_fix_as_well(parked: Parked) -> None:
    assert parked.see()[1] is Status.ACCEPTED
    image, status = parked.see_elsewhere_before_the_odometry()
    assert status is Status.IMPLAUSIBLE
    assert not parked.was_published(image)


def test_a_carried_robot_is_back_with_its_second_fix(parked: Parked) -> None:
    assert parked.see()[1] is Status.ACCEPTED
    assert parked.see(elsewhere=True)[1] is Status.IMPLAUSIBLE
    image, status = parked.see(elsewhere=True)
    assert status is Status.ACCEPTED
    parked.robot.fix_of(image)
    assert parked.see()[1] is Status.IMPLAUSIBLE
    assert parked.see()[1] is Status.ACCEPTED


def test_an_initial_pose_counts_in_the_frame_of_the_map_only(parked: Parked) -> None:
    def is_taken() -> str:
        parked.say_initial_pose('map')
        return parked.log_of('looking around')

    def is_refused() -> str:
        parked.say_initial_pose('odom')
        return parked.log_of('in frame `odom`')

    assert '/initialpose' in wait_for(is_taken, 'the initial pose to be taken')
    assert 'expected one in `map`' in wait_for(is_refused, 'the initial pose to be refused')
    assert parked.see()[1] is Status.ACCEPTED


def test_a_level_robot_does_not_lean_as_the_wrong_mount_says(parked: Parked) -> None:
    assert parked.robot.set_parameter('max_tilt_deg', 15.0) == (True, '')
    assert parked.see()[1] is Status.ACCEPTED
    # the camera on its side: the base would lie on its own
    assert parked.robot.set_parameter('base_from_camera', '0 0 0 0 0.7071068 0 0.7071068') == (
        True,
        '',
    )
    image, status = parked.see()
    assert parked.robot.set_parameter('base_from_camera', '') == (True, '')
    assert status is Status.IMPLAUSIBLE
    assert not parked.was_published(image)


def test_after_a_jump_back_in_time_there_is_nothing_to_compare_with(parked: Parked) -> None:
    assert parked.see()[1] is Status.ACCEPTED
    assert parked.see(elsewhere=True, stamp=500.0)[1] is Status.ACCEPTED
