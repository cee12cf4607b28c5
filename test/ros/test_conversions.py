# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Messages are built with field checks on (see conftest.py): a wrong type is an AssertionError."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped, Quaternion, Transform, Vector3
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, RegionOfInterest
from std_msgs.msg import Header

from gam_relocalizer.errors import ImageError, TransformError
from gam_relocalizer.geometry import rigid3d_from
from gam_relocalizer.localization.result import (
    LocalizationResult,
    PoseEstimate,
    Status,
    Support,
    Timings,
)
from gam_relocalizer.localization.robot_pose import RobotPose
from gam_relocalizer.replay.messages import calibration_of
from gam_relocalizer.ros.conversions import (
    nanoseconds_from,
    pixels_from,
    pose_stamped_message,
    pose_with_covariance_message,
    rigid3d_from_message,
    stamp_from,
    status_message,
)
from gam_relocalizer_msgs.msg import RelocalizationStatus

REPOSITORY = Path(__file__).parents[2]
HEADER = Header(stamp=Time(sec=3, nanosec=4), frame_id='map')
PIXELS = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)


@given(st.integers(0, 2**31 * 10**9 - 1))
def test_stamps_keep_every_nanosecond(nanoseconds: int) -> None:
    assert nanoseconds_from(stamp_from(nanoseconds)) == nanoseconds


def image(**changes: object) -> Image:
    fields = {'height': 4, 'width': 6, 'encoding': 'rgb8', 'step': 18, 'data': PIXELS.tobytes()}
    return Image(**(fields | changes))


def test_raw_images_are_decoded() -> None:
    np.testing.assert_array_equal(pixels_from(image(), '/image'), PIXELS)
    swapped = pixels_from(image(encoding='bgr8'), '/image')
    np.testing.assert_array_equal(swapped, PIXELS[..., ::-1])


def test_big_endian_grey_is_decoded() -> None:
    grey = (np.arange(24).reshape(4, 6) * 256).astype('>u2')
    message = image(encoding='mono16', step=12, is_bigendian=1, data=grey.tobytes())
    np.testing.assert_array_equal(pixels_from(message, '/image'), np.arange(24).reshape(4, 6))


def test_compressed_images_are_decoded() -> None:
    encoded = cv2.imencode('.png', PIXELS[..., ::-1])[1].tobytes()
    np.testing.assert_array_equal(pixels_from(CompressedImage(data=encoded), '/image'), PIXELS)


@pytest.mark.parametrize(
    'message',
    [image(encoding='32FC1'), image(width=7), image(data=b''), Image(), CompressedImage()],
    ids=['encoding', 'step', 'no data', 'empty', 'empty compressed'],
)
def test_what_cannot_be_decoded_is_an_error_that_names_the_topic(
    message: Image | CompressedImage,
) -> None:
    with pytest.raises(ImageError, match='/front/image'):
        pixels_from(message, '/front/image')


