# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from itertools import count
from typing import TYPE_CHECKING

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
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
from nav_msgs.msg import Path
from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from gam_relocalizer.geometry import pose_error, rigid3d_from
from gam_relocalizer.localization.result import Status
from gam_relocalizer.ros.debug_image import GREEN
from gam_relocalizer.scene_map import load_map
from gam_relocalizer_msgs.msg import RelocalizationStatus

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tiny_place import TinyPlace

# they rise over all tests of this file, which share a node
STAMPS = count(1000.0, 0.25)


@pytest.fixture(scope='module')
def node(tiny_place: TinyPlace, tmp_path_factory: pytest.TempPathFactory) -> Iterator[NodeProcess]:
    log = tmp_path_factory.mktemp('node') / 'node.log'
    node = NodeProcess(log, '--map', str(tiny_place.map_path))
    yield node
    assert node.stop() == 0, node.log


@pytest.fixture(scope='module')
def running(node: NodeProcess, tiny_place: TinyPlace) -> Iterator[Robot]:
    with spinning_node('robot') as own:
        robot = Robot(own)
        robot.mount_camera()
        robot.connect(node)
        robot.camera_info = camera_info(tiny_place.camera)
        robot.wait_for_first_fix(tiny_place.queries[0][0], STAMPS)
        yield robot


@pytest.fixture
def robot(running: Robot) -> Robot:
    """The robot of all tests here, with nothing heard so far."""
    for messages in vars(running.heard).values():
        messages.clear()
    return running


def test_the_pose_of_the_base_is_that_of_the_truth(robot: Robot, tiny_place: TinyPlace) -> None:
    for pixels, camera_from_map in tiny_place.queries:
        image = image_message(pixels, next(STAMPS))
        assert robot.ask(image).accepted
        fix = robot.fix_of(image)
        assert fix.header.frame_id == 'map'
        assert fix.header.stamp == image.header.stamp
        base_from_map = BASE_FROM_CAMERA * camera_from_map
        error = pose_error(rigid3d_of(fix.pose.pose).inverse(), base_from_map)
        assert error.position < 0.05
        assert error.rotation_deg < 1.0


def test_the_covariance_can_be_used_by_a_filter(robot: Robot, tiny_place: TinyPlace) -> None:
    image = image_message(tiny_place.queries[0][0], next(STAMPS))
    robot.ask(image)
    covariance = np.array(robot.fix_of(image).pose.covariance).reshape(6, 6)
    assert np.isfinite(covariance).all()
    assert (covariance == covariance.T).all()
    assert np.linalg.eigvalsh(covariance).min() > 0


def test_the_camera_has_its_own_topic(robot: Robot, tiny_place: TinyPlace) -> None:
    pixels, camera_from_map = tiny_place.queries[0]
    image = image_message(pixels, next(STAMPS))
    robot.ask(image)
    wait_for(lambda: robot.heard.camera_poses, 'the pose of the camera')
    pose = robot.heard.camera_poses[-1]
    assert pose.header.stamp == image.header.stamp
    error = pose_error(rigid3d_of(pose.pose).inverse(), camera_from_map)
    assert error.position < 0.05
    assert error.rotation_deg < 1.0


def test_the_status_tells_how_the_pose_came_about(robot: Robot, tiny_place: TinyPlace) -> None:
    status = robot.ask(image_message(tiny_place.queries[0][0], next(STAMPS)))
    assert (status.status, status.status_name) == (RelocalizationStatus.ACCEPTED, 'ACCEPTED')
    assert status.header.frame_id == 'map'
    assert status.map_id
    assert status.scene
    assert status.scenes_tried >= 1
    assert status.keypoints >= status.matches >= status.inliers > 0
    assert 0 < status.inlier_ratio <= 1
    assert 0 < status.coverage <= 1
    assert status.total_ms > status.extraction_ms > 0


def test_a_late_subscriber_gets_the_last_fix(robot: Robot, tiny_place: TinyPlace) -> None:
    image = image_message(tiny_place.queries[0][0], next(STAMPS))
    robot.ask(image)
    robot.fix_of(image)
    heard: list[PoseWithCovarianceStamped] = []
    with spinning_node('late') as late:
        late.create_subscription(
            PoseWithCovarianceStamped, '/relocalized_pose', heard.append, LATCHED
        )
        wait_for(lambda: heard, 'the last fix')
    assert heard[0].header.stamp == image.header.stamp


