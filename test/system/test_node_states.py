# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

import pytest
from lifecycle_msgs.msg import Transition
from live_robot import NodeProcess, Robot, camera_info, image_message, wait_for

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tiny_place import TinyPlace


def truncated_copy(tiny_place: TinyPlace, tmp_path: Path) -> Path:
    damaged = tmp_path / 'damaged_map'
    shutil.copytree(tiny_place.map_path, damaged)
    with (damaged / 'points.npy').open('r+b') as file:
        file.truncate(1000)
    return damaged


def test_a_damaged_map_leaves_the_node_alive_until_it_gets_another(
    start_node: Callable[..., NodeProcess], robot: Robot, tiny_place: TinyPlace, tmp_path: Path
) -> None:
    node = start_node('--map', str(truncated_copy(tiny_place, tmp_path)))
    assert 'points.npy' in node.wait_for_log('not configured')
    assert robot.state() == 'unconfigured'
    assert robot.set_parameter('map', str(tmp_path / 'nowhere')) == (True, '')
    assert not robot.change_state(Transition.TRANSITION_CONFIGURE)
    assert str(tmp_path / 'nowhere') in node.wait_for_log('nowhere')
    assert robot.set_parameter('map', str(tiny_place.map_path)) == (True, '')
    assert robot.change_state(Transition.TRANSITION_CONFIGURE)
    assert robot.change_state(Transition.TRANSITION_ACTIVATE)
    assert robot.state() == 'active'
    assert node.stop() == 0


def test_weights_that_are_missing_leave_the_node_alive_until_it_can_do_without(
    start_node: Callable[..., NodeProcess], robot: Robot, tiny_place: TinyPlace, tmp_path: Path
) -> None:
    missing = tmp_path / 'nowhere.npz'
    node = start_node('--map', str(tiny_place.map_path), weights=missing)
    assert str(missing) in node.wait_for_log('not configured')
    assert robot.state() == 'unconfigured'
    assert robot.set_parameter('weights', '') == (True, '')
    assert robot.set_parameter('matcher', 'nn-cross') == (True, '')
    assert robot.change_state(Transition.TRANSITION_CONFIGURE)
    assert 'nn-cross' in node.wait_for_log('networks on the CPU')
    successful, reason = robot.set_parameter('matcher', 'gam')
    assert not successful
    assert 'matcher' in reason
    assert node.stop() == 0


def test_without_a_map_the_node_says_what_it_needs(
    start_node: Callable[..., NodeProcess], robot: Robot
) -> None:
    node = start_node()
    assert 'parameter `map` is empty' in node.wait_for_log('not configured')
    assert robot.state() == 'unconfigured'
    assert node.stop() == 0


def test_up_and_down_again_and_again(
    start_node: Callable[..., NodeProcess], robot: Robot, tiny_place: TinyPlace
) -> None:
    node = start_node('--map', str(tiny_place.map_path), autostart=False)
    robot.camera_info = camera_info(tiny_place.camera)
    image = tiny_place.queries[0][0]
    assert robot.state() == 'unconfigured'
    for cycle in range(3):
        assert robot.change_state(Transition.TRANSITION_CONFIGURE)
        assert robot.change_state(Transition.TRANSITION_ACTIVATE)
        robot.mount_camera()
        robot.connect(node)
        robot.ask(image_message(image, 10.0 * cycle + 1))
        # the node goes down in the middle of this one
        robot.show(image_message(image, 10.0 * cycle + 2))
        assert robot.change_state(Transition.TRANSITION_DEACTIVATE)
        assert robot.change_state(Transition.TRANSITION_CLEANUP)
        robot.wait_until_alone()
    assert robot.state() == 'unconfigured'
    assert node.stop() == 0, node.log


def test_a_request_that_the_state_does_not_allow_ends_nothing(
    start_node: Callable[..., NodeProcess], robot: Robot
) -> None:
    node = start_node(autostart=False)
    robot.request_state(Transition.TRANSITION_DEACTIVATE)
    node.wait_for_log('request refused')
    assert robot.state() == 'unconfigured'
    assert node.stop() == 0


@pytest.mark.parametrize(
    ('arguments', 'word'),
    [
        (['--ros-args', '-p', 'period:=1'], 'decimal point'),
        (['--ros-args', '-p', 'nonsense'], 'nonsense'),
    ],
)
def test_arguments_that_cannot_be_used_end_with_2(
    start_node: Callable[..., NodeProcess], arguments: list[str], word: str
) -> None:
    node = start_node(*arguments)
    wait_for(lambda: not node.alive, 'the end of the process')
    assert node.process.returncode == 2, node.log
    assert word in node.log
    assert 'Traceback' not in node.log
