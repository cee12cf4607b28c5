# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import shutil
import time
from itertools import count
from typing import TYPE_CHECKING

import numpy as np
import pytest
import yaml
from builtin_interfaces.msg import Duration
from live_robot import (
    BASE_FROM_CAMERA,
    LATCHED,
    NODE,
    NodeProcess,
    Robot,
    camera_info,
    image_message,
    rigid3d_of,
    spinning_node,
    wait_for,
)
from rcl_interfaces.srv import GetParameters
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import SetBool

from gam_relocalizer.geometry import pose_error
from gam_relocalizer.localization.result import Status
from gam_relocalizer_msgs.srv import LoadMap, LocalizeImage, Relocalize

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    import pycolmap
    from numpy.typing import NDArray
    from tiny_place import TinyPlace

# they rise over all tests of this file, which share a node
STAMPS = count(1000.0, 0.25)
AT_ONCE = Relocalize.Request(timeout=Duration(nanosec=1))
SHIFT = np.array([100.0, -50.0, 0.0])


@pytest.fixture(scope='module')
def node(tiny_place: TinyPlace, tmp_path_factory: pytest.TempPathFactory) -> Iterator[NodeProcess]:
    """A node that tries nothing by itself, but the first image."""
    log = tmp_path_factory.mktemp('node') / 'node.log'
    node = NodeProcess(log, '--map', str(tiny_place.map_path), period=3600.0)
    yield node
    assert node.stop() == 0, node.log
    assert 'Traceback' not in node.log


@pytest.fixture(scope='module')
def running(node: NodeProcess, tiny_place: TinyPlace) -> Iterator[Robot]:
    with spinning_node('robot') as own:
        robot = Robot(own)
        robot.mount_camera()
        robot.connect(node)
        robot.camera_info = camera_info(tiny_place.camera)
        wait_for(lambda: relocalize(robot, tiny_place.queries[0][0]).accepted, 'the mount')
        yield robot


@pytest.fixture
def robot(running: Robot) -> Robot:
    """The robot of all tests here, with nothing heard so far."""
    for messages in vars(running.heard).values():
        messages.clear()
    return running


@pytest.fixture
def moved_map(tiny_place: TinyPlace, tmp_path: Path) -> Path:
    """The same place, with its origin elsewhere."""
    path = tmp_path / 'moved'
    shutil.copytree(tiny_place.map_path, path)
    manifest = yaml.safe_load((path / 'manifest.yaml').read_text(encoding='utf-8'))
    moved = np.array(manifest['frame']['translation']) + SHIFT
    manifest['frame']['translation'] = [float(value) for value in moved]
    (path / 'manifest.yaml').write_text(yaml.safe_dump(manifest), encoding='utf-8')
    return path


class Camera:
    """Goes on showing an image, slowly enough for a node that is at another one."""

    def __init__(self, robot: Robot, pixels: NDArray[np.uint8]) -> None:
        self._robot = robot
        self._pixels = pixels
        self._next = time.monotonic()

    def __call__(self) -> None:
        if time.monotonic() >= self._next:
            self._next = time.monotonic() + 0.2
            self._robot.show(image_message(self._pixels, next(STAMPS)))


def relocalize(robot: Robot, pixels: NDArray[np.uint8]) -> Relocalize.Response:
    camera = Camera(robot, pixels)
    request = Relocalize.Request(timeout=Duration(sec=30))
    return robot.call(Relocalize, f'{NODE}/relocalize', request, 40.0, meanwhile=camera)


def localize(robot: Robot, pixels: NDArray[np.uint8]) -> LocalizeImage.Response:
    request = LocalizeImage.Request(
        image=image_message(pixels, 5.0, frame='telephone'), camera_info=robot.camera_info
    )
    return robot.call(LocalizeImage, f'{NODE}/localize_image', request, 40.0)


def load_map(robot: Robot, path: Path) -> LoadMap.Response:
    return robot.call(LoadMap, f'{NODE}/load_map', LoadMap.Request(path=str(path)), 40.0)


def map_parameter(robot: Robot) -> str:
    request = GetParameters.Request(names=['map'])
    return str(robot.call(GetParameters, f'{NODE}/get_parameters', request).values[0].string_value)