def refused(robot: Robot, tiny_place: TinyPlace, image: Image) -> Status:
    """The status of an image; makes sure that nothing went to the pose topic for it."""
    status = robot.ask(image)
    assert not status.accepted
    assert status.reason
    # one connection keeps its order: once the next fix is here, a pose would have come before it
    after = image_message(tiny_place.queries[0][0], next(STAMPS))
    robot.ask(after)
    robot.fix_of(after)
    assert [p for p in robot.heard.poses if p.header.stamp == image.header.stamp] == []
    return Status(status.status)


def test_a_black_image_gives_a_reason_and_no_pose(robot: Robot, tiny_place: TinyPlace) -> None:
    black = np.zeros_like(tiny_place.queries[0][0])
    image = image_message(black, next(STAMPS))
    assert refused(robot, tiny_place, image) is Status.TOO_FEW_FEATURES


def test_noise_gives_a_reason_and_no_pose(robot: Robot, tiny_place: TinyPlace) -> None:
    shape = tiny_place.queries[0][0].shape
    noise = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    refused(robot, tiny_place, image_message(noise, next(STAMPS)))


def test_an_unknown_encoding_is_undecodable(robot: Robot, tiny_place: TinyPlace) -> None:
    image = image_message(tiny_place.queries[0][0], next(STAMPS), encoding='32FC1')
    assert refused(robot, tiny_place, image) is Status.UNDECODABLE_IMAGE


def test_truncated_data_is_undecodable(robot: Robot, tiny_place: TinyPlace) -> None:
    image = image_message(tiny_place.queries[0][0], next(STAMPS))
    image.data = image.data[:1000]
    assert refused(robot, tiny_place, image) is Status.UNDECODABLE_IMAGE


def test_an_image_of_another_size_has_no_calibration(robot: Robot, tiny_place: TinyPlace) -> None:
    half = np.ascontiguousarray(tiny_place.queries[0][0][::2, ::2])
    image = image_message(half, next(STAMPS))
    assert refused(robot, tiny_place, image) is Status.NO_CALIBRATION


def test_a_camera_that_is_not_mounted_has_no_transform(robot: Robot, tiny_place: TinyPlace) -> None:
    image = image_message(tiny_place.queries[0][0], next(STAMPS), frame='elsewhere')
    assert refused(robot, tiny_place, image) is Status.NO_TRANSFORM
    unnamed = image_message(tiny_place.queries[0][0], next(STAMPS), frame='')
    assert refused(robot, tiny_place, unnamed) is Status.NO_TRANSFORM


def test_an_image_no_newer_than_the_last_is_stale(robot: Robot, tiny_place: TinyPlace) -> None:
    stamp = next(STAMPS)
    robot.ask(image_message(tiny_place.queries[0][0], stamp))
    late = image_message(tiny_place.queries[0][0], stamp - 0.1)
    assert refused(robot, tiny_place, late) is Status.STALE_IMAGE


def test_stamps_of_the_poses_rise(robot: Robot, tiny_place: TinyPlace) -> None:
    images = [image_message(tiny_place.queries[0][0], next(STAMPS)) for _ in range(3)]
    for image in images:
        robot.ask(image)
        robot.fix_of(image)
    stamps = [(p.header.stamp.sec, p.header.stamp.nanosec) for p in robot.heard.poses]
    assert stamps == sorted(set(stamps))


def test_an_uncalibrated_camera_info_is_refused(robot: Robot, tiny_place: TinyPlace) -> None:
    calibrated = robot.camera_info
    robot.camera_info = CameraInfo(width=tiny_place.camera.width, height=tiny_place.camera.height)

    def refusal() -> RelocalizationStatus | None:
        status = robot.ask(image_message(tiny_place.queries[0][0], next(STAMPS)))
        return None if status.accepted else status

    status = wait_for(refusal, 'the CameraInfo to take effect')
    robot.camera_info = calibrated
    robot.wait_for_first_fix(tiny_place.queries[0][0], STAMPS)
    assert status.status == RelocalizationStatus.NO_CALIBRATION


