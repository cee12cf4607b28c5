# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What nodes say about themselves on /diagnostics that are not active, or have no clock."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

from diagnostic_msgs.msg import DiagnosticStatus
from doctor import PARTS, Doctor
from lifecycle_msgs.msg import Transition
from live_robot import wait_for

from gam_relocalizer.ros.conditions import Condition

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from live_robot import NodeProcess, Robot
    from tiny_place import TinyPlace

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


def test_every_state_has_its_report(
    start_node: Callable[..., NodeProcess], robot: Robot, tiny_place: TinyPlace, tmp_path: Path
) -> None:
    damaged = tmp_path / 'damaged_map'
    shutil.copytree(tiny_place.map_path, damaged)
    with (damaged / 'points.npy').open('r+b') as file:
        file.truncate(1000)
    doctor = Doctor(robot)
    node = start_node('--map', str(damaged), publish_map_odom=True)
    report = doctor.wait_for('state', Condition.TRANSITION_FAILED)
    assert 'points.npy' in report.message
    assert doctor.levels() == dict.fromkeys(PARTS, OK) | {'state': ERROR}
    assert robot.set_parameter('map', str(tiny_place.map_path)) == (True, '')
    assert robot.change_state(Transition.TRANSITION_CONFIGURE)
    doctor.wait_for('state', Condition.INACTIVE)
    assert doctor.levels() == dict.fromkeys(PARTS, OK) | {'state': WARN}
    assert robot.change_state(Transition.TRANSITION_ACTIVATE)
    wait_for(lambda: doctor.levels()['state'] == OK, 'the node to say that it is active')
    report = doctor.wait_for('map_to_odom', Condition.BROADCAST_BLOCKED)
    assert '/odom' in report.message
    assert robot.change_state(Transition.TRANSITION_DEACTIVATE)
    assert robot.change_state(Transition.TRANSITION_CLEANUP)
    doctor.wait_for('state', Condition.UNCONFIGURED)
    assert node.stop() == 0, node.log


def test_a_clock_that_never_begins_does_not_silence_the_node_but_is_an_error(
    start_node: Callable[..., NodeProcess], robot: Robot, tiny_place: TinyPlace
) -> None:
    doctor = Doctor(robot)
    node = start_node('--map', str(tiny_place.map_path), use_sim_time=True)
    doctor.wait_for('input', Condition.NO_CLOCK)
    assert doctor.levels()['state'] == OK
    assert node.stop() == 0, node.log
