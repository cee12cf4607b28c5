# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Camera pose from weighted 2D-3D matches, with the covariance that the residuals speak for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import poselib
import pycolmap

from gam_relocalizer.cameras import undistort
from gam_relocalizer.geometry import rigid3d_from
from gam_relocalizer.localization.covariance import cauchy_scale, pose_covariance

if TYPE_CHECKING:
    from numpy.typing import NDArray

# The threshold is given for images of this longer side and scales with the image.
REFERENCE_SIDE = 1024.0
MIN_MATCHES = 4
REFINEMENTS = 4
# The share of the best matches that the noise is guessed from, and the length of a 2D Gaussian
# of unit variance below which that share lies.
BEST_SHARE = 0.1
RAYLEIGH_BEST_SHARE = 0.459
INLIER_SIGMAS = 3.0
# Where most inliers are not what their keypoint looks most like, looks have no say.
NEAREST_SHARE = 0.5
# Inliers may be tightened down to this share of the threshold of the search.
TIGHTEST = 1.0 / 3.0


@dataclass(frozen=True)
class PoseOptions:
    """How poses are searched.

    Attributes:
        max_error: Greatest reprojection error in the search [px at a longer image side of 1024];
            the refinement tightens it as far as the noise allows.
        min_iterations: Least number of samples drawn.
        max_iterations: Greatest number of samples drawn; bounds the time of a hopeless query.
        guided: Whether matches of greater weight are sampled first; else all alike.
        seed: Of the sampler.
    """

    max_error: float = 12.0
    min_iterations: int = 100
    max_iterations: int = 10_000
    guided: bool = True
    seed: int = 0

    def threshold_px(self, camera: pycolmap.Camera) -> float:
        """The greatest reprojection error in the search [px]."""
        return self.max_error * max(camera.width, camera.height) / REFERENCE_SIDE


@dataclass(frozen=True)
class AbsolutePose:
    """A refined pose.

    Attributes:
        camera_from_map: The estimate.
        covariance: [6,6] of map_from_camera, order of REP-103, positive definite.
        inliers: [K] mask over the matches, those within three standard deviations of the noise; no
            keypoint and no point is in two of them.
        errors: [K] reprojection errors [px]; infinite for points that the camera cannot see.
        iterations: Samples that the search drew.
    """

    camera_from_map: pycolmap.Rigid3d
    covariance: NDArray[np.float64]
    inliers: NDArray[np.bool_]
    errors: NDArray[np.float64]
    iterations: int


