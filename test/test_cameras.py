# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Cameras from text and from the numbers of a CameraInfo, held against OpenCV's projection."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gam_relocalizer.cameras import (
    CAMERA_MODELS,
    CameraCalibration,
    camera_from_calibration,
    format_camera,
    parse_camera,
    undistort,
)
from gam_relocalizer.errors import CameraError

K = (410.0, 0.0, 322.5, 0.0, 405.0, 238.25, 0.0, 0.0, 1.0)
P = (380.0, 0.0, 318.0, 0.0, 0.0, 382.0, 241.0, 0.0, 0.0, 0.0, 1.0, 0.0)
RAW = CameraCalibration(640, 480, '', (), K, P)


def points_in_camera() -> np.ndarray:
    rng = np.random.default_rng(1)
    depth = rng.uniform(2.0, 6.0, (50, 1))
    return np.hstack([rng.uniform(-0.5, 0.5, (50, 2)), np.ones((50, 1))]) * depth


def projected_by_opencv(calibration: CameraCalibration, points: np.ndarray) -> np.ndarray:
    matrix = np.array(calibration.k).reshape(3, 3)
    zero, d = np.zeros(3), np.array(calibration.d)
    if calibration.distortion_model in {'equidistant', 'fisheye'}:
        pixels, _ = cv2.fisheye.projectPoints(points[:, None], zero, zero, matrix, d)
    else:
        pixels, _ = cv2.projectPoints(points, zero, zero, matrix, d)
    return pixels.reshape(-1, 2)


@pytest.mark.parametrize(
    ('distortion_model', 'd'),
    [
        ('', ()),
        ('plumb_bob', (0.0, 0.0, 0.0, 0.0, 0.0)),
        ('plumb_bob', (-0.28, 0.07, 0.001, -0.0004)),
        ('plumb_bob', (-0.28, 0.07, 0.001, -0.0004, 0.0)),
        ('plumb_bob', (-0.28, 0.07, 0.001, -0.0004, 0.02)),
        ('rational_polynomial', (0.4, -0.1, 0.0005, -0.0007, 0.02, 0.6, -0.02, 0.01)),
        ('equidistant', (-0.02, 0.01, -0.003, 0.001)),
        ('fisheye', (-0.02, 0.01, -0.003, 0.001)),
        ('equidistant', (0.0, 0.0, 0.0, 0.0)),
    ],
)
def test_projects_like_opencv(distortion_model: str, d: tuple[float, ...]) -> None:
    calibration = replace(RAW, distortion_model=distortion_model, d=d)
    camera = camera_from_calibration(calibration, image_is_rectified=False)
    points = points_in_camera()
    assert (camera.width, camera.height) == (640, 480)
    np.testing.assert_allclose(
        np.asarray(camera.img_from_cam(points)) - 0.5,
        projected_by_opencv(calibration, points),
        atol=1e-6,
    )


def test_rectified_image_uses_projection_matrix_and_no_distortion() -> None:
    calibration = replace(RAW, distortion_model='plumb_bob', d=(-0.28, 0.07, 0.0, 0.0, 0.0))
    camera = camera_from_calibration(calibration, image_is_rectified=True)
    points = points_in_camera()
    homogeneous = points @ np.array(P).reshape(3, 4)[:, :3].T
    np.testing.assert_allclose(
        np.asarray(camera.img_from_cam(points)) - 0.5, homogeneous[:, :2] / homogeneous[:, 2:]
    )


def test_region_of_interest_and_binning_move_and_scale_pixels() -> None:
    calibration = replace(
        RAW,
        distortion_model='plumb_bob',
        d=(-0.28, 0.07, 0.001, -0.0004, 0.0),
        roi=(64, 32, 512, 400),
        binning=(2, 4),
    )
    camera = camera_from_calibration(calibration, image_is_rectified=False)
    points = points_in_camera()
    full = projected_by_opencv(calibration, points) + 0.5
    assert (camera.width, camera.height) == (256, 100)
    np.testing.assert_allclose(
        np.asarray(camera.img_from_cam(points)), (full - [64, 32]) / [2, 4], atol=1e-6
    )


def test_zero_binning_and_zero_region_mean_the_whole_image() -> None:
    plain = camera_from_calibration(RAW, image_is_rectified=False)
    zeros = replace(RAW, binning=(0, 0), roi=(0, 0, 0, 0))
    assert camera_from_calibration(zeros, image_is_rectified=False).params_to_string() == (
        plain.params_to_string()
    )


