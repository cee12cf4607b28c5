# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What may be known about a camera before its image is looked at."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.errors import UsageError
from gam_relocalizer.geometry import pose_error, rotation_of

if TYPE_CHECKING:
    import pycolmap
    from numpy.typing import NDArray

UP_IN_MAP = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class PositionHint:
    """Where the camera may be: from odometry since the last fix, or from a person.

    It says where to look first. It never excludes a place, so a wrong hint costs time, not a fix.

    Attributes:
        position: [3] in the map.
        radius: How far off the hint may be [map units]; may be infinite.

    Raises:
        UsageError: The position is not three finite numbers, or the radius is negative or none.
    """

    position: NDArray[np.float64]
    radius: float

    def __post_init__(self) -> None:
        object.__setattr__(self, 'position', _vector(self.position, 'the position of a hint'))
        if not self.radius >= 0.0:  # not a number compares as false
            msg = f'the radius of a position hint is {self.radius}; expected 0 or more map units'
            raise UsageError(msg)


@dataclass(frozen=True)
class Gravity:
    """Which way is up for the camera: from an IMU, or from a robot that does not topple.

    Attributes:
        up_in_camera: [3] against the pull of gravity, optical frame; becomes a unit vector.
        tolerance_deg: A pose that tilts it further from the map's z axis is not plausible.

    Raises:
        UsageError: The vector is not three finite numbers or is zero, or the tolerance is not an
            angle from 0 to 180 degrees.
    """

    up_in_camera: NDArray[np.float64]
    tolerance_deg: float

    def __post_init__(self) -> None:
        up = _vector(self.up_in_camera, 'the up vector of a camera')
        longest = np.abs(up).max()  # first, so that no square of a tiny or huge number is lost
        if not longest:
            msg = 'the up vector of a camera is zero; expected a direction'
            raise UsageError(msg)
        up = up / longest
        object.__setattr__(self, 'up_in_camera', up / np.linalg.norm(up))
        if not 0.0 <= self.tolerance_deg <= 180.0:
            msg = f'the tolerance of gravity is {self.tolerance_deg} deg; expected 0 to 180 deg'
            raise UsageError(msg)


@dataclass(frozen=True)
class Expectation:
    """Where odometry has brought the camera since the last fix.

    A pose that agrees is easier to believe: a wrong one would have to be wrong in this very way. A
    pose that does not agree is not harder to believe, so a wrong expectation costs no fix.

    Attributes:
        camera_from_map: The pose expected.
        position_margin: How far off it may be [map units].
        rotation_margin_deg: How far turned it may be.
    """

    camera_from_map: pycolmap.Rigid3d
    position_margin: float
    rotation_margin_deg: float

    def agrees_with(self, camera_from_map: pycolmap.Rigid3d) -> bool:
        """Whether a pose is as expected."""
        apart = pose_error(camera_from_map, self.camera_from_map)
        return (
            apart.position <= self.position_margin
            and apart.rotation_deg <= self.rotation_margin_deg
        )


@dataclass(frozen=True)
class Prior:
    """All that is known; nothing by default.

    Attributes:
        hint: Where to look first.
        gravity: Only for maps whose z axis points up.
        expectation: Which pose to believe sooner.
    """

    hint: PositionHint | None = None
    gravity: Gravity | None = None
    expectation: Expectation | None = None


def tilt_deg(camera_from_map: pycolmap.Rigid3d, gravity: Gravity) -> float:
    """Angle [deg] between up as a pose has it, the map's z axis, and up as gravity has it."""
    up_of_pose = rotation_of(camera_from_map).apply(UP_IN_MAP)
    across = np.linalg.norm(np.cross(up_of_pose, gravity.up_in_camera))
    return math.degrees(math.atan2(float(across), float(up_of_pose @ gravity.up_in_camera)))


def _vector(numbers: object, what: str) -> NDArray[np.float64]:
    try:
        vector = np.array(numbers, dtype=float)
    except (TypeError, ValueError):
        vector = np.empty(0)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        msg = f'{what} is {numbers}; expected three finite numbers x y z'
        raise UsageError(msg)
    return vector
