# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Camera pose from weighted 2D-3D matches, with the covariance that the residuals speak for."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import poselib
import pycolmap

from gam_relocalizer.geometry import covariance_of_map_from_camera, rigid3d_from

if TYPE_CHECKING:
    from numpy.typing import NDArray

# The threshold is given for images of this longer side and scales with the image.
REFERENCE_SIDE = 1024.0
MIN_MATCHES = 4
REFINEMENTS = 4
# Cauchy's loss keeps 95 % of the efficiency of least squares at this many standard deviations.
CAUCHY_SCALE = 2.385
# Median length of a 2D Gaussian of unit variance (Rayleigh distribution).
RAYLEIGH_MEDIAN = 1.1774
# The share of the best matches that the noise is guessed from, and the length of a 2D Gaussian
# of unit variance below which that share lies.
BEST_SHARE = 0.1
RAYLEIGH_BEST_SHARE = 0.459
INLIER_SIGMAS = 3.0
# Where most inliers are not what their keypoint looks most like, looks have no say.
NEAREST_SHARE = 0.5
# Inliers may be tightened down to this share of the threshold of the search.
TIGHTEST = 1.0 / 3.0
# Keypoints are found on a grid of pixels and points were triangulated from such keypoints: however
# well a few inliers agree, a coordinate is not better known than this.
MIN_SIGMA_PX = 0.5
# pycolmap's rotation covariance is that of Ceres' quaternion tangent: half the rotation vector.
FULL_ANGLE = np.diag([2.0, 2.0, 2.0, 1.0, 1.0, 1.0])
# Beyond so many pixels from where a keypoint was, its ray is not the inverse of its projection.
ROUND_TRIP_PX = 0.5
# Rays further off the axis run away on the image plane, which ends at 90 degrees.
MAX_TANGENT = math.tan(math.radians(80.0))
# Ceres wants a loss; beyond this scale Cauchy's is least squares.
NO_LOSS_PX = 1e9


@dataclass(frozen=True)
class PoseOptions:
    """How poses are searched.

    Attributes:
        max_error: Greatest reprojection error in the search [px at a longer image side of 1024];
            the refinement tightens it as far as the noise allows.
        min_iterations: Least number of samples drawn.
        max_iterations: Greatest number of samples drawn; bounds the time of a hopeless query.
        seed: Of the sampler.
    """

    max_error: float = 12.0
    min_iterations: int = 500
    max_iterations: int = 10_000
    seed: int = 0


@dataclass(frozen=True)
class AbsolutePose:
    """A refined pose.

    Attributes:
        camera_from_map: The estimate.
        covariance: [6,6] of map_from_camera, order of REP-103, positive definite.
        inliers: [K] mask over the matches, those within three standard deviations of the noise.
        errors: [K] reprojection errors [px]; infinite for points that the camera cannot see.
    """

    camera_from_map: pycolmap.Rigid3d
    covariance: NDArray[np.float64]
    inliers: NDArray[np.bool_]
    errors: NDArray[np.float64]


def estimate_pose(
    keypoints: NDArray[np.floating],
    points: NDArray[np.float64],
    weights: NDArray[np.floating],
    camera: pycolmap.Camera,
    options: PoseOptions | None = None,
    nearest: NDArray[np.bool_] | None = None,
) -> AbsolutePose | None:
    """Prior-guided PnP in a RANSAC loop, then robust refinement on the inliers.

    Matches of greater weight are sampled first (PROSAC; section 'Prior-Guided Pose Estimation').
    The refinement leaves out what only geometry speaks for, where enough is left: such a match is
    in the right place, but often with a neighbour of the very point.

    Args:
        keypoints: [K,2] pixels, COLMAP convention.
        points: [K,3] matched points, map frame.
        weights: [K] the matcher's confidence.
        camera: Any model of COLMAP.
        options: How to search.
        nearest: [K] `Matches.nearest`; all of them if not given.

    Returns:
        The pose, or nothing where the matches do not determine one.
    """
    options = options or PoseOptions()
    if len(keypoints) < MIN_MATCHES:
        return None
    local = _LocalFrame.around(points)
    matches = _Matches(
        keypoints=np.asarray(keypoints, np.float64),
        points=local.from_map(points),
        camera=camera,
        threshold=options.max_error * max(camera.width, camera.height) / REFERENCE_SIDE,
        nearest=np.ones(len(keypoints), np.bool_) if nearest is None else nearest,
    )
    camera_from_local = _search(matches, weights, options)
    if camera_from_local is None:
        return None
    refined = _refine(camera_from_local, matches)
    if refined is None:
        return None
    covariance = local.covariance_to_map(
        covariance_of_map_from_camera(refined.camera_from_local, refined.covariance)
    )
    if not _is_positive_definite(covariance):
        return None
    return AbsolutePose(
        camera_from_map=local.pose_to_map(refined.camera_from_local),
        covariance=covariance,
        inliers=refined.inliers,
        errors=refined.errors,
    )