def assert_close(
    found: Relocalize.Response | LocalizeImage.Response, expected: pycolmap.Rigid3d
) -> None:
    assert found.accepted, found.status.reason
    error = pose_error(rigid3d_of(found.pose.pose.pose).inverse(), expected.inverse())
    assert error.position < 0.05
    assert error.rotation_deg < 1.0
    covariance = np.array(found.pose.pose.covariance).reshape(6, 6)
    assert np.linalg.eigvalsh(covariance).min() > 0


def map_from_base(camera_from_map: pycolmap.Rigid3d) -> pycolmap.Rigid3d:
    return (BASE_FROM_CAMERA * camera_from_map).inverse()


def test_relocalize_answers_with_the_pose_of_the_next_image(
    robot: Robot, tiny_place: TinyPlace
) -> None:
    for pixels, camera_from_map in tiny_place.queries[:3]:
        answer = relocalize(robot, pixels)
        assert_close(answer, map_from_base(camera_from_map))
        assert answer.pose.header.frame_id == 'map'
        assert answer.pose.header.stamp == answer.status.header.stamp
        assert answer.status.inliers > 0
        assert answer.status.total_ms > 0
        assert answer.status.confidence > 0.9
    wait_for(lambda: len(robot.heard.poses) == 3, 'the poses on the topic')
    assert robot.heard.poses[-1] == answer.pose


def test_relocalize_answers_with_the_reason_of_a_refusal(
    robot: Robot, tiny_place: TinyPlace
) -> None:
    answer = relocalize(robot, np.zeros_like(tiny_place.queries[0][0]))
    assert not answer.accepted
    assert Status(answer.status.status) is Status.TOO_FEW_FEATURES
    assert answer.status.reason


def test_relocalize_without_an_image_says_so_when_the_time_is_over(robot: Robot) -> None:
    request = Relocalize.Request(timeout=Duration(nanosec=200_000_000))
    answer = robot.call(Relocalize, f'{NODE}/relocalize', request)
    assert not answer.accepted
    assert Status(answer.status.status) is Status.NO_IMAGE
    assert '/image' in answer.status.reason


def test_two_callers_get_the_same_attempt(robot: Robot, tiny_place: TinyPlace) -> None:
    client = robot.node.create_client(Relocalize, f'{NODE}/relocalize')
    robot.request(client, AT_ONCE)
    request = Relocalize.Request(timeout=Duration(sec=30))
    futures = [client.call_async(request) for _ in range(2)]
    robot.request(client, AT_ONCE)  # both are waiting when the next image comes
    camera = Camera(robot, tiny_place.queries[0][0])
    wait_for(lambda: camera() or all(future.done() for future in futures), 'both answers')
    assert futures[0].result() == futures[1].result()


def test_localize_image_gives_the_pose_of_the_camera_and_publishes_nothing(
    robot: Robot, tiny_place: TinyPlace
) -> None:
    for pixels, camera_from_map in tiny_place.queries[:2]:
        answer = localize(robot, pixels)
        assert_close(answer, camera_from_map.inverse())
        assert (answer.pose.header.stamp.sec, answer.pose.header.frame_id) == (5, 'map')
    assert not localize(robot, np.zeros_like(tiny_place.queries[0][0])).accepted
    assert not robot.heard.statuses
    assert not robot.heard.poses


def test_localize_image_names_what_is_wrong_with_the_request(
    robot: Robot, tiny_place: TinyPlace
) -> None:
    answer = localize(robot, tiny_place.queries[0][0][:-8])
    assert Status(answer.status.status) is Status.NO_CALIBRATION
    empty = robot.call(LocalizeImage, f'{NODE}/localize_image', LocalizeImage.Request())
    assert Status(empty.status.status) is Status.UNDECODABLE_IMAGE


def test_more_images_than_can_wait_are_turned_away_with_an_answer(
    robot: Robot, tiny_place: TinyPlace
) -> None:
    client = robot.node.create_client(LocalizeImage, f'{NODE}/localize_image')
    request = LocalizeImage.Request(
        image=image_message(tiny_place.queries[0][0], 5.0), camera_info=robot.camera_info
    )
    assert robot.request(client, request, 40.0).accepted
    futures = [client.call_async(request) for _ in range(9)]
    wait_for(lambda: all(future.done() for future in futures), 'all answers')
    answers = [Status(future.result().status.status) for future in futures]
    assert answers.count(Status.ACCEPTED) >= 4
    assert set(answers) == {Status.ACCEPTED, Status.BUSY}


