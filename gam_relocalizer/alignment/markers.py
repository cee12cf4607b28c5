# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Printed square markers (ArUco, AprilTag) in the reference images.

A marker is a square of one unknown side, somewhere, turned somehow: a similarity of the unit
square. It is found by triangulating its corners from two images, and refined in all that agree.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pycolmap
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from gam_relocalizer.alignment.scale import ScaleFit, fit_scale
from gam_relocalizer.alignment.similarity import solve_similarity
from gam_relocalizer.cameras import PIXEL_CENTRE, undistort
from gam_relocalizer.errors import AlignmentError, UsageError
from gam_relocalizer.geometry import rigid3d_from
from gam_relocalizer.images import read_image
from gam_relocalizer.mapping.progress import Progress, ignore_progress

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from gam_relocalizer.alignment.constraints import MarkerPlace, Markers
    from gam_relocalizer.alignment.reference import Reference

DICTIONARIES = tuple(sorted(name for name in dir(cv2.aruco) if name.startswith('DICT_')))
# Corners in OpenCV's order, for a print of side 1: x to the right, y to the top, z out of it.
CORNERS = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
_MIN_IMAGES = 2
# How far a corner may be from where the square has it, as a share of the longer side of an image:
# twice or thrice what poses of a map are usually wrong by.
_MAX_ERROR_SHARE = 0.006
# Blur and light shift all edges of a print alike, outwards or inwards; no residual shows it.
_EDGE_BIAS_PX = 0.1
_MAX_PAIRS = 200
_EXAMPLES = 3


@dataclass(frozen=True)
class FoundMarker:
    """A marker in the map.

    Attributes:
        marker: Its id.
        sfm_from_marker: Takes the print of side 1 to where it hangs; its scale is the side.
        images: Names of the reference images that agree on it.
        size_sigma: Standard deviation of the side as a share of it, from the reprojection errors.
        side_px: Length of the side in the images, in the median.
    """

    marker: int
    sfm_from_marker: pycolmap.Sim3d
    images: tuple[str, ...]
    size_sigma: float
    side_px: float


@dataclass(frozen=True)
class _Sighting:
    """The corners of a marker in one image: [4,2] pixels (COLMAP's)."""

    name: str
    camera: pycolmap.Camera
    camera_from_sfm: pycolmap.Rigid3d
    corners: NDArray[np.float64]

    @property
    def tolerance(self) -> float:
        return _MAX_ERROR_SHARE * max(self.camera.width, self.camera.height)

    @property
    def side_px(self) -> float:
        sides = self.corners - np.roll(self.corners, 1, axis=0)
        return float(np.linalg.norm(sides, axis=1).mean())

    def errors(self, sfm_from_marker: pycolmap.Sim3d) -> NDArray[np.float64]:
        """[4,2] pixels; far off where a corner would be behind the camera."""
        places = np.asarray(self.camera_from_sfm * np.asarray(sfm_from_marker * CORNERS))
        with np.errstate(all='ignore'):
            errors = np.asarray(self.camera.img_from_cam(places)) - self.corners
        errors[~(places[:, 2] > 0.0) | ~np.isfinite(errors).all(axis=1)] = 1e6
        return errors


def find_markers(
    reference: Reference, markers: Markers, progress: Progress = ignore_progress
) -> list[FoundMarker]:
    """The markers that two or more reference images show, by id.

    Raises:
        UsageError: Unknown dictionary, size that is not positive, or no such folder.
        ImageError: A reference image is not in the folder.
        AlignmentError: No marker is seen twice, or two prints have the same id.
    """
    if markers.dictionary not in DICTIONARIES:
        msg = f'unknown dictionary `{markers.dictionary}`; known are {", ".join(DICTIONARIES)}'
        raise UsageError(msg)
    if not markers.size > 0.0 or not math.isfinite(markers.size):
        msg = f'the side of a marker is {markers.size:g} m; it has to be positive'
        raise UsageError(msg)
    if not markers.images.is_dir():
        msg = f'{markers.images}: no such folder of images'
        raise UsageError(msg)
    sightings = _sightings(reference, markers, progress)
    found = [_locate(marker, seen) for marker, seen in sorted(sightings.items())]
    located = [one for one in found if one is not None]
    if not located:
        msg = (
            f'{markers.images}: no marker of {markers.dictionary} is seen by {_MIN_IMAGES} images '
            f'that agree on it ({len(sightings)} ids were seen at all); check the dictionary, or '
            f'add images that show the marker from several places'
        )
        raise AlignmentError(msg)
    return located