def estimate_pose(
    keypoints: NDArray[np.floating],
    points: NDArray[np.float64],
    weights: NDArray[np.floating],
    camera: pycolmap.Camera,
    options: PoseOptions | None = None,
    nearest: NDArray[np.bool_] | None = None,
    covariances: NDArray[np.float64] | None = None,
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
        covariances: [K,3,3] of the points, see `point_covariances`; zero if not given.

    Returns:
        The pose, or nothing where the matches do not determine one.
    """
    options = options or PoseOptions()
    # what is said twice counts once
    by_weight = np.argsort(-np.asarray(weights, np.float64), kind='stable')
    places = _numbered(np.asarray(keypoints, np.float64)), _numbered(points)
    pairs = _numbered(np.stack(places, axis=1))
    distinct = np.flatnonzero(_heaviest_of_each(pairs, by_weight))
    if len(distinct) < MIN_MATCHES:
        return None
    local = _LocalFrame.around(points[distinct])
    matches = _Matches(
        keypoints=np.asarray(keypoints[distinct], np.float64),
        points=local.from_map(points[distinct]),
        by_weight=np.argsort(-np.asarray(weights[distinct], np.float64), kind='stable'),
        places=tuple(each[distinct] for each in places),
        camera=camera,
        threshold=options.threshold_px(camera),
        nearest=np.ones(len(distinct), np.bool_) if nearest is None else nearest[distinct],
    )
    found = _search(matches, options)
    if found is None:
        return None
    camera_from_local, iterations = found
    refined = _refine(camera_from_local, matches)
    if refined is None:
        return None
    camera_from_map = local.pose_to_map(refined.camera_from_local)
    exact = distinct[refined.exact]
    covariance = pose_covariance(
        camera_from_map,
        np.asarray(keypoints[exact], np.float64),
        points[exact],
        np.zeros((len(exact), 3, 3)) if covariances is None else covariances[exact],
        camera,
    )
    if covariance is None or not _is_positive_definite(covariance):
        return None
    inliers = np.zeros(len(keypoints), np.bool_)
    inliers[distinct[refined.inliers]] = True
    return AbsolutePose(
        camera_from_map=camera_from_map,
        covariance=covariance,
        inliers=inliers,
        errors=reprojection_errors(
            camera_from_map, np.asarray(keypoints, np.float64), points, camera
        ),
        iterations=iterations,
    )


def refined_pose(
    camera_from_map: pycolmap.Rigid3d,
    keypoints: NDArray[np.float64],
    points: NDArray[np.float64],
    camera: pycolmap.Camera,
) -> pycolmap.Rigid3d | None:
    """A pose that is nearly right, refined on matches that all belong to it.

    Args:
        camera_from_map: Where to start.
        keypoints: [K,2] pixels, COLMAP convention.
        points: [K,3] matched points, map frame.
        camera: Any model of COLMAP.

    Returns:
        The pose, or nothing where the matches do not determine one.
    """
    local = _LocalFrame.around(points)
    everything = np.ones(len(points), np.bool_)
    errors = reprojection_errors(camera_from_map, keypoints, points, camera)
    found = _minimised(
        local.pose_from_map(camera_from_map),
        keypoints,
        local.from_map(points),
        everything,
        errors,
        camera,
    )
    return None if found is None else local.pose_to_map(found)


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

    def pose_from_map(self, camera_from_map: pycolmap.Rigid3d) -> pycolmap.Rigid3d:
        translation = camera_from_map * self.centre
        return pycolmap.Rigid3d(
            rotation=camera_from_map.rotation, translation=translation / self.unit
        )

    def pose_to_map(self, camera_from_local: pycolmap.Rigid3d) -> pycolmap.Rigid3d:
        rotation = camera_from_local.rotation
        translation = self.unit * camera_from_local.translation - rotation * self.centre
        return pycolmap.Rigid3d(rotation=rotation, translation=translation)


@dataclass(frozen=True)
class _Matches:
    """Matches in the local frame, and what makes one of them an inlier.

    Attributes:
        keypoints: [K,2] px.
        points: [K,3] in the local frame.
        by_weight: [K] indices of the matches, the heaviest first.
        places: Twice [K], numbers that matches with the same keypoint, or point, have in common.
        camera: The camera.
        threshold: Greatest reprojection error in the search [px].
        nearest: [K] `Matches.nearest`.
    """

    keypoints: NDArray[np.float64]
    points: NDArray[np.float64]
    by_weight: NDArray[np.int64]
    places: tuple[NDArray[np.int64], ...]
    camera: pycolmap.Camera
    threshold: float
    nearest: NDArray[np.bool_]

    def inliers(self, errors: NDArray[np.float64], threshold: float) -> NDArray[np.bool_]:
        """Matches [K] within the threshold, the heaviest of each keypoint and of each point.

        Not the closest ones: residuals that were chosen for being small would make the pose look
        more certain than it is.
        """
        inliers = errors <= threshold
        for numbers in self.places:
            inliers = _heaviest_of_each(numbers, self.by_weight[inliers[self.by_weight]])
        return inliers

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
    """A pose in the local frame, its inliers [K] and those that it was refined with."""

    camera_from_local: pycolmap.Rigid3d
    inliers: NDArray[np.bool_]
    exact: NDArray[np.bool_]
    errors: NDArray[np.float64]


def _search(matches: _Matches, options: PoseOptions) -> tuple[pycolmap.Rigid3d, int] | None:
    """RANSAC on keypoints of an ideal camera, so that every camera model of COLMAP is served.

    Returns:
        The pose, and how many samples were drawn for it.
    """
    ideal, ideal_keypoints = _without_distortion(matches.keypoints, matches.camera)
    usable = np.asarray(np.isfinite(ideal_keypoints).all(axis=1), np.bool_)
    by_weight = matches.by_weight[usable[matches.by_weight]]
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
            'progressive_sampling': options.guided,
            'max_prosac_iterations': options.max_iterations,
            'seed': options.seed,
        },
        {},
    )
    if info['num_inliers'] < MIN_MATCHES or not np.isfinite([*found.q, *found.t]).all():
        return None
    return rigid3d_from(found.q, found.t), int(info['iterations'])


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
        inliers = matches.inliers(errors, threshold)
        if np.count_nonzero(inliers) < MIN_MATCHES:
            return None
        exact = matches.exact(inliers)
        refined = _minimised(
            camera_from_local, matches.keypoints, matches.points, exact, errors, matches.camera
        )
        if refined is None:
            return None
        camera_from_local = refined
        threshold = matches.tightened_threshold(matches.errors(camera_from_local))
    errors = matches.errors(camera_from_local)
    inliers = matches.inliers(errors, threshold)
    if np.count_nonzero(inliers) < MIN_MATCHES:
        return None
    return _Refined(camera_from_local, inliers, matches.exact(inliers), errors)


def _minimised(
    camera_from_local: pycolmap.Rigid3d,
    keypoints: NDArray[np.float64],
    points: NDArray[np.float64],
    inliers: NDArray[np.bool_],
    errors: NDArray[np.float64],
    camera: pycolmap.Camera,
) -> pycolmap.Rigid3d | None:
    """The pose of the least robust reprojection error of the inliers [K] nearby."""
    found = pycolmap.refine_absolute_pose(
        camera_from_local,
        keypoints,
        points,
        inliers,
        camera,
        pycolmap.AbsolutePoseRefinementOptions(
            gradient_tolerance=1e-6, loss_function_scale=cauchy_scale(errors[inliers])
        ),
    )
    return None if found is None else found['cam_from_world']


def _numbered(rows: NDArray[Any]) -> NDArray[np.int64]:
    """A number for each of some rows [K,D], the same for equal ones: 0, 1, ... in rising order."""
    order = np.lexsort(rows.T)
    rising = rows[order]
    numbers = np.zeros(len(rows), np.int64)
    numbers[order[1:]] = np.cumsum((rising[1:] != rising[:-1]).any(axis=1))
    return numbers


def _heaviest_of_each(
    numbers: NDArray[np.int64], by_weight: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Which matches [K] are the heaviest of all with the same number [K].

    Args:
        numbers: As `_numbered` gives them.
        by_weight: Indices of the matches to choose from, the heaviest first.
    """
    heaviest = np.zeros(len(numbers), np.bool_)
    # of several that are written to the same place the last one stays
    heaviest_of = np.full(len(numbers), -1)
    heaviest_of[numbers[by_weight[::-1]]] = by_weight[::-1]
    heaviest[heaviest_of[heaviest_of >= 0]] = True
    return heaviest


def _is_positive_definite(matrix: NDArray[np.float64]) -> bool:
    if not np.isfinite(matrix).all():
        return False
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return False
    return True