def test_calibrations_are_read_whole() -> None:
    k = [500.0, 0.0, 320.0, 0.0, 501.0, 240.0, 0.0, 0.0, 1.0]
    p = [400.0, 0.0, 310.0, 0.0, 0.0, 401.0, 230.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    message = CameraInfo(
        width=640,
        height=480,
        distortion_model='plumb_bob',
        d=[0.1, 0.2, 0.3, 0.4, 0.5],
        k=k,
        p=p,
        binning_x=2,
        binning_y=1,
        roi=RegionOfInterest(x_offset=1, y_offset=2, width=30, height=40),
    )
    calibration = calibration_of(message)
    assert (calibration.width, calibration.height) == (640, 480)
    assert calibration.distortion_model == 'plumb_bob'
    assert calibration.d == (0.1, 0.2, 0.3, 0.4, 0.5)
    assert (list(calibration.k), list(calibration.p)) == (k, p)
    assert calibration.binning == (2, 1)
    assert calibration.roi == (1, 2, 30, 40)


def test_transforms_are_parent_from_child() -> None:
    turn = Quaternion(x=0.0, y=0.0, z=0.6, w=0.8)
    transform = Transform(translation=Vector3(x=1.0, y=2.0, z=3.0), rotation=turn)
    parent_from_child = rigid3d_from_message(transform)
    in_parent = parent_from_child * np.array([1.0, 0.0, 0.0])
    np.testing.assert_allclose(in_parent, [1.28, 2.96, 3.0], atol=1e-12)


def test_a_transform_without_rotation_is_refused() -> None:
    nothing = Transform(rotation=Quaternion(x=0.0, y=0.0, z=0.0, w=0.0))
    with pytest.raises(TransformError):
        rigid3d_from_message(nothing)


def test_a_pose_survives_the_wire() -> None:
    root = np.random.default_rng(0).normal(size=(6, 6))
    pose = RobotPose(rigid3d_from((0.1, 0.2, -0.3, 0.9), (1, 2, 3)), root @ root.T)
    message = pose_with_covariance_message(pose, HEADER)
    received = deserialize_message(serialize_message(message), PoseWithCovarianceStamped)
    position, orientation = received.pose.pose.position, received.pose.pose.orientation
    quaternion = (orientation.w, orientation.x, orientation.y, orientation.z)
    assert abs(np.linalg.norm(quaternion) - 1.0) < 1e-12
    again = rigid3d_from(quaternion, (position.x, position.y, position.z))
    np.testing.assert_allclose(again.matrix(), pose.map_from_base.matrix(), atol=1e-15)
    np.testing.assert_array_equal(np.array(received.pose.covariance).reshape(6, 6), pose.covariance)
    assert received.header == HEADER


def test_a_pose_without_covariance_has_the_same_numbers() -> None:
    map_from_camera = rigid3d_from((0.5, 0.5, -0.5, 0.5), (1, 2, 3))
    message = pose_stamped_message(map_from_camera, HEADER)
    assert message.pose.position.z == 3.0
    assert message.pose.orientation.y == -0.5
    assert message.header == HEADER


def test_a_status_survives_the_wire() -> None:
    estimate = PoseEstimate(
        camera_from_map=rigid3d_from((1, 0, 0, 0), (0, 0, 0)),
        covariance=np.eye(6),
        inlier_keypoints=np.zeros((5, 2), np.float32),
        inlier_features=np.arange(5),
        inlier_points=np.arange(5),
        inlier_ratio=np.float64(0.5),
        coverage=np.float32(0.25),
        reprojection_error=1.5,
        support=Support(in_view=500, unmatched=0.1),
        belief=0.99,
    )
    result = LocalizationResult(
        Status.LOW_INLIER_RATIO,
        'few',
        estimate,
        keypoints=np.int64(20),
        matches=10,
        scene='a.jpg',
        scenes_tried=2,
        confidence=np.float64(0.75),
        timings=Timings(1.0, 2.0, 3.0, 4.0, 5.0),
    )
    sent = status_message(result, HEADER, 'abc')
    status = deserialize_message(serialize_message(sent), RelocalizationStatus)
    assert (status.status, status.status_name) == (15, 'LOW_INLIER_RATIO')
    assert (status.accepted, status.reason, status.map_id) == (False, 'few', 'abc')
    assert (status.scene, status.scenes_tried) == ('a.jpg', 2)
    assert (status.keypoints, status.matches, status.inliers) == (20, 10, 5)
    assert (status.inlier_ratio, status.coverage) == (0.5, 0.25)
    assert (status.reprojection_error_px, status.confidence) == (1.5, 0.75)
    stages = status.extraction_ms, status.retrieval_ms, status.matching_ms
    assert (*stages, status.pose_ms, status.verdict_ms) == (1.0, 2.0, 3.0, 4.0, 5.0)
    assert status.total_ms == 15.0


def test_statuses_have_the_numbers_of_the_message() -> None:
    file = REPOSITORY / 'gam_relocalizer_msgs' / 'msg' / 'RelocalizationStatus.msg'
    text = file.read_text(encoding='utf-8')
    constants = re.findall(r'^uint8 ([A-Z_]+)=(\d+)$', text, re.MULTILINE)
    assert {name: int(number) for name, number in constants} == {
        status.name: status.value for status in Status
    }
    for status in Status:
        assert getattr(RelocalizationStatus, status.name) == status.value


@pytest.mark.parametrize('status', Status)
def test_every_status_has_a_message_without_an_estimate(status: Status) -> None:
    message = status_message(LocalizationResult(status, 'why'), HEADER, '')
    serialize_message(message)
    assert message.accepted == (status is Status.ACCEPTED)
    assert message.inliers == 0