def scale_from_markers(found: Sequence[FoundMarker], size: float) -> ScaleFit:
    """The scale that makes the sides of the markers `size` metres."""
    sides = np.array([float(one.sfm_from_marker.scale) for one in found])
    fit = fit_scale(sides, np.full(len(sides), size))
    weights = [one.size_sigma**-2 for one, used in zip(found, fit.inliers, strict=True) if used]
    common = 2.0 * _EDGE_BIAS_PX / float(np.median([one.side_px for one in found]))
    sigma = math.hypot(max(fit.sigma or 0.0, sum(weights) ** -0.5), common)
    return ScaleFit(fit.scale, fit.residuals, fit.inliers, sigma)


def correspondences(
    found: Iterable[FoundMarker], places: Mapping[int, MarkerPlace], size: float
) -> tuple[list[str], NDArray[np.float64], NDArray[np.float64]]:
    """Names [n] and places [n,3] of corners, or centres without orientation: SfM and map frame.

    Raises:
        UsageError: No marker that was found has a place.
    """
    names: list[str] = []
    source: list[NDArray[np.float64]] = []
    target: list[NDArray[np.float64]] = []
    ids = []
    for one in found:
        ids.append(one.marker)
        if one.marker not in places:
            continue
        place = places[one.marker]
        if place.map_from_marker_wxyz is None:
            names.append(f'marker {one.marker}')
            source.append(np.asarray(one.sfm_from_marker.translation)[None])
            target.append(np.array([place.centre]))
            continue
        map_from_marker = rigid3d_from(place.map_from_marker_wxyz, place.centre)
        names += [f'marker {one.marker} corner {corner}' for corner in range(4)]
        source.append(np.asarray(one.sfm_from_marker * CORNERS))
        target.append(np.asarray(map_from_marker * (size * CORNERS)))
    if not names:
        msg = f'no place is given for any of the markers that were found: {sorted(ids)}'
        raise UsageError(msg)
    return names, np.concatenate(source), np.concatenate(target)


