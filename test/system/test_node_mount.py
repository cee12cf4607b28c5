# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""A camera on a head that turns, as /tf and the static transforms of several nodes tell."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from geometry_msgs.msg import Transform, TransformStamped, Vector3
from live_robot import (
    CAMERA_FRAME,
    LATCHED,
    NodeProcess,
    Robot,
    camera_info,
    image_message,
    rigid3d_of,
    spinning_node,
    time_message,
    wait_for,
)
from scipy.spatial.transform import Rotation
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from gam_relocalizer.geometry import rigid3d_from, rigid3d_from_rotation
from gam_relocalizer.ros.conversions import pose_message

if TYPE_CHECKING:
    from collections.abc import Iterator

    import pycolmap
    from rclpy.node import Node
    from sensor_msgs.msg import Image
    from tiny_place import TinyPlace

BASE_FROM_MAST = rigid3d_from((1.0, 0.0, 0.0, 0.0), (0.1, 0.0, 1.2))
HEAD_FROM_CAMERA = rigid3d_from((0.5, -0.5, 0.5, -0.5), (0.05, 0.0, 0.02))


def mast_from_head(pan: float, tilt: float) -> pycolmap.Rigid3d:
    return rigid3d_from_rotation(Rotation.from_euler('ZY', [pan, tilt]), (0.0, 0.0, 0.1))


def stamped(
    parent: str, child: str, parent_from_child: pycolmap.Rigid3d, stamp: float = 0.0
) -> TFMessage:
    pose = pose_message(parent_from_child)
    x, y, z = pose.position.x, pose.position.y, pose.position.z
    transform = TransformStamped(
        header=Header(stamp=time_message(stamp), frame_id=parent),
        child_frame_id=child,
        transform=Transform(translation=Vector3(x=x, y=y, z=z), rotation=pose.orientation),
    )
    return TFMessage(transforms=[transform])


class PanTilt:
    """A robot that says now and then how its head is turned."""

    def __init__(self, robot: Robot, joints: Node, tiny_place: TinyPlace) -> None:
        self.robot = robot
        self._pixels = tiny_place.queries[0][0]
        self._moving = joints.create_publisher(TFMessage, '/tf', 100)
        self._static = [
            self._latch(robot.node, stamped('base_link', 'mast', BASE_FROM_MAST)),
            self._latch(joints, stamped('head', CAMERA_FRAME, HEAD_FROM_CAMERA)),
        ]

    def turn(self, stamp: float, pan: float, tilt: float = 0.0) -> None:
        self._moving.publish(stamped('mast', 'head', mast_from_head(pan, tilt), stamp))

    def image(self, stamp: float) -> Image:
        return image_message(self._pixels, stamp)

    def base_from_camera(self, image: Image) -> pycolmap.Rigid3d:
        """The mount that turned the pose of the camera into that of the base."""
        map_from_base = rigid3d_of(self.robot.fix_of(image).pose.pose)

        def pose_of_camera() -> pycolmap.Rigid3d | None:
            poses = self.robot.heard.camera_poses
            return next(
                (rigid3d_of(p.pose) for p in poses if p.header.stamp == image.header.stamp), None
            )

        map_from_camera = wait_for(pose_of_camera, 'the pose of the camera')
        return map_from_base.inverse() * map_from_camera

    @staticmethod
    def _latch(node: Node, message: TFMessage) -> object:
        publisher = node.create_publisher(TFMessage, '/tf_static', LATCHED)
        publisher.publish(message)
        return publisher


@pytest.fixture(scope='module')
def head(tiny_place: TinyPlace, tmp_path_factory: pytest.TempPathFactory) -> Iterator[PanTilt]:
    with spinning_node('robot') as own, spinning_node('joints') as joints:
        robot = Robot(own)
        head = PanTilt(robot, joints, tiny_place)
        # after the static transforms: the node is late for them
        log = tmp_path_factory.mktemp('node') / 'node.log'
        node = NodeProcess(log, '--map', str(tiny_place.map_path))
        robot.connect(node)
        robot.camera_info = camera_info(tiny_place.camera)
        stamps = iter(np.arange(10.0, 100.0, 0.25))

        def gives_a_fix() -> bool:
            stamp = float(next(stamps))
            head.turn(stamp, 0.0)
            return bool(robot.ask(head.image(stamp)).accepted)

        wait_for(gives_a_fix, 'the first fix')
        yield head
    assert node.stop() == 0, node.log


def assert_same(found: pycolmap.Rigid3d, mast_from_head: pycolmap.Rigid3d) -> None:
    expected = BASE_FROM_MAST * mast_from_head * HEAD_FROM_CAMERA
    np.testing.assert_allclose(found.matrix(), expected.matrix(), atol=1e-9)


def test_a_head_that_turns_is_where_it_was_at_the_stamp_of_the_image(head: PanTilt) -> None:
    head.turn(200.0, pan=-0.4)
    head.turn(200.4, pan=0.8)
    head.turn(200.8, pan=2.0)
    image = head.image(200.1)
    assert head.robot.ask(image).accepted
    assert_same(head.base_from_camera(image), mast_from_head(-0.1, 0.0))


def test_a_transform_may_come_after_the_image(head: PanTilt) -> None:
    """The node asks for it when the attempt is over."""
    head.turn(300.0, pan=0.0, tilt=0.0)
    image = head.image(300.3)
    head.robot.show(image)
    head.turn(300.4, pan=0.0, tilt=0.4)
    assert wait_for(lambda: head.robot.verdict_on(image), 'a status for the image').accepted
    assert_same(head.base_from_camera(image), mast_from_head(0.0, 0.3))


def test_without_a_transform_at_the_stamp_there_is_no_fix(head: PanTilt) -> None:
    head.turn(400.0, pan=0.0)
    status = head.robot.ask(head.image(400.5))
    assert status.status_name == 'NO_TRANSFORM'
    assert 'known from' in status.reason
