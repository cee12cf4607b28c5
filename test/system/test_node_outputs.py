# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Frames and covariances of what a running node publishes, as its parameters ask for."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from builtin_interfaces.msg import Duration
from live_robot import BASE_FROM_CAMERA, CAMERA_FRAME, LATCHED, running_node, wait_for
from nav_msgs.msg import Path
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image, PointCloud2

from gam_relocalizer.localization.robot_pose import CovarianceOptions
from gam_relocalizer_msgs.srv import LocalizeImage, Relocalize

if TYPE_CHECKING:
    from collections.abc import Iterator

    from live_robot import Robot
    from numpy.typing import NDArray
    from tiny_place import TinyPlace

MAP_FRAME, BASE_FRAME = 'hall_2', 'trunk'
AT_ONCE = Relocalize.Request(timeout=Duration(nanosec=1))
FLOORS = np.repeat([CovarianceOptions.position_floor, CovarianceOptions.orientation_floor], 3)


@pytest.fixture(scope='module')
def robot(tiny_place: TinyPlace, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    log = tmp_path_factory.mktemp('node') / 'node.log'
    frames = {'map_frame': MAP_FRAME, 'base_frame': BASE_FRAME}
    with running_node(log, tiny_place, **frames) as (_, robot):
        yield robot


def test_every_output_is_in_the_frames_that_were_set(robot: Robot, tiny_place: TinyPlace) -> None:
    drawn: list[Any] = []
    paths: list[Any] = []
    clouds: list[Any] = []
    listen = robot.node.create_subscription
    subscriptions = [
        listen(Image, robot.topic('debug_image'), drawn.append, qos_profile_sensor_data),
        listen(Path, robot.topic('path'), paths.append, 10),
        listen(PointCloud2, robot.topic('map_points'), clouds.append, LATCHED),
    ]
    pixels, camera_from_map = tiny_place.queries[1]

    def all_heard() -> bool:
        image = robot.shot(pixels)
        assert robot.ask(image).accepted
        robot.assert_at(image, BASE_FROM_CAMERA * camera_from_map)
        return bool(drawn and paths and clouds and robot.heard.camera_poses)

    wait_for(all_heard, 'every output')
    for subscription in subscriptions:
        robot.node.destroy_subscription(subscription)
    heard = robot.heard
    in_map = [*heard.poses, *heard.statuses, *heard.camera_poses, *paths, *clouds]
    in_map += [pose for path in paths for pose in path.poses]
    assert {message.header.frame_id for message in in_map} == {MAP_FRAME}
    assert {message.header.frame_id for message in drawn} == {CAMERA_FRAME}


def test_answers_are_in_the_frame_that_was_set(robot: Robot, tiny_place: TinyPlace) -> None:
    image = robot.shot(tiny_place.queries[1][0])
    brought = LocalizeImage.Request(image=image, camera_info=robot.camera_info)
    found = robot.call(LocalizeImage, robot.topic('localize_image'), brought)
    refused = robot.call(Relocalize, robot.topic('relocalize'), AT_ONCE)
    assert (found.accepted, refused.accepted) == (True, False)
    for answer in (found, refused):
        assert answer.pose.header.frame_id == MAP_FRAME
        assert answer.status.header.frame_id == MAP_FRAME


@contextmanager
def changed(robot: Robot, **values: Any) -> Iterator[None]:  # noqa: ANN401 - of parameters
    """Other parameters for a while."""
    before = {
        'base_from_camera': '',
        'covariance_mode': 'full',
        'position_covariance_scale': 1.0,
        'orientation_covariance_scale': 1.0,
        'position_std_floor': CovarianceOptions.position_floor,
        'orientation_std_floor': CovarianceOptions.orientation_floor,
    }
    try:
        for name, value in values.items():
            assert robot.set_parameter(name, value) == (True, '')
        yield
    finally:
        for name in values:
            assert robot.set_parameter(name, before[name]) == (True, '')


@pytest.fixture
def at_camera(robot: Robot) -> Iterator[Robot]:
    """The base is where the camera is: scales and floors, which are of its pose, show as such."""
    with changed(robot, base_from_camera='0 0 0 0 0 0 1'):
        yield robot


def covariance(robot: Robot, tiny_place: TinyPlace, **values: Any) -> NDArray[np.float64]:  # noqa: ANN401
    """The covariance [6,6] of a fix with other parameters; of the same image each time."""
    with changed(robot, **values):
        image = robot.shot(tiny_place.queries[1][0])
        assert robot.ask(image).accepted
        matrix = np.array(robot.fix_of(image).pose.covariance).reshape(6, 6)
    assert (matrix == matrix.T).all()
    assert np.linalg.eigvalsh(matrix).min() > 0
    return matrix


@pytest.mark.parametrize(
    ('values', 'factors'),
    [
        ({'position_covariance_scale': 4.0}, (2.0, 1.0)),
        ({'orientation_covariance_scale': 9.0}, (1.0, 3.0)),
        ({'position_covariance_scale': 0.25, 'orientation_covariance_scale': 4.0}, (0.5, 2.0)),
    ],
)
def test_scales_are_factors_on_the_covariance(
    at_camera: Robot,
    tiny_place: TinyPlace,
    values: dict[str, float],
    factors: tuple[float, float],
) -> None:
    floors = np.diag(FLOORS**2)
    estimated = covariance(at_camera, tiny_place) - floors
    factor = np.repeat(factors, 3)
    scaled = covariance(at_camera, tiny_place, **values)
    np.testing.assert_allclose(scaled, estimated * np.outer(factor, factor) + floors, rtol=1e-6)


def test_floors_are_added_to_each_axis(at_camera: Robot, tiny_place: TinyPlace) -> None:
    before = covariance(at_camera, tiny_place)
    after = covariance(at_camera, tiny_place, position_std_floor=0.5, orientation_std_floor=0.1)
    added = np.diag(np.repeat([0.5, 0.1], 3) ** 2 - FLOORS**2)
    np.testing.assert_allclose(after, before + added, rtol=1e-6)


def test_a_diagonal_covariance_has_the_same_variances_and_nothing_negative(
    robot: Robot, tiny_place: TinyPlace
) -> None:
    full = covariance(robot, tiny_place)
    diagonal = covariance(robot, tiny_place, covariance_mode='diagonal')
    assert (full < 0).any()
    assert (diagonal >= 0).all()
    np.testing.assert_allclose(diagonal, np.diag(np.diag(full)), rtol=1e-6)