def _sightings(
    reference: Reference, markers: Markers, progress: Progress
) -> dict[int, list[_Sighting]]:
    """Every marker in every image, by id.

    Raises:
        AlignmentError: An image shows an id twice.
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, markers.dictionary))
    detector = cv2.aruco.ArucoDetector(dictionary, parameters)
    sightings: dict[int, list[_Sighting]] = {}
    for row, name in enumerate(reference.names):
        camera = _camera_of(reference, name)
        image = read_image(markers.images / name)
        if image.shape[:2] != (camera.height, camera.width):
            msg = (
                f'{markers.images / name}: {image.shape[1]} x {image.shape[0]} pixels; the map '
                f'was made from one of {camera.width} x {camera.height}'
            )
            raise UsageError(msg)
        corners, ids, _ = detector.detectMarkers(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        seen = [] if ids is None else [int(one) for one in ids.ravel()]
        twice = sorted({marker for marker in seen if seen.count(marker) > 1})
        if twice:
            msg = f'{name}: shows marker {twice[0]} twice; every print needs an id of its own'
            raise AlignmentError(msg)
        for marker, quad in zip(seen, corners, strict=True):
            pixels = np.asarray(quad, np.float64).reshape(4, 2) + PIXEL_CENTRE
            one = _Sighting(name, camera, reference.camera_from_sfm[row], pixels)
            sightings.setdefault(marker, []).append(one)
        progress('markers', row + 1, len(reference.names))
    return sightings


def _camera_of(reference: Reference, name: str) -> pycolmap.Camera:
    image = reference.model.find_image_with_name(name)
    # the stubs of pycolmap know neither of the two as None
    camera: pycolmap.Camera | None = getattr(image, 'camera', None)
    if camera is None:
        msg = f'{reference.scene_map.path}: its COLMAP model lacks the image `{name}`; rebuild it'
        raise AlignmentError(msg)
    return camera


def _locate(marker: int, seen: Sequence[_Sighting]) -> FoundMarker | None:
    """Where a marker hangs; None where no two images agree.

    Raises:
        AlignmentError: Other images agree on another place.
    """
    square = _best_square(seen)
    if square is None:
        return None
    agreeing = _agreeing(seen, square)
    rest = [one for one in seen if one not in agreeing]
    other = _best_square(rest)
    if other is not None:
        msg = (
            f'marker {marker} is at two places: in {_names(agreeing)} and in '
            f'{_names(_agreeing(rest, other))}; every print needs an id of its own (or these '
            f'images are misplaced in the map)'
        )
        raise AlignmentError(msg)
    refined, sigma = _refine(square, agreeing)
    side_px = float(np.median([one.side_px for one in agreeing]))
    return FoundMarker(marker, refined, tuple(one.name for one in agreeing), sigma, side_px)


def _best_square(seen: Sequence[_Sighting]) -> pycolmap.Sim3d | None:
    """The square from two images that most images agree with."""
    pairs = list(itertools.combinations(range(len(seen)), 2))
    best, most = None, _MIN_IMAGES - 1
    for first, second in pairs[:: max(1, len(pairs) // _MAX_PAIRS)]:
        square = _square_from(seen[first], seen[second])
        count = 0 if square is None else len(_agreeing(seen, square))
        if count > most:
            best, most = square, count
    return best


def _square_from(first: _Sighting, second: _Sighting) -> pycolmap.Sim3d | None:
    rays = [np.c_[undistort(one.corners, one.camera), np.ones(4)] for one in (first, second)]
    if not all(np.isfinite(one).all() for one in rays):
        return None
    poses = [one.camera_from_sfm.matrix() for one in (first, second)]
    corners = [
        pycolmap.triangulate_multi_view_point(
            poses, np.stack([one[corner] / np.linalg.norm(one[corner]) for one in rays])
        )
        for corner in range(4)
    ]
    if any(corner is None for corner in corners):
        return None
    return solve_similarity(CORNERS, np.array(corners).reshape(4, 3))


def _agreeing(seen: Sequence[_Sighting], square: pycolmap.Sim3d) -> list[_Sighting]:
    return [
        one for one in seen if np.linalg.norm(one.errors(square), axis=1).max() <= one.tolerance
    ]


def _refine(square: pycolmap.Sim3d, seen: Sequence[_Sighting]) -> tuple[pycolmap.Sim3d, float]:
    """Least reprojection error, and the standard deviation of the side as a share of it."""
    start = Rotation.from_quat(np.asarray(square.rotation.quat))

    def moved(movement: NDArray[np.float64]) -> pycolmap.Sim3d:
        turned = Rotation.from_rotvec(movement[:3]) * start
        return pycolmap.Sim3d(
            float(square.scale * math.exp(movement[3])),
            pycolmap.Rotation3d(turned.as_quat()),
            np.asarray(square.translation) + float(square.scale) * movement[4:],
        )

    def errors(movement: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.concatenate([one.errors(moved(movement)).ravel() for one in seen])

    solution = least_squares(errors, np.zeros(7), loss='huber', f_scale=1.0)
    # The four corners in an image share the error of its pose: they count as one.
    variance = 4.0 * (solution.fun**2).sum() / (len(solution.fun) - 7)
    covariance = np.linalg.pinv(solution.jac.T @ solution.jac) * variance
    return moved(solution.x), max(math.sqrt(covariance[3, 3]), 1e-9)


def _names(seen: Sequence[_Sighting]) -> str:
    shown = ', '.join(f'`{one.name}`' for one in seen[:_EXAMPLES])
    return shown if len(seen) <= _EXAMPLES else f'{shown}, ... ({len(seen)})'
