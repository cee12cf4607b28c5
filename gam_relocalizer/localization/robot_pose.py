# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""From the pose of a camera to the pose of the robot that carries it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, unique
from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.geometry import (
    covariance_of_map_from_base,
    rigid3d_from_rotation,
    rotation_of,
    symmetric,
)

if TYPE_CHECKING:
    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.localization.result import PoseEstimate


@unique
class CovarianceMode(Enum):
    """What a consumer of the covariance takes."""

    FULL = 'full'
    DIAGONAL = 'diagonal'


@dataclass(frozen=True)
class CovarianceOptions:
    """What is known about the errors beyond what image and map tell.

    The floors stand for what neither can know: the mount, the stamps, the survey behind the map.

    Attributes:
        position_scale: Factor on standard deviations of the position.
        orientation_scale: Factor on standard deviations of the orientation.
        position_floor: Standard deviation added to each axis [m]: errors of the map itself.
        orientation_floor: Standard deviation added about each axis [rad].
        mode: `DIAGONAL` drops the correlations, for consumers that refuse negative elements.
    """

    position_scale: float = 1.0
    orientation_scale: float = 1.0
    position_floor: float = 0.01
    orientation_floor: float = 0.002
    mode: CovarianceMode = CovarianceMode.FULL


@dataclass(frozen=True)
class RobotPose:
    """Where the robot is.

    Attributes:
        map_from_base: The pose; its quaternion has unit length.
        covariance: [6,6], symmetric and positive definite, order of REP-103: x, y, z, rotations
            about the fixed axes of the map.
    """

    map_from_base: pycolmap.Rigid3d
    covariance: NDArray[np.float64]


def robot_pose(
    estimate: PoseEstimate,
    base_from_camera: pycolmap.Rigid3d,
    options: CovarianceOptions | None = None,
) -> RobotPose:
    """Carries pose and covariance from the camera's optical frame to the robot's base.

    Scales and floors are about the camera's pose, and so come before the transport: an orientation
    floor moves a base that is far from its camera, as it should.

    Args:
        estimate: The camera's pose.
        base_from_camera: How the camera is mounted, taken as exact.
        options: Scales, floors and mode.
    """
    options = options or CovarianceOptions()
    map_from_camera = estimate.camera_from_map.inverse()
    map_from_base = map_from_camera * base_from_camera.inverse()
    covariance = covariance_of_map_from_base(
        map_from_camera, _with_margins(estimate.covariance, options), base_from_camera
    )
    if options.mode is CovarianceMode.DIAGONAL:
        covariance = np.diag(np.diag(covariance))
    # through scipy, which normalises: products of rotations drift off unit length
    unit = rigid3d_from_rotation(rotation_of(map_from_base), map_from_base.translation)
    return RobotPose(unit, covariance)


def _with_margins(
    covariance: NDArray[np.float64], options: CovarianceOptions
) -> NDArray[np.float64]:
    scale = np.repeat([options.position_scale, options.orientation_scale], 3)
    floor = np.repeat([options.position_floor, options.orientation_floor], 3)
    return symmetric(covariance * np.outer(scale, scale) + np.diag(np.square(floor)))
