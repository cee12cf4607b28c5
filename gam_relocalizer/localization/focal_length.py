# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Does the focal length that came with an image fit what the image shows?

With a wrong one the camera seems nearer or further than it is, with small residuals and many
inliers. But what is near and what is far then do not quite fit together.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pycolmap

from gam_relocalizer.localization.covariance import (
    cauchy_scale,
    movement_jacobians,
    projection_jacobians,
    sigma_of,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

_MAX_RESIDUAL_SIGMAS = 4.0


@dataclass(frozen=True)
class FocalLength:
    """What an image says about its focal length.

    Attributes:
        ratio: The one that fits best, per given one.
        log_sigma: Standard deviation of the logarithm of the ratio; infinite where the image, as
            one of a flat wall, fits any.
    """

    ratio: float
    log_sigma: float


def focal_length_of(
    camera_from_map: pycolmap.Rigid3d,
    keypoints: NDArray[np.float64],
    points: NDArray[np.float64],
    camera: pycolmap.Camera,
) -> FocalLength:
    """Refines pose and focal length together.

    Args:
        camera_from_map: A pose near the best one for the given focal length.
        keypoints: [K,2] of inliers [px].
        points: [K,3] of inliers, map frame.
        camera: The given camera.
    """
    unknown = FocalLength(1.0, float('inf'))
    # solvers get good numbers when the points are around the origin and of unit size
    centre = np.median(points, axis=0)
    unit = float(np.median(np.linalg.norm(points - centre, axis=1))) or 1.0
    local = (points - centre) / unit
    start = pycolmap.Rigid3d(camera_from_map.rotation, (camera_from_map * centre) / unit)
    refined_camera = copy(camera)
    errors = np.linalg.norm(np.asarray(camera.img_from_cam(start * local)) - keypoints, axis=1)
    if not np.isfinite(errors).all():
        return unknown
    refined = pycolmap.refine_absolute_pose(
        start,
        keypoints,
        local,
        np.ones(len(points), np.bool_),
        refined_camera,
        pycolmap.AbsolutePoseRefinementOptions(
            refine_focal_length=True, loss_function_scale=cauchy_scale(errors)
        ),
    )
    ratio = refined_camera.mean_focal_length() / camera.mean_focal_length()
    if refined is None or not ratio > 0:
        return unknown
    return FocalLength(
        ratio, _log_sigma(refined['cam_from_world'] * local, keypoints, refined_camera)
    )


def _log_sigma(
    in_camera: NDArray[np.float64], keypoints: NDArray[np.float64], camera: pycolmap.Camera
) -> float:
    projected, across = projection_jacobians(camera, in_camera)
    from_centre = projected - [camera.principal_point_x, camera.principal_point_y]
    movements = movement_jacobians(in_camera, across)
    # those models that have two focal lengths are refined in both, and their mean is asked for
    two = len(camera.focal_length_idxs()) == 2
    by_focal_lengths = from_centre[:, :, None] * np.eye(2) if two else from_centre[:, :, None]
    jacobians = np.concatenate([movements, by_focal_lengths], axis=2)
    errors = np.linalg.norm(projected - keypoints, axis=1)
    sigma = sigma_of(errors)
    good = errors < _MAX_RESIDUAL_SIGMAS * sigma
    information = np.einsum('kij,kil->jl', jacobians[good], jacobians[good])
    try:
        variance = np.mean(np.linalg.inv(information)[6:, 6:]) * sigma**2
    except np.linalg.LinAlgError:
        return float('inf')
    return float(np.sqrt(variance)) if variance > 0 else float('inf')
