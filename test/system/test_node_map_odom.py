# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""map -> odom on /tf, by a clock of our own, so that every stamp is known to the nanosecond."""

from __future__ import annotations

import time
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
from geometry_msgs.msg import PoseWithCovariance, TransformStamped
from lifecycle_msgs.msg import Transition
from live_robot import (
    NODE,
    NodeProcess,
    Robot,
    camera_info,
    image_message,
    rigid3d_of,
    spinning_node,
    time_message,
    wait_for,
)
from nav_msgs.msg import Odometry
from rosgraph_msgs.msg import Clock
from scipy.spatial.transform import Rotation
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from gam_relocalizer.geometry import rigid3d_from, rigid3d_from_rotation
from gam_relocalizer.localization.result import Status
from gam_relocalizer.ros.conversions import nanoseconds_from, pose_message

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rclpy.node import Node
    from sensor_msgs.msg import Image
    from tiny_place import TinyPlace

    from gam_relocalizer_msgs.msg import RelocalizationStatus

START = 100.0
TICK = 0.05
BETWEEN_TICKS = 0.02
TOLERANCE = 0.25
# what somebody else says about the frame, and this node never would
ELSEWHERE = 99.0


# where the robot stands
ODOM_FROM_BASE = rigid3d_from_rotation(Rotation.from_euler('z', 0.7), (3.0, -2.0, 0.1))
# it sways while an image is taken, so that odometry must be read at the right time [m/s]
SWAY = 0.2


def rigid3d_of_transform(message: TransformStamped) -> pycolmap.Rigid3d:
    """The parent_from_child of a message, whose quaternion must have unit length."""
    q, t = message.transform.rotation, message.transform.translation
    assert abs(np.linalg.norm([q.w, q.x, q.y, q.z]) - 1.0) < 1e-9
    return rigid3d_from((q.w, q.x, q.y, q.z), (t.x, t.y, t.z))


class Rover:
    """A robot with odometry, a clock, and on wish a second owner of the frame `odom`."""

    def __init__(self, robot: Robot, base: Node, node: NodeProcess, tiny_place: TinyPlace) -> None:
        self.robot = robot
        self.node = node
        self.now = START
        self.has_odometry = False
        self.has_second_owner = False
        self.heard: list[TransformStamped] = []
        self.clock_ns: set[int] = set()
        self._pixels = tiny_place.queries[0][0]
        # by a node of its own, as on a robot: beside large images small messages get lost
        self._clock = base.create_publisher(Clock, '/clock', 10)
        self._odometry = base.create_publisher(Odometry, '/odom', 10)
        self._transforms = base.create_publisher(TFMessage, '/tf', 100)
        base.create_subscription(TFMessage, '/tf', self._on_transforms, 100)

    def tick(self, sway: float = 0.0) -> None:
        """One step of time; at its end the robot is so far from where it stands."""
        self.now += TICK
        if self.has_odometry:
            self._say_odometry(sway)
        if self.has_second_owner:
            self._say_elsewhere()
        self.say_time()
        time.sleep(0.02)

    def tick_until(self, condition: Callable[[], object], what: str) -> None:
        def happens() -> object:
            self.tick()
            return condition()

        wait_for(happens, what)

    def say_time(self) -> None:
        message = Clock(clock=time_message(self.now))
        self.clock_ns.add(nanoseconds_from(message.clock))
        self._clock.publish(message)

    def _say_odometry(self, sway: float) -> None:
        odom_from_base = ODOM_FROM_BASE * pycolmap.Rigid3d(pycolmap.Rotation3d(), [sway, 0.0, 0.0])
        pose = PoseWithCovariance(pose=pose_message(odom_from_base))
        header = Header(stamp=time_message(self.now), frame_id='odom')
        self._odometry.publish(Odometry(header=header, child_frame_id='base_link', pose=pose))

    def see(self) -> tuple[Image, Status]:
        """Shows an image taken between two samples of odometry, and hears the verdict on it."""
        self.tick()
        self.tick(sway=-SWAY * (TICK - BETWEEN_TICKS))
        self.tick(sway=SWAY * BETWEEN_TICKS)
        image = image_message(self._pixels, self.now - BETWEEN_TICKS)
        self.robot.show(image)

        def verdict() -> RelocalizationStatus | None:
            self.tick()  # the attempt may wait for its turn
            time.sleep(0.05)
            return self.robot.verdict_on(image)

        return image, Status(wait_for(verdict, 'a status for the image').status)

    def get_fix(self) -> Image:
        """Sees until there is a fix: at first mount and calibration may come late."""
        for _ in range(10):
            image, status = self.see()
            if status is Status.ACCEPTED:
                return image
        return pytest.fail(self.node.log)

    @property
    def broadcasts(self) -> list[TransformStamped]:
        """What the node has broadcast so far."""
        return [each for each in self.heard if each.transform.translation.x != ELSEWHERE]

    @property
    def stamps(self) -> list[int]:
        """Those of all broadcasts of the node [ns]."""
        return [nanoseconds_from(each.header.stamp) for each in self.broadcasts]

    def tick_until_broadcast(self, number: int = 1) -> list[TransformStamped]:
        """The next broadcasts of the node, at least so many."""
        before = len(self.broadcasts)
        self.tick_until(lambda: len(self.broadcasts) >= before + number, 'a broadcast')
        return self.broadcasts[before:]

    @property
    def node_owns_a_publisher(self) -> bool:
        infos = self.robot.node.get_publishers_info_by_topic('/tf')
        return any(NODE.endswith(info.node_name) for info in infos)

    def _say_elsewhere(self) -> None:
        transform = TransformStamped(
            header=Header(stamp=time_message(self.now), frame_id='map'), child_frame_id='odom'
        )
        transform.transform.translation.x = ELSEWHERE
        self._transforms.publish(TFMessage(transforms=[transform]))

    def _on_transforms(self, message: TFMessage) -> None:
        self.heard.extend(each for each in message.transforms if each.child_frame_id == 'odom')