def test_thresholds_change_while_running(robot: Robot, tiny_place: TinyPlace) -> None:
    image = image_message(tiny_place.queries[0][0], next(STAMPS))
    assert robot.set_parameter('min_inliers', 100_000) == (True, '')
    status = robot.ask(image)
    assert robot.set_parameter('min_inliers', 20) == (True, '')
    assert not status.accepted
    assert '100000' in status.reason


def test_what_the_configuration_needed_cannot_change_while_running(robot: Robot) -> None:
    successful, reason = robot.set_parameter('map', '/elsewhere')
    assert not successful
    assert 'map' in reason
    assert robot.set_parameter('map_frame', 'map') == (True, '')


def test_a_mount_given_as_a_parameter_goes_before_tf(robot: Robot, tiny_place: TinyPlace) -> None:
    pixels, camera_from_map = tiny_place.queries[0]
    image = image_message(pixels, next(STAMPS))
    assert robot.set_parameter('base_from_camera', '0 0 1 0 0 0 1') == (True, '')
    robot.ask(image)
    fix = robot.fix_of(image)
    assert robot.set_parameter('base_from_camera', '') == (True, '')
    base_from_camera = rigid3d_from((1, 0, 0, 0), (0, 0, 1))
    error = pose_error(rigid3d_of(fix.pose.pose).inverse(), base_from_camera * camera_from_map)
    assert error.position < 0.05


def test_a_publisher_that_cannot_be_heard_is_named(robot: Robot, node: NodeProcess) -> None:
    best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    publisher = robot.node.create_publisher(Image, '/image', best_effort)
    log = node.wait_for_log('image_reliability')
    robot.node.destroy_publisher(publisher)
    assert 'nothing will be received from a publisher on /image' in log


def test_the_path_grows_with_the_fixes(robot: Robot, tiny_place: TinyPlace) -> None:
    paths: list[Path] = []
    subscription = robot.node.create_subscription(Path, f'{NODE}/path', paths.append, 10)
    wait_for(lambda: robot.node.count_publishers(f'{NODE}/path'), 'the path')

    def two_paths() -> bool:
        robot.ask(image_message(tiny_place.queries[0][0], next(STAMPS)))
        return len(paths) >= 2

    wait_for(two_paths, 'the path')
    robot.node.destroy_subscription(subscription)
    assert len(paths[1].poses) == len(paths[0].poses) + 1
    assert paths[1].poses[-1].header.stamp == paths[1].header.stamp
    assert paths[1].header.frame_id == 'map'


def test_messages_and_core_number_the_verdicts_alike() -> None:
    for status in Status:
        assert getattr(RelocalizationStatus, status.name) == status.value


def test_a_late_listener_gets_the_points_of_the_map(robot: Robot, tiny_place: TinyPlace) -> None:
    clouds: list[PointCloud2] = []
    topic = f'{NODE}/map_points'
    subscription = robot.node.create_subscription(PointCloud2, topic, clouds.append, LATCHED)
    cloud = wait_for(lambda: clouds and clouds[0], 'the points of the map')
    robot.node.destroy_subscription(subscription)
    points = np.frombuffer(cloud.data, '<f4').reshape(-1, 3)
    np.testing.assert_allclose(points, load_map(tiny_place.map_path).points, atol=1e-5)
    assert cloud.header.frame_id == 'map'


def test_the_debug_image_shows_the_inliers_to_who_listens(
    robot: Robot, tiny_place: TinyPlace
) -> None:
    pictures: list[Image] = []
    topic = f'{NODE}/debug_image'
    subscription = robot.node.create_subscription(
        Image, topic, pictures.append, qos_profile_sensor_data
    )
    pixels = tiny_place.queries[0][0]

    def picture() -> Image | None:
        robot.ask(image_message(pixels, next(STAMPS)))
        return pictures[-1] if pictures else None

    drawn = wait_for(picture, 'a debug image')
    robot.node.destroy_subscription(subscription)
    shown = np.frombuffer(drawn.data, np.uint8).reshape(pixels.shape)
    green = (shown == GREEN).all(axis=2)
    assert green.sum() > 500
    # nothing but the drawing differs
    np.testing.assert_array_equal(shown[-5:][~green[-5:]], pixels[-5:][~green[-5:]])
