# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What the services answer in the other states of the node, and when it leaves the active one."""

from __future__ import annotations

from itertools import count
from typing import TYPE_CHECKING

from builtin_interfaces.msg import Duration
from doctor import Doctor
from lifecycle_msgs.msg import Transition
from live_robot import LIMIT_S, NODE, NodeProcess, Robot, camera_info, image_message, wait_for
from std_srvs.srv import SetBool

from gam_relocalizer.localization.result import Status
from gam_relocalizer.ros.conditions import Condition
from gam_relocalizer_msgs.srv import LoadMap, LocalizeImage, Relocalize

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tiny_place import TinyPlace

AT_ONCE = Relocalize.Request(timeout=Duration(nanosec=1))


def load_map(robot: Robot, path: Path) -> LoadMap.Response:
    return robot.call(LoadMap, f'{NODE}/load_map', LoadMap.Request(path=str(path)), LIMIT_S)


def test_a_node_that_is_not_active_says_what_to_do(
    start_node: Callable[..., NodeProcess], robot: Robot, tiny_place: TinyPlace
) -> None:
    node = start_node('--map', str(tiny_place.map_path), autostart=False)
    for kind, name in ((Relocalize, 'relocalize'), (LocalizeImage, 'localize_image')):
        answer = robot.call(kind, f'{NODE}/{name}', kind.Request())
        assert not answer.accepted
        assert Status(answer.status.status) is Status.NOT_ACTIVE
        assert f'ros2 lifecycle set {NODE} configure' in answer.status.reason
    refused = load_map(robot, tiny_place.map_path)
    assert (refused.success, refused.map_id) == (False, '')
    assert 'configure' in refused.message
    assert not robot.call(SetBool, f'{NODE}/set_enabled', SetBool.Request()).success
    assert robot.change_state(Transition.TRANSITION_CONFIGURE)
    inactive = robot.call(Relocalize, f'{NODE}/relocalize', Relocalize.Request())
    assert f'ros2 lifecycle set {NODE} activate' in inactive.status.reason
    assert load_map(robot, tiny_place.map_path).success
    assert robot.state() == 'inactive'
    assert node.stop() == 0, node.log


def test_a_node_that_was_shut_down_refuses_every_request_and_says_so(
    start_node: Callable[..., NodeProcess], robot: Robot, tiny_place: TinyPlace
) -> None:
    node = start_node('--map', str(tiny_place.map_path))
    doctor = Doctor(robot)
    robot.connect(node)
    assert robot.change_state(Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert robot.state() == 'finalized'
    robot.wait_until_alone()
    for kind, name in ((Relocalize, 'relocalize'), (LocalizeImage, 'localize_image')):
        answer = robot.call(kind, f'{NODE}/{name}', kind.Request())
        assert Status(answer.status.status) is Status.NOT_ACTIVE
        assert 'finalized' in answer.status.reason
    refused = load_map(robot, tiny_place.map_path)
    assert (refused.success, refused.map_id) == (False, '')
    assert 'finalized' in refused.message
    assert not robot.call(SetBool, f'{NODE}/set_enabled', SetBool.Request(data=True)).success
    doctor.wait_for('state', Condition.FINALIZED)
    assert doctor.value('state', 'state') == 'finalized'
    node.end_cleanly()


def test_a_map_makes_a_node_start_that_had_none(
    start_node: Callable[..., NodeProcess], robot: Robot, tiny_place: TinyPlace, tmp_path: Path
) -> None:
    node = start_node(base_frame="''")
    node.wait_for_log('not configured')
    refused = load_map(robot, tmp_path / 'nowhere')
    assert not refused.success
    assert 'nowhere' in refused.message
    assert load_map(robot, tiny_place.map_path).success
    assert robot.state() == 'active'
    robot.camera_info = camera_info(tiny_place.camera)
    robot.connect(node)
    robot.wait_for_first_fix(tiny_place.queries[0][0], count(1.0))
    assert node.stop() == 0, node.log


def test_requests_that_wait_are_answered_when_the_node_is_deactivated(
    start_node: Callable[..., NodeProcess], robot: Robot, tiny_place: TinyPlace
) -> None:
    node = start_node('--map', str(tiny_place.map_path))
    robot.connect(node)
    client = robot.node.create_client(Relocalize, f'{NODE}/relocalize')
    robot.request(client, AT_ONCE)
    waiting = client.call_async(Relocalize.Request(timeout=Duration(sec=300)))
    robot.request(client, AT_ONCE)
    assert not waiting.done()
    assert robot.change_state(Transition.TRANSITION_DEACTIVATE)
    wait_for(waiting.done, 'an answer')
    assert Status(waiting.result().status.status) is Status.NOT_ACTIVE
    assert node.stop() == 0, node.log


def test_images_without_a_calibration_are_named_as_what_is_missing(
    start_node: Callable[..., NodeProcess], robot: Robot, tiny_place: TinyPlace
) -> None:
    node = start_node('--map', str(tiny_place.map_path), base_frame="''", period=3600.0)
    robot.connect(node)
    stamp = 0.0

    def show() -> None:
        nonlocal stamp
        stamp += 1.0
        robot.show(image_message(tiny_place.queries[0][0], stamp))

    request = Relocalize.Request(timeout=Duration(sec=1))
    answer = robot.call(Relocalize, f'{NODE}/relocalize', request, meanwhile=show)
    assert Status(answer.status.status) is Status.NO_CALIBRATION
    assert '/camera_info' in answer.status.reason
    assert node.stop() == 0, node.log
