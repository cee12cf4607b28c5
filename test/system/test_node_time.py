# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import time
from itertools import count
from typing import TYPE_CHECKING

import pytest
from live_robot import NodeProcess, Robot, camera_info, image_message, time_message, wait_for
from rosgraph_msgs.msg import Clock

if TYPE_CHECKING:
    from collections.abc import Callable

    from tiny_place import TinyPlace


class BagClock:
    """The /clock of a bag that is played."""

    def __init__(self, robot: Robot) -> None:
        self.now = 100.0
        self._publisher = robot.node.create_publisher(Clock, '/clock', 1)

    def run_until(self, condition: Callable[[], object], node: NodeProcess) -> None:
        for _ in range(10_000):
            self._publisher.publish(Clock(clock=time_message(self.now)))
            if condition():
                return
            self.now += 0.01
            time.sleep(0.005)
        pytest.fail(node.log)


def test_a_clock_that_jumps_back_starts_anew(
    start_node: Callable[..., NodeProcess], robot: Robot, tiny_place: TinyPlace
) -> None:
    node = start_node('--map', str(tiny_place.map_path), base_frame="''", use_sim_time=True)
    robot.camera_info = camera_info(tiny_place.camera)
    robot.connect(node)
    clock = BagClock(robot)

    def gives_a_fix() -> bool:
        image = image_message(tiny_place.queries[0][0], clock.now)
        robot.show(image)
        clock.run_until(lambda: robot.verdict_on(image), node)
        return bool(robot.verdict_on(image).accepted)

    # the first image may come before the first calibration
    wait_for(gives_a_fix, 'the first fix')
    clock.now = 50.0
    clock.run_until(lambda: 'the clock jumped back' in node.log, node)
    assert gives_a_fix()
    assert gives_a_fix()
    assert node.stop() == 0


def test_images_whose_stamps_jump_back_start_anew(
    start_node: Callable[..., NodeProcess], robot: Robot, tiny_place: TinyPlace
) -> None:
    node = start_node('--map', str(tiny_place.map_path), base_frame="''")
    robot.camera_info = camera_info(tiny_place.camera)
    robot.connect(node)
    robot.wait_for_first_fix(tiny_place.queries[0][0], count(100.0))
    for stamp in (50.0, 51.0):
        image = image_message(tiny_place.queries[0][0], stamp)
        robot.ask(image)
        robot.fix_of(image)
    assert node.log.count('`base_frame` is empty') == 1
    assert node.stop() == 0