@pytest.fixture(scope='module')
def rover(tiny_place: TinyPlace, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rover]:
    log = tmp_path_factory.mktemp('node') / 'node.log'
    node = NodeProcess(
        log,
        '--map',
        str(tiny_place.map_path),
        use_sim_time=True,
        publish_map_odom=True,
        transform_tolerance=TOLERANCE,
    )
    with spinning_node('robot') as own, spinning_node('base') as base:
        robot = Robot(own)
        rover = Rover(robot, base, node, tiny_place)
        robot.mount_camera()
        robot.connect(node)
        robot.camera_info = camera_info(tiny_place.camera)
        yield rover
    assert node.stop() == 0, node.log
    assert 'Traceback' not in node.log


def test_without_odometry_the_log_says_what_is_missing(rover: Rover) -> None:
    rover.tick_until(lambda: 'no odometry of `base_link`' in rover.node.log, 'a line in the log')
    line = next(line for line in rover.node.log.splitlines() if 'no odometry of' in line)
    assert 'publish_map_odom' in line
    assert '/odom' in line
    rover.get_fix()
    assert rover.broadcasts == []


def test_with_odometry_at_the_stamp_of_the_image_it_gives_the_pose_of_the_fix(
    rover: Rover,
) -> None:
    rover.has_odometry = True
    rover.get_fix()
    image = rover.get_fix()
    pose = rigid3d_of(rover.robot.fix_of(image).pose.pose)
    last = rover.tick_until_broadcast(5)[-1]
    assert last.header.frame_id == 'map'
    found = rigid3d_of_transform(last) * ODOM_FROM_BASE
    np.testing.assert_allclose(found.matrix(), pose.matrix(), atol=1e-9)


def test_it_goes_on_between_fixes_ahead_of_the_clock_by_the_tolerance(rover: Rover) -> None:
    fixes = len(rover.robot.heard.poses)
    broadcasts = rover.tick_until_broadcast(40)
    assert len(rover.robot.heard.poses) == fixes
    assert all(each.transform == broadcasts[-1].transform for each in broadcasts[5:])
    stamps = {nanoseconds_from(each.header.stamp) for each in broadcasts}
    assert stamps <= {clock_ns + round(TOLERANCE * 1e9) for clock_ns in rover.clock_ns}


def test_while_the_clock_is_paused_no_stamp_comes_twice(rover: Rover) -> None:
    for _ in range(20):
        rover.say_time()
        time.sleep(0.01)
    rover.tick_until_broadcast(3)
    assert all(before < after for before, after in pairwise(rover.stamps))


def test_it_stays_silent_while_somebody_else_owns_the_frame(rover: Rover) -> None:
    rover.has_second_owner = True
    rover.tick_until(lambda: 'somebody else broadcasts' in rover.node.log, 'a line in the log')
    assert '`odom`' in rover.node.log
    rover.get_fix()
    silent_since = len(rover.broadcasts)
    for _ in range(40):
        rover.tick()
    rover.get_fix()  # heard after all that came before it
    assert len(rover.broadcasts) == silent_since
    rover.has_second_owner = False
    assert rover.tick_until_broadcast(3)


def test_it_belongs_to_the_active_state(rover: Rover) -> None:
    assert rover.robot.change_state(Transition.TRANSITION_DEACTIVATE)
    wait_for(lambda: not rover.node_owns_a_publisher, 'the end of the publisher')
    assert rover.robot.change_state(Transition.TRANSITION_ACTIVATE)
    wait_for(lambda: rover.node_owns_a_publisher, 'the publisher')
    # what was known before is forgotten, and one fix alone moves nothing
    rover.robot.connect(rover.node)
    silent_since = len(rover.broadcasts)
    rover.get_fix()
    assert len(rover.broadcasts) == silent_since
    rover.get_fix()
    assert rover.tick_until_broadcast(3)


def test_a_clock_that_jumps_back_ends_it_until_there_are_fixes_anew(rover: Rover) -> None:
    rover.now = START / 2.0
    rover.tick_until(lambda: 'the clock jumped back' in rover.node.log, 'the jump')
    rover.get_fix()
    assert rover.stamps[-1] > START * 1e9
    rover.get_fix()
    rover.tick_until(lambda: rover.stamps[-1] < START * 1e9, 'a broadcast after the jump')
    rover.tick_until_broadcast(3)
    jumps = [before >= after for before, after in pairwise(rover.stamps)]
    assert jumps.count(True) == 1
