# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""How far off a pose may be: from its residuals, the map's points, and what neither can show.

Three things move a keypoint away from where its point projects:

- noise of the keypoint, different for each;
- the error of the point, which was triangulated from keypoints with the same noise. How far that
  moves it, and in which direction, follows from the directions that it was seen from;
- errors that neighbours share: poses of the reference images, the camera's calibration, keypoints
  that sit on the same edge. The pose follows them, so that residuals show little of them.

The pose is an M-estimate; its covariance is A^-1 B A^-1 with A the information of its matches and B
the sum of what the three contribute (Huber's sandwich).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.geometry import covariance_of_map_from_camera

if TYPE_CHECKING:
    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.scene_map import SceneMap

# Cauchy's loss keeps 95 % of the efficiency of least squares at this many standard deviations.
CAUCHY_SCALE = 2.385
# Median length of a 2D Gaussian of unit variance (Rayleigh distribution).
RAYLEIGH_MEDIAN = 1.1774
# Keypoints are found on a grid of pixels and points were triangulated from such keypoints: however
# well a few inliers agree, a coordinate is not better known than this.
MIN_SIGMA_PX = 0.5
# Share of the variance that neighbours have in common, and the distance, per longer side of the
# image, at which 60 % of that is left. Measured: with these the errors of poses on rendered places
# are as large as their covariance says (benchmarks/adversaries.py prints it).
SHARED_VARIANCE = 0.05
SHARED_DISTANCE = 0.15
# A keypoint is known to about a pixel, at 1024 pixels and less. Larger residuals are errors of the
# map or the calibration, all of which neighbours share.
KEYPOINT_SIGMA_PX = 1.3
KEYPOINT_SIDE = 1024.0
# Neighbours are treated together, in cells of a grid over the image.
_CELLS = 8
# A point seen from one direction has no depth; this many times its sideways error stands for it.
_MAX_DEPTH_RATIO = 100.0
# A point may lie in the very camera that saw it, in a damaged map; its square must not be zero.
_LEAST_DISTANCE = 1e-100


def point_covariances(
    scene_map: SceneMap, points: NDArray[np.int64], images: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Errors of triangulated points when each line of sight is off by one radian.

    Args:
        scene_map: Tells from which reference images a point was seen.
        points: [K] indices of points.
        images: [m] reference images, each point seen by one of them at least.

    Returns:
        [K,3,3] in the map frame [map units^2 / rad^2]; to be scaled by the true noise.
    """
    observers = scene_map.covisible_with(images)
    observed = scene_map.observers_of(points, observers)
    rows = np.repeat(np.arange(len(points)), np.diff(observed.indptr))
    positions = scene_map.camera_positions[observers[observed.indices]]
    sight = scene_map.positions_of(points)[rows] - positions
    distance = np.linalg.norm(sight, axis=1)
    distance = np.maximum(distance, _LEAST_DISTANCE)
    sight /= distance[:, None]
    across = (np.eye(3) - sight[:, :, None] * sight[:, None, :]) / np.square(distance)[
        :, None, None
    ]
    information = np.zeros((len(points), 3, 3))
    np.add.at(information, rows, across)
    values, vectors = np.linalg.eigh(information)
    values = np.maximum(values, values[:, 2:] / _MAX_DEPTH_RATIO**2)
    covariances: NDArray[np.float64] = np.einsum('kij,kj,klj->kil', vectors, 1.0 / values, vectors)
    return covariances


def pose_covariance(
    camera_from_map: pycolmap.Rigid3d,
    keypoints: NDArray[np.float64],
    points: NDArray[np.float64],
    covariances: NDArray[np.float64],
    camera: pycolmap.Camera,
) -> NDArray[np.float64] | None:
    """Covariance of a pose that minimises Cauchy's loss over matches.

    Args:
        camera_from_map: The minimum.
        keypoints: [K,2] px.
        points: [K,3] map frame.
        covariances: [K,3,3] of the points, see `point_covariances`.
        camera: Any model.

    Returns:
        [6,6] of `map_from_camera`, order of REP-103; nothing where the matches do not determine it.
    """
    in_camera = np.asarray(camera_from_map * points, np.float64)
    projected, across = projection_jacobians(camera, in_camera)
    known = np.isfinite(projected).all(axis=1) & np.isfinite(across).all(axis=(1, 2))
    keypoints, in_camera, across = keypoints[known], in_camera[known], across[known]
    residuals = projected[known] - keypoints
    jacobians = movement_jacobians(in_camera, across)

    spread = _spread_by_points(camera_from_map, across, covariances[known], camera)
    variance = _noise_variance(residuals, spread)
    errors = np.linalg.norm(residuals, axis=1)
    # the divergence of psi in two dimensions, for Cauchy's weight w, is 2 w^2
    trust = np.square(1.0 / (1.0 + np.square(errors / cauchy_scale(errors))))
    information = np.einsum('k,kij,kil->jl', trust, jacobians, jacobians)
    own = (
        (1.0 - SHARED_VARIANCE)
        * variance
        * np.mean(trust)
        * np.einsum('k,kij,kil,klm->jm', trust, jacobians, spread, jacobians)
    )
    weighted = np.swapaxes(jacobians, 1, 2) @ _square_roots(spread) * trust[:, None, None]
    shared = _shared_variance(variance, camera) * _shared_by_neighbours(weighted, keypoints, camera)
    try:
        inverse = np.linalg.inv(information)
    except np.linalg.LinAlgError:
        return None
    covariance = inverse @ (own + shared) @ inverse
    return covariance_of_map_from_camera(camera_from_map, covariance)


def sigma_of(errors: NDArray[np.float64]) -> float:
    """Standard deviation of a coordinate, robustly, from the lengths [K] of errors [px]."""
    return max(float(np.median(errors)) / RAYLEIGH_MEDIAN, MIN_SIGMA_PX)


def cauchy_scale(errors: NDArray[np.float64]) -> float:
    """Scale of the loss from the spread of the errors [K] themselves [px]."""
    return CAUCHY_SCALE * sigma_of(errors)


def projection_jacobians(
    camera: pycolmap.Camera, in_camera: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where points project, and how that changes with them, for any camera model.

    Args:
        camera: The camera.
        in_camera: [K,3] points in its frame, in front of it.

    Returns:
        Pixels [K,2] and their derivatives [K,2,3] by central differences.
    """
    step = 1e-6 * np.abs(in_camera[:, 2])
    jacobians = np.empty((len(in_camera), 2, 3))
    for axis in range(3):
        offset = np.zeros_like(in_camera)
        offset[:, axis] = step
        ahead = np.asarray(camera.img_from_cam(in_camera + offset))
        behind = np.asarray(camera.img_from_cam(in_camera - offset))
        jacobians[:, :, axis] = (ahead - behind) / (2.0 * step[:, None])
    return np.asarray(camera.img_from_cam(in_camera), np.float64), jacobians


def movement_jacobians(
    in_camera: NDArray[np.float64], across: NDArray[np.float64]
) -> NDArray[np.float64]:
    """How projections change when the camera's frame turns and shifts a little.

    Args:
        in_camera: [K,3] points in the camera's frame.
        across: [K,2,3] derivatives of their projections, see `projection_jacobians`.

    Returns:
        [K,2,6], by rotations about and then by shifts along the axes.
    """
    return np.concatenate([-across @ _skews(in_camera), across], axis=2)


def _spread_by_points(
    camera_from_map: pycolmap.Rigid3d,
    across: NDArray[np.float64],
    covariances: NDArray[np.float64],
    camera: pycolmap.Camera,
) -> NDArray[np.float64]:
    """Covariance [K,2,2] of residuals when keypoints have noise of one pixel, here and in the map.

    Lines of sight in the map are as exact as those of this camera: a pixel over the focal length.
    """
    by_point = across @ camera_from_map.rotation.matrix() / camera.mean_focal_length()
    spread: NDArray[np.float64] = np.eye(2) + by_point @ covariances @ np.swapaxes(by_point, 1, 2)
    return spread


def _noise_variance(residuals: NDArray[np.float64], spread: NDArray[np.float64]) -> float:
    """Variance of a coordinate [px^2], robustly, from residuals with that spread.

    Huber's for an M-estimate, mean(psi^2) / mean(psi')^2. For Gaussian residuals this is their
    variance and 5 %; heavy tails raise it less than they raise the plain variance.
    """
    whitened = np.linalg.solve(np.linalg.cholesky(spread), residuals[:, :, None])[:, :, 0]
    lengths = np.linalg.norm(whitened, axis=1)
    weights = 1.0 / (1.0 + np.square(lengths / (CAUCHY_SCALE * sigma_of(lengths))))
    variance = np.mean(np.square(weights * lengths)) / 2.0 / np.square(np.mean(np.square(weights)))
    degrees = 2 * len(residuals)
    return max(float(variance) * degrees / max(degrees - 6, 1), MIN_SIGMA_PX**2)


def _shared_variance(variance: float, camera: pycolmap.Camera) -> float:
    """Variance of what neighbours have in common [px^2]."""
    keypoint_sigma = KEYPOINT_SIGMA_PX * max(1.0, _longer_side(camera) / KEYPOINT_SIDE)
    beyond_keypoints = max(variance - keypoint_sigma**2, 0.0)
    return SHARED_VARIANCE * variance + beyond_keypoints


def _shared_by_neighbours(
    weighted: NDArray[np.float64], keypoints: NDArray[np.float64], camera: pycolmap.Camera
) -> NDArray[np.float64]:
    """What common noise of unit variance adds [6,6], for weighted jacobians [K,6,2]."""
    size = np.array([camera.width, camera.height], dtype=float)
    cells = np.clip(np.floor(keypoints / size * _CELLS).astype(int), 0, _CELLS - 1)
    _, cell = np.unique(cells @ [_CELLS, 1], return_inverse=True)
    count = np.bincount(cell)
    sums = np.zeros((len(count), 6, 2))
    np.add.at(sums, cell, weighted)
    centres = np.zeros((len(count), 2))
    np.add.at(centres, cell, keypoints)
    centres /= count[:, None]
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=2) / _longer_side(camera)
    correlation = np.exp(-0.5 * np.square(apart / SHARED_DISTANCE))
    added: NDArray[np.float64] = np.einsum('aij,ab,blj->il', sums, correlation, sums)
    return added


def _longer_side(camera: pycolmap.Camera) -> float:
    return float(max(camera.width, camera.height))


def _square_roots(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Symmetric square roots of positive definite matrices [K,2,2]."""
    values, vectors = np.linalg.eigh(matrices)
    roots: NDArray[np.float64] = np.einsum('kij,kj,klj->kil', vectors, np.sqrt(values), vectors)
    return roots


def _skews(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """The matrices [v]x with [v]x a = v x a, [K,3,3]."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)