def test_a_disabled_node_tries_only_what_it_is_asked_for(
    robot: Robot, tiny_place: TinyPlace
) -> None:
    assert robot.set_parameter('period', 0.05)[0]
    enable = f'{NODE}/set_enabled'
    assert robot.call(SetBool, enable, SetBool.Request(data=False)).success
    pixels, camera_from_map = tiny_place.queries[1]
    assert_close(relocalize(robot, pixels), map_from_base(camera_from_map))
    tried = {status.header.stamp.sec for status in robot.heard.statuses}
    for _ in range(4):
        robot.show(image_message(pixels, next(STAMPS)))
        time.sleep(0.1)
    assert_close(relocalize(robot, pixels), map_from_base(camera_from_map))
    assert len(robot.heard.statuses) <= len(tried) + 2
    assert robot.call(SetBool, enable, SetBool.Request(data=True)).success
    robot.ask(image_message(pixels, next(STAMPS)))
    assert robot.set_parameter('period', 3600.0)[0]


def test_another_map_takes_over_while_the_node_runs(
    robot: Robot, tiny_place: TinyPlace, moved_map: Path
) -> None:
    pixels, camera_from_map = tiny_place.queries[0]
    before = relocalize(robot, pixels)
    clouds: list[PointCloud2] = []
    robot.node.create_subscription(PointCloud2, f'{NODE}/map_points', clouds.append, LATCHED)
    wait_for(lambda: clouds, 'the points of the map')
    answer = load_map(robot, moved_map)
    assert answer.success, answer.message
    assert str(moved_map) in answer.message
    assert answer.map_id != before.status.map_id
    assert map_parameter(robot) == str(moved_map)
    after = relocalize(robot, pixels)
    assert after.status.map_id == answer.map_id
    expected = map_from_base(camera_from_map)
    shifted = rigid3d_of(after.pose.pose.pose)
    assert np.linalg.norm(shifted.translation - expected.translation - SHIFT) < 0.05
    wait_for(lambda: len(clouds) > 1, 'the points of the other map')
    assert load_map(robot, tiny_place.map_path).map_id == before.status.map_id
    assert_close(relocalize(robot, pixels), expected)


def test_a_map_that_cannot_be_loaded_changes_nothing(
    robot: Robot, tiny_place: TinyPlace, tmp_path: Path
) -> None:
    pixels, camera_from_map = tiny_place.queries[0]
    before = relocalize(robot, pixels).status.map_id
    answer = load_map(robot, tmp_path / 'nowhere')
    assert not answer.success
    assert 'nowhere' in answer.message
    assert answer.map_id == before
    assert map_parameter(robot) == str(tiny_place.map_path)
    assert_close(relocalize(robot, pixels), map_from_base(camera_from_map))


def test_the_map_in_use_serves_while_another_one_is_loaded(
    robot: Robot, tiny_place: TinyPlace, moved_map: Path
) -> None:
    client = robot.node.create_client(LoadMap, f'{NODE}/load_map')
    assert not robot.request(client, LoadMap.Request()).success
    old = relocalize(robot, tiny_place.queries[0][0]).status.map_id
    loading = client.call_async(LoadMap.Request(path=str(moved_map)))
    second = client.call_async(LoadMap.Request(path=str(tiny_place.map_path)))
    meanwhile = relocalize(robot, tiny_place.queries[0][0])
    wait_for(lambda: loading.done() and second.done(), 'both answers')
    assert loading.result().success
    # while one is being loaded another one is refused, unless it came late
    assert second.result().success or 'being loaded' in second.result().message
    # an attempt that was under way when the map was replaced comes to nothing, and says so
    if 'replaced meanwhile' in meanwhile.status.reason:
        meanwhile = relocalize(robot, tiny_place.queries[0][0])
    assert meanwhile.accepted, meanwhile.status.reason
    assert meanwhile.status.map_id in {old, loading.result().map_id}
    assert load_map(robot, tiny_place.map_path).map_id == old
