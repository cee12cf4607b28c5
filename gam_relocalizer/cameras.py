# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Camera models: from COLMAP's one-line form and from the numbers of a sensor_msgs/CameraInfo."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pycolmap

from gam_relocalizer.errors import CameraError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

MAX_IMAGE_SIDE = 16384

# Those of COLMAP that have a focal length; a panorama sees all around and has none.
CAMERA_MODELS = tuple(
    sorted(pycolmap.CameraModelId.__members__.keys() - {'INVALID', 'EQUIRECTANGULAR'})
)

# Beyond so many pixels from where a keypoint was, its ray is not the inverse of its projection.
ROUND_TRIP_PX = 0.5
# Rays further off the axis run away on the image plane, which ends at 90 degrees.
MAX_TANGENT = math.tan(math.radians(80.0))

# OpenCV and ROS put pixel centres at integers, COLMAP at half-integers.
PIXEL_CENTRE = 0.5


@dataclass(frozen=True)
class CameraCalibration:
    """The numbers of a sensor_msgs/CameraInfo, free of any message type.

    Attributes:
        width: Width of the full-resolution image [px].
        height: Height of the full-resolution image [px].
        distortion_model: `plumb_bob`, `rational_polynomial`, `equidistant`, `fisheye` or empty.
        d: Distortion coefficients of that model.
        k: Row-major 3x3 intrinsic matrix of the raw image.
        p: Row-major 3x4 projection matrix of the rectified image.
        binning: Pixels merged in x and y; 0 counts as 1.
        roi: x offset, y offset, width, height in full-resolution pixels; a zero size is "all".
    """

    width: int
    height: int
    distortion_model: str
    d: tuple[float, ...]
    k: tuple[float, ...]
    p: tuple[float, ...]
    binning: tuple[int, int] = (1, 1)
    roi: tuple[int, int, int, int] = (0, 0, 0, 0)


def parse_camera(description: str | Path) -> pycolmap.Camera:
    """Reads `MODEL WIDTH HEIGHT PARAMS...` from a text or from the first line of a file.

    Args:
        description: A path to a file, or the line itself (COLMAP's cameras.txt without the id).

    Raises:
        CameraError: The file is missing or the line is not a camera of one of `CAMERA_MODELS`.
    """
    return camera_from_line(*_description_text(description))


def camera_from_line(text: str, source: str) -> pycolmap.Camera:
    """Reads `MODEL WIDTH HEIGHT PARAMS...`.

    Args:
        text: The line; what follows a `#` is a comment.
        source: Where it comes from, for errors.

    Raises:
        CameraError: The line is not a camera of one of `CAMERA_MODELS`.
    """
    words = text.split('#', maxsplit=1)[0].split()
    if len(words) < 4:
        msg = (
            f'{source}: expected `MODEL WIDTH HEIGHT PARAMS...`, for example '
            f'`PINHOLE 640 480 525 525 320 240`, found `{text.strip()[:80]}`'
        )
        raise CameraError(msg)
    model = words[0].upper()
    try:
        width, height = int(words[1]), int(words[2])
        params = [float(word) for word in words[3:]]
    except ValueError as err:
        msg = f'{source}: width and height must be integers and parameters numbers: {err}'
        raise CameraError(msg) from err
    return _checked_camera(model, width, height, params, source)


def format_camera(camera: pycolmap.Camera) -> str:
    """Writes a camera the way `parse_camera` reads it."""
    params = ' '.join(f'{value:.17g}' for value in camera.params)
    return f'{camera.model_name} {camera.width} {camera.height} {params}'


def camera_from_calibration(
    calibration: CameraCalibration, *, image_is_rectified: bool
) -> pycolmap.Camera:
    """The camera of the published image, after region of interest and binning (REP-104).

    Args:
        calibration: The numbers of the CameraInfo.
        image_is_rectified: Use P and no distortion (rectified image) instead of K and D.

    Raises:
        CameraError: Uncalibrated (K[0] == 0), unknown distortion model or impossible numbers.
    """
    matrix, row = (calibration.p, 4) if image_is_rectified else (calibration.k, 3)
    name = 'P' if image_is_rectified else 'K'
    if len(matrix) != 3 * row or not matrix[0] or not all(math.isfinite(v) for v in matrix):
        msg = (
            f'CameraInfo.{name} is {list(matrix)}: the camera is not calibrated; publish a '
            f"CameraInfo with a calibration (camera_calibration, or the driver's own)"
        )
        raise CameraError(msg)
    model, distortion = ('PINHOLE', []) if image_is_rectified else _distortion(calibration)
    x_offset, y_offset, roi_width, roi_height = calibration.roi
    if not (roi_width and roi_height):
        x_offset, y_offset = 0, 0
        roi_width, roi_height = calibration.width, calibration.height
    x_binning, y_binning = (max(1, binning) for binning in calibration.binning)
    params = [
        matrix[0] / x_binning,
        matrix[row + 1] / y_binning,
        (matrix[2] + PIXEL_CENTRE - x_offset) / x_binning,
        (matrix[row + 2] + PIXEL_CENTRE - y_offset) / y_binning,
        *distortion,
    ]
    width, height = roi_width // x_binning, roi_height // y_binning
    return _checked_camera(model, width, height, params, 'CameraInfo')


