# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Camera paths through the demo world: the walk that maps it, and a robot's drive."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from gam_relocalizer.geometry import rigid3d_from_rotation

if TYPE_CHECKING:
    import pycolmap
    from numpy.typing import NDArray

SPEED = 0.55
MAX_TURN_RATE = 0.7
_STEP = 0.01

# REP-103: a camera body looks along x, its optical frame along z with x to the right.
CAMERA_LINK_FROM_OPTICAL = rigid3d_from_rotation(
    Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3)
)
# Looks 10 degrees up and 15 degrees to the left of where the robot drives.
BASE_FROM_CAMERA_LINK = rigid3d_from_rotation(
    Rotation.from_euler('ZYX', (15.0, -10.0, 0.0), degrees=True), (0.12, -0.05, 0.9)
)
BASE_FROM_CAMERA = BASE_FROM_CAMERA_LINK * CAMERA_LINK_FROM_OPTICAL


@dataclass(frozen=True, eq=False)
class Drive:
    """A robot's smooth drive on the floor (z = 0).

    Attributes:
        duration: From start to end [s].
    """

    duration: float
    _position: CubicSpline
    _heading: CubicSpline

    def map_from_base(self, t: float) -> pycolmap.Rigid3d:
        """The base's pose at `t` seconds after the start, held at both ends."""
        t = float(np.clip(t, 0.0, self.duration))
        turn = Rotation.from_euler('z', float(self._heading(t)))
        return rigid3d_from_rotation(turn, (*self._position(t), 0.0))

    def camera_from_map(self, t: float) -> pycolmap.Rigid3d:
        """The pose of the camera (optical frame) at `t` seconds after the start."""
        return (self.map_from_base(t) * BASE_FROM_CAMERA).inverse()

    def velocity(self, t: float) -> tuple[float, float]:
        """Forward speed [m/s] and turn rate [rad/s]."""
        forward = float(np.linalg.norm(self._position(t, 1)))
        return forward, float(self._heading(t, 1))


def drive(route: NDArray[np.float64]) -> Drive:
    """A drive along way points [K,2]: steady speed, slower in tight turns and at both ends."""
    path, length = _path(route)
    s = np.arange(0.0, length, _STEP)
    tangent = path(s, 1)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    curvature = np.abs(np.gradient(heading, s))
    speed = np.minimum(SPEED, MAX_TURN_RATE / np.maximum(curvature, 1e-6))
    speed = np.minimum(speed, 0.1 + 0.5 * np.sqrt(np.minimum(s, s[-1] - s)))
    speed = gaussian_filter1d(speed, 0.15 / _STEP, mode='nearest')
    pace = 1.0 / speed
    times = np.concatenate([[0.0], np.cumsum((pace[1:] + pace[:-1]) / 2 * np.diff(s))])
    # A heading smoothed by a hand's breadth is one a differential drive can follow.
    heading = gaussian_filter1d(heading, 0.08 / _STEP, mode='nearest')
    knots = slice(None, None, 5)
    return Drive(
        float(times[knots][-1]),
        CubicSpline(times[knots], path(s)[knots]),
        CubicSpline(times[knots], heading[knots]),
    )


def mapping_views(
    route: NDArray[np.float64],
    *,
    spacing: float = 0.8,
    directions: int = 3,
    height: float = 1.35,
) -> list[pycolmap.Rigid3d]:
    """`camera_from_map` of a walk that stops now and then and looks around.

    Every second stop looks into the gaps of the one before, so that each view overlaps both with
    its neighbours in place and with those in direction.

    Args:
        route: Way points [K,2].
        spacing: Between two stops along the way [m].
        directions: Views per stop, spread over the full circle.
        height: Of the camera above the floor [m].
    """
    path, length = _path(route)
    views = []
    for stop, s in enumerate(np.linspace(0.0, length, max(2, round(length / spacing) + 1))):
        x, y = path(s)
        tangent = path(s, 1)
        forward = np.degrees(np.arctan2(tangent[1], tangent[0]))
        for view in range(directions):
            yaw = forward + 360.0 * (view + 0.5 * (stop % 2)) / directions
            # A hand-held camera is never quite level.
            pitch, roll = -3.0 + 4.0 * np.sin(1.7 * stop + view), 2.0 * np.cos(2.3 * stop + view)
            rotation = Rotation.from_euler('ZYX', (yaw, pitch, roll), degrees=True)
            bob = 0.04 * np.sin(0.9 * stop)
            body = rigid3d_from_rotation(rotation, (x, y, height + bob))
            views.append((body * CAMERA_LINK_FROM_OPTICAL).inverse())
    return views


def _path(route: NDArray[np.float64]) -> tuple[CubicSpline, float]:
    """A smooth curve through way points, by its length [m], and that length."""
    chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(route, axis=0), axis=1))])
    fine = np.linspace(0.0, chord[-1], max(50, round(chord[-1] / _STEP)))
    points = CubicSpline(chord, route)(fine)
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    lengths = np.concatenate([[0.0], np.cumsum(steps)])
    # Rounds corners that a spline through chords may still have.
    count = max(8, round(lengths[-1] / 0.1))
    knots = np.linspace(0.0, lengths[-1], count)
    even = np.stack([np.interp(knots, lengths, points[:, axis]) for axis in range(2)], axis=1)
    return CubicSpline(knots, even), float(lengths[-1])
