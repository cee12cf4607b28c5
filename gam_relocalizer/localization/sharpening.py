# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""A pose, once it is known, says where to look: more and closer matches make it more exact.

The matcher compares looks in the whole image and gives each keypoint one point at most; the search
for a pose must forgive many pixels. With the pose, a point has to be seen within two pixels of its
place, and a keypoint that looks enough like it there needs no one's judgement.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from gam_relocalizer.cameras import undistort
from gam_relocalizer.geometry import rotation_of
from gam_relocalizer.localization.pose import REFERENCE_SIDE, refined_pose

if TYPE_CHECKING:
    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.features.local import LocalFeatures
    from gam_relocalizer.scene_map import SceneMap

# Distance of a keypoint from where its point projects [px at a longer image side of 1024].
MAX_ERROR = 2.0
# Cosine of two descriptors of one place.
MIN_LIKENESS = 0.75
ROUNDS = 2
# Fewer matches know nothing better than those that gave the pose.
MIN_MATCHES = 30
# A pose that leaves its own 99 % ellipsoid (chi square of six) was drawn to something else.
MAX_SQUARED_DEVIATION = 16.8
# Where a pixel's ray is this near to a point (on the plane at unit depth), the point is seen there.
_SAME_RAY = 0.05


def sharpened(
    camera_from_map: pycolmap.Rigid3d,
    covariance: NDArray[np.float64],
    features: LocalFeatures,
    camera: pycolmap.Camera,
    points: NDArray[np.int64],
    scene_map: SceneMap,
) -> pycolmap.Rigid3d:
    """Refines a pose on all keypoints that are where it puts their points.

    Args:
        camera_from_map: The pose.
        covariance: [6,6] of map_from_camera, order of REP-103. It stays that of the result, which
            is hardly ever worse: the closest matches would make it look more certain than it is.
        features: Of the image.
        camera: Any model of COLMAP.
        points: [N] indices of the points that may be in view.
        scene_map: The map.

    Returns:
        The refined pose; the given one where there are too few matches, or they contradict it.
    """
    positions = scene_map.positions_of(points)
    tree = cKDTree(features.keypoints)
    refined = camera_from_map
    for _ in range(ROUNDS):
        rows, keypoints = _close_matches(refined, camera, positions, tree)
        likeness = np.einsum(
            'kd,kd->k', scene_map.descriptors_of(points[rows]), features.descriptors[keypoints]
        )
        best = _best_of_each(keypoints, likeness)
        best = best[likeness[best] >= MIN_LIKENESS]
        if len(best) < MIN_MATCHES:
            return camera_from_map
        found = refined_pose(
            refined,
            features.keypoints[keypoints[best]].astype(np.float64),
            positions[rows[best]],
            camera,
        )
        if found is None or _squared_deviation(found, camera_from_map, covariance) > (
            MAX_SQUARED_DEVIATION
        ):
            return camera_from_map
        refined = found
    return refined


def _close_matches(
    camera_from_map: pycolmap.Rigid3d,
    camera: pycolmap.Camera,
    positions: NDArray[np.float64],
    tree: cKDTree,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows [K] of points that project next to a keypoint, and the nearest keypoint [K] of each."""
    in_camera = np.asarray(camera_from_map * positions, np.float64).reshape(-1, 3)
    rows = np.flatnonzero(in_camera[:, 2] > 0)
    pixels = np.asarray(camera.img_from_cam(in_camera[rows])).reshape(-1, 2)
    inside = ((pixels >= 0) & (pixels <= [camera.width, camera.height])).all(axis=1)
    rows, pixels = rows[inside], pixels[inside]
    reach = MAX_ERROR * max(camera.width, camera.height) / REFERENCE_SIDE
    distances, keypoints = tree.query(pixels, distance_upper_bound=reach)
    close = np.isfinite(distances)
    rows, pixels, keypoints = rows[close], pixels[close], keypoints[close]
    # beyond their edge many models fold space back into the image, where another ray ends
    on_plane = in_camera[rows, :2] / in_camera[rows, 2:]
    alike = np.isclose(undistort(pixels, camera), on_plane, rtol=_SAME_RAY, atol=_SAME_RAY)
    seen = alike.all(axis=1)
    return rows[seen], keypoints[seen]


def _best_of_each(keypoints: NDArray[np.int64], likeness: NDArray[np.float32]) -> NDArray[np.int64]:
    """Of the matches [K], the most alike of every keypoint."""
    by_keypoint = np.lexsort((-likeness, keypoints))
    first = np.diff(keypoints[by_keypoint], prepend=-1) > 0
    return by_keypoint[first]


def _squared_deviation(
    camera_from_map: pycolmap.Rigid3d,
    expected: pycolmap.Rigid3d,
    covariance: NDArray[np.float64],
) -> float:
    """Squared Mahalanobis distance of two poses."""
    moved = camera_from_map.tgt_origin_in_src() - expected.tgt_origin_in_src()
    turned = rotation_of(camera_from_map).inv() * rotation_of(expected)
    deviation = np.concatenate([moved, turned.as_rotvec()])
    return float(deviation @ np.linalg.solve(covariance, deviation))
