# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Which way is up, and where the floor is, from the map alone.

People and robots hold cameras upright: the x axes of upright cameras are horizontal, however they
pan and tilt, so what is perpendicular to them all points up. A floor says it more precisely.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from gam_relocalizer.errors import AlignmentError
from gam_relocalizer.geometry import rigid3d_from_rotation

if TYPE_CHECKING:
    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.alignment.reference import Reference

MAX_ROLL_DEG = 10.0
_TRIALS = 1000
_SEED = 0
_ROUNDS = 10
# Roll within this is no error.
_USUAL_ROLL = math.radians(2.0)
_GROSS = 3.0
# x axes that span less than this (sine of an angle) have no common perpendicular, but many.
_MIN_FAN = 0.17
# The least part of a camera's up direction that has to point up.
_MIN_UPRIGHT = 0.3
# How far the normal of a floor may be from what the cameras say.
_MAX_TILT = math.radians(6.0)
_MAX_TILT_OF_PARALLEL = math.radians(35.0)
_MAX_LEAN = math.radians(5.0)
# The floor: how thick it may be as a share of the distance of what the cameras see, how many
# points it needs, how many of those of the largest plane, and how many may lie below it.
_THICKNESS = 0.01
_MIN_FLOOR_POINTS = 30
_MIN_SHARE_OF_LARGEST = 0.3
_MAX_SHARE_BELOW = 0.1
_MIN_SHARE_OF_CAMERAS_ABOVE = 0.95
# In thicknesses: a narrower patch says less of the up direction than the cameras do.
_MIN_BREADTH = 10.0
_PLANES = 4
_SAMPLED_POINTS = 20_000
_SAMPLED_IMAGES = 50
_NEIGHBOURS = 10
# Normals of ten points scatter.
_MAX_NORMAL_ERROR = math.radians(25.0)


@dataclass(frozen=True)
class Levelled:
    """A map turned upright.

    Attributes:
        level_from_sfm: z up, x where the first camera looks, origin below the first camera on the
            floor, or in it without a floor; unit of the SfM frame.
        camera_heights: [I] of the cameras above the floor; None when none was found.
        floor_points: Points on the floor among those looked at.
        floor_roughness: How far these are off it (root mean square).
        roll_median_deg: How far the cameras' x axes are off the horizontal in the median.
    """

    level_from_sfm: pycolmap.Rigid3d
    camera_heights: NDArray[np.float64] | None
    floor_points: int
    floor_roughness: float
    roll_median_deg: float


@dataclass(frozen=True)
class _Up:
    """The up direction as the cameras have it; vague when it may be tilted about their x axis."""

    direction: NDArray[np.float64]
    x_axis: NDArray[np.float64] | None