def reprojection_errors(
    camera_from_map: pycolmap.Rigid3d,
    keypoints: NDArray[np.float64],
    points: NDArray[np.float64],
    camera: pycolmap.Camera,
) -> NDArray[np.float64]:
    """Distances [K] between keypoints and projected points [px]; infinite behind the camera."""
    in_camera = np.asarray(camera_from_map * points, np.float64).reshape(-1, 3)
    errors = np.full(len(keypoints), np.inf)
    visible = in_camera[:, 2] > 0
    if visible.any():
        projected = np.asarray(camera.img_from_cam(in_camera[visible]))
        errors[visible] = np.linalg.norm(projected - keypoints[visible], axis=1)
    errors[np.isnan(errors)] = np.inf
    return errors


def undistort(keypoints: NDArray[np.floating], camera: pycolmap.Camera) -> NDArray[np.float64]:
    """Where the rays of keypoints cut the plane at unit depth.

    Args:
        keypoints: [K,2] pixels, COLMAP convention.
        camera: Any model with a focal length.

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


@dataclass(frozen=True)
class _LocalFrame:
    """Matched points centred and of unit size: solvers get good numbers in any map."""

    centre: NDArray[np.float64]
    unit: float

    @classmethod
    def around(cls, points: NDArray[np.float64]) -> _LocalFrame:
        centre = np.median(points, axis=0)
        unit = float(np.median(np.linalg.norm(points - centre, axis=1)))
        return cls(centre, unit or 1.0)

    def from_map(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        local: NDArray[np.float64] = (points - self.centre) / self.unit
        return local

    def pose_to_map(self, camera_from_local: pycolmap.Rigid3d) -> pycolmap.Rigid3d:
        rotation = camera_from_local.rotation
        translation = self.unit * camera_from_local.translation - rotation * self.centre
        return pycolmap.Rigid3d(rotation=rotation, translation=translation)

    def covariance_to_map(self, covariance: NDArray[np.float64]) -> NDArray[np.float64]:
        scale = np.array([self.unit] * 3 + [1.0] * 3)
        scaled: NDArray[np.float64] = covariance * np.outer(scale, scale)
        return scaled


@dataclass(frozen=True)
class _Matches:
    """Matches in the local frame, and what makes one of them an inlier."""

    keypoints: NDArray[np.float64]
    points: NDArray[np.float64]
    camera: pycolmap.Camera
    threshold: float
    nearest: NDArray[np.bool_]

    def exact(self, inliers: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """The inliers [K] to refine with: the nearest ones, unless they are the minority."""
        nearest = inliers & self.nearest
        is_enough = np.count_nonzero(nearest) >= max(
            MIN_MATCHES, NEAREST_SHARE * np.count_nonzero(inliers)
        )
        return nearest if is_enough else inliers

    def errors(self, camera_from_local: pycolmap.Rigid3d) -> NDArray[np.float64]:
        """Reprojection errors [K] in px."""
        return reprojection_errors(camera_from_local, self.keypoints, self.points, self.camera)

    def tightened_threshold(self, errors: NDArray[np.float64]) -> float:
        """Three standard deviations of the best matches, within the threshold of the search [px].

        A matcher that knows geometry also proposes neighbours of the right point. They pass the
        search and spoil its accuracy, but they are not among the best tenth.
        """
        inliers = errors[errors <= self.threshold]
        if not len(inliers):
            return self.threshold
        sigma = float(np.quantile(inliers, BEST_SHARE)) / RAYLEIGH_BEST_SHARE
        return min(max(INLIER_SIGMAS * sigma, TIGHTEST * self.threshold), self.threshold)


@dataclass(frozen=True)
class _Refined:
    """Pose and covariance (order and perturbation of pycolmap) in the local frame."""

    camera_from_local: pycolmap.Rigid3d
    covariance: NDArray[np.float64]
    inliers: NDArray[np.bool_]
    errors: NDArray[np.float64]


def _search(
    matches: _Matches, weights: NDArray[np.floating], options: PoseOptions
) -> pycolmap.Rigid3d | None:
    """RANSAC on keypoints of an ideal camera, so that every camera model of COLMAP is served."""
    ideal, ideal_keypoints = _without_distortion(matches.keypoints, matches.camera)
    usable = np.asarray(np.isfinite(ideal_keypoints).all(axis=1), np.bool_)
    by_weight = np.argsort(-np.asarray(weights, np.float64), kind='stable')
    by_weight = by_weight[usable[by_weight]]
    if len(by_weight) < MIN_MATCHES:
        return None
    found, info = poselib.estimate_absolute_pose(
        ideal_keypoints[by_weight],
        matches.points[by_weight],
        ideal,
        {
            'max_reproj_error': matches.threshold,
            'min_iterations': options.min_iterations,
            'max_iterations': options.max_iterations,
            'progressive_sampling': True,
            'max_prosac_iterations': options.max_iterations,
            'seed': options.seed,
        },
        {},
    )
    if info['num_inliers'] < MIN_MATCHES or not np.isfinite([*found.q, *found.t]).all():
        return None
    return rigid3d_from(found.q, found.t)


def _without_distortion(
    keypoints: NDArray[np.float64], camera: pycolmap.Camera
) -> tuple[dict[str, object], NDArray[np.float64]]:
    """An ideal camera of the same kind (for PoseLib), and where it would see the keypoints."""
    focal = camera.mean_focal_length()
    on_plane = undistort(keypoints, camera)
    ideal: dict[str, object] = {
        'model': 'PINHOLE',
        'width': camera.width,
        'height': camera.height,
        'params': [focal, focal, 0.0, 0.0],
    }
    if 'FISHEYE' not in camera.model_name:
        return ideal, focal * on_plane
    # on the plane, errors far from the axis would be blown up: keep the equidistant projection
    radius = np.linalg.norm(on_plane, axis=1, keepdims=True)
    shrink = np.where(radius > 0, np.arctan(radius) / np.where(radius > 0, radius, 1.0), 1.0)
    ideal |= {'model': 'OPENCV_FISHEYE', 'params': [focal, focal, *[0.0] * 6]}
    return ideal, focal * shrink * on_plane


def _refine(camera_from_local: pycolmap.Rigid3d, matches: _Matches) -> _Refined | None:
    """Robust refinement on the exact inliers, choosing them anew each time."""
    threshold = matches.threshold
    for _ in range(REFINEMENTS):
        errors = matches.errors(camera_from_local)
        inliers = errors <= threshold
        if np.count_nonzero(inliers) < MIN_MATCHES:
            return None
        exact = matches.exact(inliers)
        refined = _minimise(camera_from_local, matches, exact, _cauchy_scale(errors[exact]))
        if refined is None:
            return None
        camera_from_local, _ = refined
        threshold = matches.tightened_threshold(matches.errors(camera_from_local))
    errors = matches.errors(camera_from_local)
    inliers = errors <= threshold
    if np.count_nonzero(inliers) < MIN_MATCHES:
        return None
    exact = matches.exact(inliers)
    unit_noise = _minimise(camera_from_local, matches, exact, NO_LOSS_PX, iterations=0)
    if unit_noise is None:
        return None
    variance = _variance_of_cauchy_estimate(errors[exact])
    covariance = variance * (FULL_ANGLE @ unit_noise[1] @ FULL_ANGLE)
    return _Refined(camera_from_local, covariance, inliers, errors)


def _minimise(
    camera_from_local: pycolmap.Rigid3d,
    matches: _Matches,
    inliers: NDArray[np.bool_],
    loss_scale: float,
    iterations: int = 100,
) -> tuple[pycolmap.Rigid3d, NDArray[np.float64]] | None:
    """The refined pose, and its covariance for noise of one pixel."""
    options = pycolmap.AbsolutePoseRefinementOptions(
        gradient_tolerance=1e-6, loss_function_scale=loss_scale, max_num_iterations=iterations
    )
    result = pycolmap.refine_absolute_pose(
        camera_from_local,
        matches.keypoints,
        matches.points,
        inliers,
        matches.camera,
        options,
        return_covariance=True,
    )
    if result is None or result.get('covariance') is None:
        return None
    return result['cam_from_world'], np.asarray(result['covariance'])


def _cauchy_scale(errors: NDArray[np.float64]) -> float:
    """Scale of the loss from the errors' own spread [px]."""
    sigma = float(np.median(errors)) / RAYLEIGH_MEDIAN
    return CAUCHY_SCALE * max(sigma, MIN_SIGMA_PX)


def _variance_of_cauchy_estimate(errors: NDArray[np.float64]) -> float:
    """Factor on the covariance of least squares with unit noise [px^2].

    Huber's covariance of an M-estimator, mean(psi^2) / mean(psi')^2, for residuals in two
    dimensions; with Cauchy's weight w the divergence of psi is 2 w^2. For Gaussian errors this is
    their variance and 5 %; heavy tails raise it less than they raise the plain variance.
    """
    count = len(errors)
    weight = 1.0 / (1.0 + np.square(errors / _cauchy_scale(errors)))
    mean_psi_squared = np.mean(np.square(weight * errors)) / 2.0
    variance = mean_psi_squared / np.square(np.mean(np.square(weight)))
    small_sample = 2 * count / max(2 * count - 6, 1)
    return float(max(variance * small_sample, MIN_SIGMA_PX**2))


def _is_positive_definite(matrix: NDArray[np.float64]) -> bool:
    if not np.isfinite(matrix).all():
        return False
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return False
    return True
