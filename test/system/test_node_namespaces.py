# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Several nodes in one graph: namespaces, remapped names, and two nodes in one process."""

from __future__ import annotations

import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING

import rclpy
from live_robot import (
    BASE_FROM_CAMERA,
    NODE,
    QUICK,
    Robot,
    camera_info,
    node_process,
    spinning_node,
    wait_for,
)
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from gam_relocalizer.geometry import rigid3d_from
from gam_relocalizer.ros.node import RelocalizerNode

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tiny_place import TinyPlace

OWN_NAMES = ('/relocalized_pose:=relocalized_pose', '/tf:=tf', '/tf_static:=tf_static')
LEFT, RIGHT = '/left', '/right'
OTHER_MOUNT = rigid3d_from((0.5, -0.5, 0.5, -0.5), (-0.4, 0.3, 0.9))


def test_a_node_in_a_namespace_keeps_to_it(tiny_place: TinyPlace, tmp_path: Path) -> None:
    remap = [f'__ns:={LEFT}', *OWN_NAMES, '/diagnostics:=diagnostics', 'image:=front/image']
    arguments = ('--map', str(tiny_place.map_path))
    with (
        node_process(tmp_path / 'node.log', *arguments, remap=remap) as node,
        spinning_node('robot') as own,
    ):
        robot = Robot(own, LEFT, f'{LEFT}/relocalized_pose', image_topic='front/image')
        robot.mount_camera()
        robot.connect(node)
        robot.camera_info = camera_info(tiny_place.camera)
        robot.wait_for_first_fix(tiny_place.queries[0][0], robot.stamps)
        pixels, camera_from_map = tiny_place.queries[1]
        image = robot.shot(pixels)
        assert robot.ask(image).accepted
        robot.assert_at(image, BASE_FROM_CAMERA * camera_from_map)
        assert robot.state() == 'active'
        assert robot.set_parameter('period', 0.06) == (True, '')
        # none of its names is anybody else's
        its_own = own.get_publisher_names_and_types_by_node(NODE[1:], LEFT)
        its_own += own.get_subscriber_names_and_types_by_node(NODE[1:], LEFT)
        its_own += own.get_service_names_and_types_by_node(NODE[1:], LEFT)
        shared = {name for name, _ in its_own if not name.startswith(f'{LEFT}/')}
        assert shared <= {'/parameter_events', '/rosout'}
        assert f'{LEFT}/front/image' in {name for name, _ in its_own}
        # the names of frames are not names of topics
        assert robot.fix_of(image).header.frame_id == 'map'


@contextmanager
def two_nodes(tiny_place: TinyPlace) -> Iterator[list[RelocalizerNode]]:
    """Two nodes that one executor spins, each with its own names."""
    remap = [word for rule in OWN_NAMES for word in ('-r', rule)]
    rclpy.init(args=['--ros-args', *remap], signal_handler_options=SignalHandlerOptions.NO)
    values = QUICK | {'map': str(tiny_place.map_path)}
    overrides = [Parameter(name, value=value) for name, value in values.items()]
    nodes = [RelocalizerNode(overrides, namespace=namespace) for namespace in (LEFT, RIGHT)]
    executor = SingleThreadedExecutor()
    thread = threading.Thread(target=spin, args=(executor,))
    try:
        for node in nodes:
            executor.add_node(node)
            node.start()
        thread.start()
        yield nodes
    finally:
        executor.shutdown()
        thread.join()
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()


def spin(executor: SingleThreadedExecutor) -> None:
    try:
        executor.spin()
    except ExternalShutdownException:
        return


def test_two_nodes_in_one_process_know_nothing_of_each_other(tiny_place: TinyPlace) -> None:
    with two_nodes(tiny_place), spinning_node('left') as left, spinning_node('right') as right:
        robots = [
            Robot(node, namespace, f'{namespace}/relocalized_pose')
            for node, namespace in ((left, LEFT), (right, RIGHT))
        ]
        mounts = (BASE_FROM_CAMERA, OTHER_MOUNT)
        for robot, mount in zip(robots, mounts, strict=True):
            robot.mount_camera(mount)
            wait_for(robot.is_connected, 'the node to subscribe')
            robot.camera_info = camera_info(tiny_place.camera)
            robot.wait_for_first_fix(tiny_place.queries[0][0], robot.stamps)
        assert robots[0].set_parameter('min_inliers', 100_000) == (True, '')
        pixels, camera_from_map = tiny_place.queries[1]
        image = robots[0].shot(pixels)
        for robot in robots:
            robot.show(image)
        for robot in robots:
            wait_for(lambda robot=robot: robot.verdict_on(image), 'a verdict')
        # the parameter of one is not that of the other, and neither is the mount
        refused, accepted = (robot.verdict_on(image) for robot in robots)
        assert not refused.accepted
        assert '100000' in refused.reason
        assert accepted.accepted
        robots[1].assert_at(image, OTHER_MOUNT * camera_from_map)
        assert robots[0].set_parameter('min_inliers', 20) == (True, '')
        again = robots[0].shot(pixels)
        assert robots[0].ask(again).accepted
        robots[0].assert_at(again, BASE_FROM_CAMERA * camera_from_map)