def undistort(keypoints: NDArray[np.floating], camera: pycolmap.Camera) -> NDArray[np.float64]:
    """Where the rays of keypoints cut the plane at unit depth.

    Args:
        keypoints: [K,2] pixels, COLMAP convention.
        camera: One of `CAMERA_MODELS`.

    Returns:
        [K,2]; NaN for rays more than 80 degrees off the axis and for keypoints that no ray projects
        to. COLMAP itself answers with a wrong ray for many of them, as in a fisheye's corners.
    """
    pixels = np.asarray(keypoints, np.float64).reshape(-1, 2)
    if not len(pixels):
        return pixels
    on_plane = np.asarray(camera.cam_from_img(pixels), np.float64)
    projected = np.asarray(camera.img_from_cam(np.column_stack([on_plane, np.ones(len(pixels))])))
    offset = np.linalg.norm(projected - pixels, axis=1)
    tangent = np.linalg.norm(on_plane, axis=1)
    known = (offset < ROUND_TRIP_PX) & (tangent < MAX_TANGENT)
    return np.where(known[:, None], on_plane, np.nan)


def have_known_rays(keypoints: NDArray[np.floating], camera: pycolmap.Camera) -> NDArray[np.bool_]:
    """Which keypoints [K,2] `undistort` knows the rays of."""
    return np.asarray(np.isfinite(undistort(keypoints, camera)).all(axis=1))


def _distortion(calibration: CameraCalibration) -> tuple[str, list[float]]:
    """COLMAP model name and distortion parameters of a CameraInfo (OpenCV's order in D)."""
    name, d = calibration.distortion_model, list(calibration.d)
    if not all(math.isfinite(value) for value in d):
        msg = f'CameraInfo.D holds a number that is not finite: {d}'
        raise CameraError(msg)
    if name == '' or not any(d):
        if name in {'equidistant', 'fisheye'}:
            return 'OPENCV_FISHEYE', [0.0, 0.0, 0.0, 0.0]
        return 'PINHOLE', []
    if name == 'plumb_bob' and len(d) in {4, 5}:
        k1, k2, p1, p2, k3 = (*d, 0.0)[:5]
        if not k3:
            return 'OPENCV', [k1, k2, p1, p2]
        return 'FULL_OPENCV', [k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]
    if name == 'rational_polynomial' and len(d) == 8:
        return 'FULL_OPENCV', d
    if name in {'equidistant', 'fisheye'} and len(d) == 4:
        return 'OPENCV_FISHEYE', d
    msg = (
        f'CameraInfo has distortion model `{name}` with {len(d)} coefficients; known are plumb_bob '
        f'(4 or 5), rational_polynomial (8), equidistant or fisheye (4), or none'
    )
    raise CameraError(msg)


def _description_text(description: str | Path) -> tuple[str, str]:
    """The line that describes the camera, and where it came from."""
    path = Path(description)
    try:
        is_file = path.is_file()
    except OSError:  # a description can be longer than a file name may be
        is_file = False
    if not is_file:
        if isinstance(description, Path) or len(str(description).split()) == 1:
            msg = f'camera `{description}`: no such file, and not a `MODEL WIDTH HEIGHT PARAMS...`'
            raise CameraError(msg)
        return str(description), 'camera'
    try:
        lines = path.read_text(encoding='utf-8').splitlines()
    except (OSError, UnicodeDecodeError) as err:
        msg = f'{path}: cannot be read as a camera file: {err}'
        raise CameraError(msg) from err
    for line in lines:
        if line.strip() and not line.lstrip().startswith('#'):
            return line, str(path)
    msg = f'{path}: no camera in it; expected one line `MODEL WIDTH HEIGHT PARAMS...`'
    raise CameraError(msg)


def _checked_camera(
    model: str, width: int, height: int, params: Sequence[float], source: str
) -> pycolmap.Camera:
    """Builds the camera, refusing what COLMAP would abort on."""
    if model not in CAMERA_MODELS:
        msg = (
            f'{source}: camera model `{model}` is unknown or has no focal length; use one of '
            f'{", ".join(CAMERA_MODELS)}'
        )
        raise CameraError(msg)
    if not (0 < width <= MAX_IMAGE_SIDE and 0 < height <= MAX_IMAGE_SIDE):
        msg = f'{source}: image size {width} x {height} is not between 1 and {MAX_IMAGE_SIDE}'
        raise CameraError(msg)
    template = pycolmap.Camera.create_from_model_name(1, model, 1.0, width, height)
    if len(params) != len(template.params):
        msg = (
            f'{source}: model {model} has {len(template.params)} parameters '
            f'({template.params_info}), found {len(params)}'
        )
        raise CameraError(msg)
    camera = pycolmap.Camera(
        camera_id=1, model=model, width=width, height=height, params=list(params)
    )
    camera.has_prior_focal_length = True
    focal = [params[index] for index in camera.focal_length_idxs()]
    if not all(math.isfinite(value) for value in params) or min(focal) <= 0:
        msg = f'{source}: parameters must be finite and the focal length positive, found {params}'
        raise CameraError(msg)
    return camera
