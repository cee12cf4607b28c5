# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What the node says about itself on /diagnostics."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from doctor import PARTS, Doctor
from lifecycle_msgs.msg import Transition
from live_robot import NODE, NodeProcess, Robot, camera_info, image_message, spinning_node, wait_for
from nav_msgs.msg import Odometry
from std_srvs.srv import SetBool

from gam_relocalizer.ros.conditions import Condition, Level, diagnose
from gam_relocalizer.ros.health import Health
from gam_relocalizer.scene_map import load_map
from gam_relocalizer_msgs.srv import LoadMap

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray
    from tiny_place import TinyPlace

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


class Camera:
    """Shows what it sees five times a second, as it is now."""

    def __init__(self, robot: Robot) -> None:
        self.pixels: NDArray[np.uint8] | None = None
        self._robot = robot
        robot.node.create_timer(0.2, self._show)

    def _show(self) -> None:
        if self.pixels is not None:
            self._robot.show(image_message(self.pixels, time.time()))


class Patient:
    """A robot with its camera, and the doctor."""

    def __init__(self, robot: Robot, node: NodeProcess, tiny_place: TinyPlace) -> None:
        self.robot, self.node = robot, node
        self.doctor = Doctor(robot)
        self.camera = Camera(robot)
        self.place = tiny_place.queries[0][0]
        self._calibration = camera_info(tiny_place.camera)

    def begin_anew(self) -> None:
        """Activates the node again: it has heard neither image nor calibration."""
        self.camera.pixels = None
        self.robot.camera_info = self._calibration
        if self.robot.state() == 'active':
            assert self.robot.change_state(Transition.TRANSITION_DEACTIVATE)
            self.robot.wait_until_alone()
        assert self.robot.change_state(Transition.TRANSITION_ACTIVATE)
        self.robot.mount_camera()
        self.robot.connect(self.node)

    def see_place(self) -> None:
        self.camera.pixels = self.place
        wait_for(lambda: int(self.doctor.value('localization', 'fixes')) >= 3, 'three fixes')

    def set_enabled(self, *, enabled: bool) -> None:
        request = SetBool.Request(data=enabled)
        assert self.robot.call(SetBool, f'{NODE}/set_enabled', request).success


@pytest.fixture(scope='module')
def running(tiny_place: TinyPlace, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Patient]:
    log = tmp_path_factory.mktemp('node') / 'node.log'
    # a period that an attempt fits into, on whatever machine
    node = NodeProcess(log, '--map', str(tiny_place.map_path), period=2.0)
    with spinning_node('robot') as own:
        patient = Patient(Robot(own), node, tiny_place)
        wait_for(lambda: patient.doctor.heard, 'diagnostics')
        patient.robot.connect(node)
        yield patient
    assert node.stop() == 0, node.log


@pytest.fixture
def patient(running: Patient) -> Patient:
    running.begin_anew()
    return running


def test_a_robot_that_sees_its_place_is_all_ok(patient: Patient, tiny_place: TinyPlace) -> None:
    patient.see_place()
    doctor = patient.doctor
    assert doctor.levels() == dict.fromkeys(PARTS, OK), doctor.heard[-1]
    assert float(doctor.value('localization', 'acceptance')) > 0
    assert float(doctor.value('localization', 'last_fix_age_s')) < 10
    assert float(doctor.value('latency', 'total_ms')) > float(
        doctor.value('latency', 'extraction_ms')
    )
    manifest = load_map(tiny_place.map_path).manifest
    assert doctor.value('map', 'map_id') == manifest.map_id
    assert 'cpu' in doctor.value('latency', 'device')
    assert doctor.value('input', 'image_publishers') == '1'


def test_reports_come_once_a_second_with_every_part_and_key(patient: Patient) -> None:
    heard = patient.doctor.heard
    heard.clear()
    wait_for(lambda: len(heard) > 4, 'five reports')
    stamps = [one.header.stamp.sec + one.header.stamp.nanosec / 1e9 for one in heard[:5]]
    assert 2.0 < stamps[-1] - stamps[0] < 20.0  # a busy machine may be late, never early
    expected = [(one.part.value, [value.key for value in one.values]) for one in diagnose(Health())]
    for array in heard[:5]:
        assert [
            (status.name.removeprefix('gam_relocalizer: '), [pair.key for pair in status.values])
            for status in array.status
        ] == expected
        assert {status.hardware_id for status in array.status} == {'/image'}


def test_black_images_are_a_warning_with_the_reason(patient: Patient) -> None:
    patient.camera.pixels = np.zeros_like(patient.place)
    report = patient.doctor.wait_for('localization', Condition.FIX_OVERDUE)
    assert 'TOO_FEW_FEATURES' in report.message
    assert patient.doctor.value('localization', 'commonest_refusal') == 'TOO_FEW_FEATURES'
    assert patient.doctor.levels()['input'] == OK


def test_without_camera_info_the_input_is_an_error_that_says_so(patient: Patient) -> None:
    patient.robot.camera_info = None
    patient.camera.pixels = patient.place
    report = patient.doctor.wait_for('input', Condition.IMAGES_UNUSABLE)
    assert 'NO_CALIBRATION' in report.message
    assert '/camera_info' in report.message


def test_a_silent_camera_is_an_error_with_its_topic(patient: Patient) -> None:
    report = patient.doctor.wait_for('input', Condition.NO_IMAGES)
    assert '/image' in report.message


def test_a_node_that_was_disabled_says_so(patient: Patient) -> None:
    patient.set_enabled(enabled=False)
    patient.doctor.wait_for('state', Condition.DISABLED)
    patient.set_enabled(enabled=True)
    wait_for(lambda: patient.doctor.levels()['state'] == OK, 'the node to be enabled again')


def test_a_map_that_cannot_be_loaded_is_a_warning_and_the_one_before_stays(
    patient: Patient, tiny_place: TinyPlace, tmp_path: Path
) -> None:
    def load(path: Path) -> bool:
        request = LoadMap.Request(path=str(path))
        return bool(patient.robot.call(LoadMap, f'{NODE}/load_map', request).success)

    assert not load(tmp_path / 'nowhere')
    report = patient.doctor.wait_for('map', Condition.MAP_REFUSED)
    assert str(tmp_path / 'nowhere') in report.message
    assert patient.doctor.value('map', 'path') == str(tiny_place.map_path)
    assert load(tiny_place.map_path)
    wait_for(lambda: patient.doctor.levels()['map'] == OK, 'the map to be well again')


def test_odometry_of_another_body_is_a_warning(patient: Patient) -> None:
    publisher = patient.robot.node.create_publisher(Odometry, '/odom', 10)
    timer = patient.robot.node.create_timer(
        0.1, lambda: publisher.publish(Odometry(child_frame_id='trailer'))
    )
    report = patient.doctor.wait_for('odometry', Condition.OTHER_BODY)
    patient.robot.node.destroy_timer(timer)
    patient.robot.node.destroy_publisher(publisher)
    assert '`trailer`' in report.message


def test_messages_and_core_number_the_levels_alike() -> None:
    for level in Level:
        assert getattr(DiagnosticStatus, level.name) == bytes([level.value])