@dataclass(frozen=True)
class _Plane:
    """Points p with normal . p = offset; the normal points up.

    The breadth is how far its points spread across its narrower direction, the roughness how far
    they are off the plane (root mean squares).
    """

    normal: NDArray[np.float64]
    offset: float
    points: int
    breadth: float = 0.0
    roughness: float = 0.0

    def heights(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(places @ self.normal - self.offset, np.float64)


def level_reference(reference: Reference) -> Levelled:
    """Finds the up direction and the floor.

    Raises:
        AlignmentError: The cameras do not tell what is up.
    """
    axes = reference.sfm_from_camera.as_matrix()
    up = _up_of_cameras(axes)
    floor = _floor_below(reference, up)
    if up.x_axis is not None and floor is None:
        msg = (
            'all cameras look the same way, so that their tilt is not known, and no floor was '
            'found to tell it; add images that look to the sides, or align by --poses'
        )
        raise AlignmentError(msg)
    direction = up.direction if floor is None else floor.normal
    _check_not_rolled(axes, direction)
    heights = None if floor is None else floor.heights(reference.positions)
    rotation = _rotation_to_level(axes[0], direction)
    origin = reference.positions[0] - direction * (0.0 if heights is None else heights[0])
    return Levelled(
        level_from_sfm=rigid3d_from_rotation(rotation, -rotation.apply(origin)),
        camera_heights=heights,
        floor_points=0 if floor is None else floor.points,
        floor_roughness=0.0 if floor is None else floor.roughness,
        roll_median_deg=roll_median_deg(axes, direction),
    )


def roll_median_deg(axes: NDArray[np.float64], up: NDArray[np.float64]) -> float:
    """How far x axes of cameras [I,3,3] (columns) are off the horizontal in the median [deg]."""
    return math.degrees(float(np.median(np.abs(np.arcsin(np.clip(axes[:, :, 0] @ up, -1, 1))))))


def stands_upright(axes: NDArray[np.float64], up: NDArray[np.float64]) -> bool:
    """Whether most cameras [I,3,3] (columns) are upright for this up direction."""
    upright = bool(np.median(-axes[:, :, 1] @ up) >= _MIN_UPRIGHT)
    return upright and roll_median_deg(axes, up) <= MAX_ROLL_DEG


def _up_of_cameras(axes: NDArray[np.float64]) -> _Up:
    x_axes, tops = axes[:, :, 0], -axes[:, :, 1]
    spread = np.linalg.svd(x_axes, compute_uv=False) / math.sqrt(len(x_axes))
    if len(x_axes) < 2 or spread[1] < _MIN_FAN:
        return _up_of_parallel_cameras(x_axes, tops)
    up = _consensus(x_axes)
    for _ in range(_ROUNDS):
        roll = np.abs(np.arcsin(np.clip(x_axes @ up, -1, 1)))
        near = roll <= max(_USUAL_ROLL, _GROSS * float(np.median(roll)))
        up = np.linalg.svd(x_axes[near])[2][2]
    up = up * np.sign(np.median(tops @ up))
    _check_not_rolled(axes, up)
    return _Up(up, None)


def _up_of_parallel_cameras(x_axes: NDArray[np.float64], tops: NDArray[np.float64]) -> _Up:
    """The mean of the cameras' tops, to be corrected by the floor."""
    x_axis = np.median(x_axes * np.sign(x_axes @ x_axes[0])[:, None], axis=0)
    x_axis /= np.linalg.norm(x_axis)
    top = np.median(tops, axis=0)
    top -= x_axis * (x_axis @ top)
    if float(np.linalg.norm(top)) < math.cos(_MAX_TILT_OF_PARALLEL):
        raise _rolled_error()
    return _Up(top / np.linalg.norm(top), x_axis)


def _consensus(x_axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """The perpendicular of two x axes that is off the fewest of all."""
    count = len(x_axes)
    pairs = np.array(list(itertools.combinations(range(count), 2)) if count < 46 else [])
    if not len(pairs):
        pairs = np.random.default_rng(_SEED).integers(0, count, (_TRIALS, 2))
    candidates = np.cross(x_axes[pairs[:, 0]], x_axes[pairs[:, 1]])
    sines = np.linalg.norm(candidates, axis=1)
    candidates = candidates[sines > _MIN_FAN / 2] / sines[sines > _MIN_FAN / 2, None]
    medians = [np.median(np.abs(x_axes @ one)) for one in candidates]
    best: NDArray[np.float64] = candidates[int(np.argmin(medians))]
    return best


def _check_not_rolled(axes: NDArray[np.float64], up: NDArray[np.float64]) -> None:
    if not stands_upright(axes, up):
        raise _rolled_error()


def _rolled_error() -> AlignmentError:
    msg = (
        'the cameras do not tell what is up: most have to be upright (not rolled, not turned by '
        '90 degrees, and not looking straight up or down); align by --poses or --positions'
    )
    return AlignmentError(msg)


def _rotation_to_level(axes: NDArray[np.float64], up: NDArray[np.float64]) -> Rotation:
    """level_from_sfm: z up, x where a camera (columns: its axes) looks."""
    looks = axes[:, 2]
    if np.linalg.norm(np.cross(looks, up)) < _MIN_FAN:
        looks = -axes[:, 1]
    forward = looks - up * (up @ looks)
    forward /= np.linalg.norm(forward)
    return Rotation.from_matrix(np.stack([forward, np.cross(up, forward), up]))


def _floor_below(reference: Reference, up: _Up) -> _Plane | None:
    """The lowest of the large horizontal planes that nearly nothing lies below."""
    thickness = _THICKNESS * _viewing_distance(reference)
    points = _sampled(reference.points)
    flat = points[_locally_level(points, up)] if len(points) > _NEIGHBOURS else points[:0]
    planes: list[_Plane] = []
    while len(planes) < _PLANES:
        plane = _largest_plane(flat, reference.positions, up, thickness)
        if plane is None or plane.points < _MIN_SHARE_OF_LARGEST * max(
            (one.points for one in planes), default=0
        ):
            break
        planes.append(plane)
        flat = flat[np.abs(plane.heights(flat)) > 3 * thickness]
    floors = [one for one in planes if _is_below_all(one, points, thickness)]
    floor = max(
        floors, key=lambda one: float(np.median(one.heights(reference.positions))), default=None
    )
    if floor is None or floor.breadth >= _MIN_BREADTH * thickness:
        return floor
    return None if up.x_axis is not None else _upright(floor, points, up, thickness)


def _upright(plane: _Plane, points: NDArray[np.float64], up: _Up, thickness: float) -> _Plane:
    """A patch too narrow to tell what is up still tells the height."""
    near = points[np.abs(plane.heights(points)) <= thickness]
    return replace(plane, normal=up.direction, offset=float(np.median(near @ up.direction)))


def _is_below_all(plane: _Plane, points: NDArray[np.float64], thickness: float) -> bool:
    below = float(np.mean(plane.heights(points) < -3 * thickness))
    return below <= _MAX_SHARE_BELOW


def _viewing_distance(reference: Reference) -> float:
    """Median distance of the points that some cameras see."""
    every = max(1, len(reference.names) // _SAMPLED_IMAGES)
    medians = []
    for image in range(0, len(reference.names), every):
        seen = reference.points[reference.scene_map.points_seen_by(image)]
        if len(seen):
            medians.append(np.median(np.linalg.norm(seen - reference.positions[image], axis=1)))
    return float(np.median(medians)) if medians else 0.0


def _sampled(points: NDArray[np.float64]) -> NDArray[np.float64]:
    if len(points) <= _SAMPLED_POINTS:
        return points
    rows = np.random.default_rng(_SEED).choice(len(points), _SAMPLED_POINTS, replace=False)
    return points[np.sort(rows)]


def _locally_level(points: NDArray[np.float64], up: _Up) -> NDArray[np.bool_]:
    """Which points [N,3] have neighbours at about their height."""
    _, near = cKDTree(points).query(points, k=_NEIGHBOURS)
    patches = points[near]
    patches = patches - patches.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum('nki,nkj->nij', patches, patches))[1][:, :, 0]
    most = _MAX_NORMAL_ERROR + (_MAX_TILT if up.x_axis is None else _MAX_TILT_OF_PARALLEL)
    result: NDArray[np.bool_] = np.abs(normals @ up.direction) >= math.cos(most)
    return result


def _largest_plane(
    points: NDArray[np.float64],
    cameras: NDArray[np.float64],
    up: _Up,
    thickness: float,
) -> _Plane | None:
    """The nearly horizontal plane below the cameras that holds most of the points."""
    if len(points) < _MIN_FLOOR_POINTS:
        return None
    rng = np.random.default_rng(_SEED)
    best: _Plane | None = None
    for rows in rng.integers(0, len(points), (_TRIALS, 3)):
        one, two, three = points[rows]
        normal = np.cross(two - one, three - one)
        length = float(np.linalg.norm(normal))
        if length <= 0.0:
            continue
        normal = normal / length * (1.0 if normal @ up.direction > 0 else -1.0)
        plane = _plane(points, normal, float(normal @ one), thickness)
        if plane.points > (best.points if best else 0) and _may_be_floor(plane, cameras, up):
            best = plane
    if best is None:
        return None
    best = _polished(best, points, up, thickness)
    fits = best.points >= _MIN_FLOOR_POINTS and _may_be_floor(best, cameras, up)
    return best if fits else None


def _plane(
    points: NDArray[np.float64], normal: NDArray[np.float64], offset: float, thickness: float
) -> _Plane:
    return _Plane(normal, offset, int((np.abs(points @ normal - offset) <= thickness).sum()))


def _may_be_floor(plane: _Plane, cameras: NDArray[np.float64], up: _Up) -> bool:
    most = _MAX_TILT if up.x_axis is None else _MAX_TILT_OF_PARALLEL
    level = plane.normal @ up.direction >= math.cos(most)
    if up.x_axis is not None:
        level = level and abs(plane.normal @ up.x_axis) <= math.sin(_MAX_LEAN)
    return bool(level and np.mean(plane.heights(cameras) > 0.0) >= _MIN_SHARE_OF_CAMERAS_ABOVE)


def _polished(plane: _Plane, points: NDArray[np.float64], up: _Up, thickness: float) -> _Plane:
    """Least squares over the plane's points."""
    for _ in range(_ROUNDS):
        near = points[np.abs(plane.heights(points)) <= thickness]
        if len(near) < _MIN_FLOOR_POINTS:
            return plane
        centre = near.mean(axis=0)
        _, spread, axes = np.linalg.svd(near - centre, full_matrices=False)
        normal = axes[2] * (1.0 if axes[2] @ up.direction > 0 else -1.0)
        plane = replace(
            _plane(points, normal, float(normal @ centre), thickness),
            breadth=float(spread[1]) / math.sqrt(len(near)),
            roughness=float(spread[2]) / math.sqrt(len(near)),
        )
    return plane