@pytest.mark.parametrize(
    'changes',
    [
        {'k': (0.0,) * 9},
        {'k': ()},
        {'k': (np.nan, *K[1:])},
        {'k': (-0.9 * K[4], *K[1:])},  # its mean with the other is positive
        {'distortion_model': 'plumb_bob', 'd': (0.1, 0.2)},
        {'distortion_model': 'plumb_bob', 'd': (0.1, np.inf, 0.0, 0.0)},
        {'distortion_model': 'kannala', 'd': (0.1, 0.2, 0.0, 0.0)},
        {'width': 0},
        {'binning': (1000, 1)},
    ],
)
def test_refuses_what_is_no_calibration(changes: dict[str, object]) -> None:
    with pytest.raises(CameraError):
        camera_from_calibration(replace(RAW, **changes), image_is_rectified=False)


def test_refuses_rectified_image_without_projection_matrix() -> None:
    with pytest.raises(CameraError):
        camera_from_calibration(replace(RAW, p=(0.0,) * 12), image_is_rectified=True)


@pytest.mark.parametrize('model', CAMERA_MODELS)
def test_format_and_parse_are_inverse_for_every_model(model: str) -> None:
    camera = pycolmap.Camera.create_from_model_name(1, model, 433.3, 640, 480)
    parsed = parse_camera(format_camera(camera))
    assert (parsed.model_name, parsed.width, parsed.height) == (model, 640, 480)
    np.testing.assert_array_equal(parsed.params, camera.params)


@given(st.lists(st.floats(1e-3, 1e5), min_size=4, max_size=4))
def test_parameters_survive_the_text_exactly(params: list[float]) -> None:
    camera = pycolmap.Camera(camera_id=1, model='PINHOLE', width=9, height=7, params=params)
    np.testing.assert_array_equal(parse_camera(format_camera(camera)).params, params)


def test_reads_first_camera_of_a_file_past_comments(tmp_path) -> None:  # noqa: ANN001
    file = tmp_path / 'camera.txt'
    file.write_text('# a comment\n\nsimple_pinhole 640 480 518.0 320 240  # nominal\n')
    for description in (file, str(file)):
        camera = parse_camera(description)
        assert camera.model_name == 'SIMPLE_PINHOLE'
        np.testing.assert_array_equal(camera.params, [518.0, 320.0, 240.0])


@pytest.mark.parametrize(
    'description',
    [
        '',
        'nowhere.txt',
        'PINHOLE 640 480',
        'PINHOLE 640 480 500 500 320',
        'PINHOLE 640 480 500 500 320 240 0.1',
        'PINHOLE 640 480 500 500 320 nan',
        'PINHOLE 640 480 500 500 320 a',
        'PINHOLE 640 480 -500 -500 320 240',
        'PINHOLE 0 480 500 500 320 240',
        'PINHOLE 640 1000000 500 500 320 240',
        'PINHOLE 640.5 480 500 500 320 240',
        'INVALID 640 480 500 500 320 240',
        'EQUIRECTANGULAR 640 480 640 480',
        'PIN_HOLE 640 480 500 500 320 240',
        '640 480 500 500 320 240',
    ],
)
def test_refuses_text_that_is_no_camera(description: str) -> None:
    with pytest.raises(CameraError):
        parse_camera(description)


def test_tells_which_models_there_are_instead_of_a_panorama() -> None:
    with pytest.raises(CameraError) as caught:
        parse_camera('EQUIRECTANGULAR 640 480 640 480')
    assert all(model in str(caught.value) for model in ('EQUIRECTANGULAR', *CAMERA_MODELS))


@pytest.mark.parametrize('content', [b'', b'# nothing\n', b'\xff\xfe\x00PINHOLE'])
def test_refuses_file_without_a_camera(tmp_path, content: bytes) -> None:  # noqa: ANN001
    file = tmp_path / 'camera.txt'
    file.write_bytes(content)
    with pytest.raises(CameraError):
        parse_camera(file)


@pytest.mark.parametrize(
    ('model', 'params'),
    [
        ('PINHOLE', [330, 330, 512, 384]),
        ('OPENCV_FISHEYE', [330, 330, 512, 384, -0.02, 0.01, 0.0, 0.0]),
        ('FOV', [330, 330, 512, 384, 0.9]),
        ('EUCM', [330, 330, 512, 384, 0.6, 1.0]),
        ('SIMPLE_DIVISION', [330, 512, 384, -0.3]),
    ],
)
def test_a_known_ray_projects_to_its_keypoint_even_in_the_corners(
    model: str, params: list[float]
) -> None:
    camera = pycolmap.Camera(camera_id=1, model=model, width=1024, height=768, params=params)
    keypoints = np.random.default_rng(0).uniform([0, 0], [1024, 768], (2000, 2))
    rays = undistort(keypoints, camera)
    known = np.isfinite(rays).all(axis=1)
    again = np.asarray(camera.img_from_cam(np.column_stack([rays, np.ones(2000)])[known]))
    assert np.mean(known) > 0.7
    assert np.linalg.norm(again - keypoints[known], axis=1).max() < 0.5
