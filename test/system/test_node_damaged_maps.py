# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Whichever file of a map is damaged or gone: the node stays alive and says which one it is."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

import pytest
from doctor import Doctor
from lifecycle_msgs.msg import Transition
from live_robot import Robot, node_process, spinning_node

from gam_relocalizer.ros.conditions import Condition
from gam_relocalizer.scene_map import MANIFEST, RUN_TIME_FILES

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from live_robot import NodeProcess
    from tiny_place import TinyPlace

    Running = tuple[NodeProcess, Robot, Doctor]


@pytest.fixture(scope='module')
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    log = tmp_path_factory.mktemp('node') / 'node.log'
    with node_process(log, autostart=False) as node, spinning_node('robot') as own:
        robot = Robot(own)
        yield node, robot, Doctor(robot)


def truncate(file: Path) -> None:
    with file.open('r+b') as content:
        content.truncate(file.stat().st_size // 2)


def remove(file: Path) -> None:
    file.unlink()


@pytest.mark.parametrize('name', [MANIFEST, *RUN_TIME_FILES])
def test_a_map_with_a_damaged_file_is_refused_by_its_name(
    running: Running, tiny_place: TinyPlace, tmp_path: Path, name: str
) -> None:
    node, robot, doctor = running
    for damage in (truncate, remove):
        damaged = tmp_path / damage.__name__
        shutil.copytree(tiny_place.map_path, damaged)
        damage(damaged / name)
        assert robot.set_parameter('map', str(damaged)) == (True, '')
        assert not robot.change_state(Transition.TRANSITION_CONFIGURE)
        assert robot.state() == 'unconfigured'
        line = next(line for line in node.log.splitlines() if str(damaged) in line)
        assert name in line
    report = doctor.wait_for('state', Condition.TRANSITION_FAILED, str(damaged))
    assert name in report.message


def test_a_whole_map_is_taken_after_all_of_them(running: Running, tiny_place: TinyPlace) -> None:
    _, robot, doctor = running
    assert robot.set_parameter('map', str(tiny_place.map_path)) == (True, '')
    assert robot.change_state(Transition.TRANSITION_CONFIGURE)
    doctor.wait_for('state', Condition.INACTIVE)
