# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Does an image show what its pose says it should show?

A pose that follows from one thing in the image, a poster that hangs in two rooms or a carton that
was moved, predicts everything else in view as well. What is predicted and not there speaks against
it, however many inliers the one thing has.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.cameras import undistort
from gam_relocalizer.localization.result import Support
from gam_relocalizer.localization.scenes import distinct

if TYPE_CHECKING:
    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.localization.scenes import Scene
    from gam_relocalizer.scene_map import SceneMap

# What is in view is asked of so many reference images, those that share most inliers, and of each
# only if it has this share of the inliers of the first.
_WITNESSES = 5
_WITNESS_SHARE = 0.2
# A point is expected in view if a witness saw it from about this direction and distance.
_MAX_TURN_DEG = 40.0
_MAX_ZOOM = 2.0
# Where a pixel's ray is this near to a point (on the plane at unit depth), the point is seen there.
_SAME_RAY = 0.05
# Cells along each side of the image.
_CELLS = 8


def support_of(
    camera_from_map: pycolmap.Rigid3d,
    camera: pycolmap.Camera,
    inlier_keypoints: NDArray[np.floating],
    inlier_points: NDArray[np.int64],
    scene: Scene,
    scene_map: SceneMap,
) -> Support:
    """Compares what is in view of a pose with what was matched.

    Args:
        camera_from_map: The pose.
        camera: The camera.
        inlier_keypoints: [K,2] px.
        inlier_points: [K] indices of the points that they were matched with, at least one.
        scene: Where they were matched.
        scene_map: The map.
    """
    points = _expected_points(camera_from_map, inlier_points, scene, scene_map)
    in_map = scene_map.positions_of(points)
    in_camera = np.asarray(camera_from_map * in_map, np.float64).reshape(-1, 3)
    pixels = _seen_at(in_camera[in_camera[:, 2] > 0], camera)
    if not len(pixels):
        return Support(in_view=0, unmatched=1.0)
    matched = np.isin(_cells(pixels, camera), _cells(inlier_keypoints, camera))
    return Support(in_view=len(pixels), unmatched=1.0 - float(matched.mean()))


def _expected_points(
    camera_from_map: pycolmap.Rigid3d,
    inlier_points: NDArray[np.int64],
    scene: Scene,
    scene_map: SceneMap,
) -> NDArray[np.int64]:
    """Points that witnesses saw from about where the camera is."""
    observers = scene_map.observers_of(inlier_points, scene.images)
    shared = np.asarray(observers.sum(axis=0)).ravel()
    most = np.argsort(-shared, kind='stable')[:_WITNESSES]
    witnesses = scene.images[most[shared[most] >= _WITNESS_SHARE * shared.max()]]
    camera_in_map = camera_from_map.tgt_origin_in_src()
    expected = []
    for witness in witnesses:
        seen = scene_map.points_seen_by(int(witness)).astype(np.int64)
        positions = scene_map.positions_of(seen)
        from_camera = positions - camera_in_map
        from_witness = positions - scene_map.camera_positions[witness]
        far, near = (np.linalg.norm(each, axis=1) for each in (from_camera, from_witness))
        cosine = np.einsum('ki,ki->k', from_camera, from_witness) / np.maximum(far * near, 1e-300)
        alike = cosine > np.cos(np.radians(_MAX_TURN_DEG))
        alike &= (far < _MAX_ZOOM * near) & (near < _MAX_ZOOM * far)
        expected.append(seen[alike])
    return distinct(np.concatenate(expected))


def _seen_at(in_camera: NDArray[np.float64], camera: pycolmap.Camera) -> NDArray[np.float64]:
    """Pixels [K,2] of those of the points [N,3] in front of a camera that are in its image."""
    pixels = np.asarray(camera.img_from_cam(in_camera)).reshape(-1, 2)
    inside = ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1)
    pixels, on_plane = pixels[inside], in_camera[inside, :2] / in_camera[inside, 2:]
    # beyond their edge many models fold space back into the image, where another ray ends
    seen = np.isclose(undistort(pixels, camera), on_plane, rtol=_SAME_RAY, atol=_SAME_RAY)
    return pixels[seen.all(axis=1)]


def _cells(pixels: NDArray[np.floating], camera: pycolmap.Camera) -> NDArray[np.int64]:
    size = np.array([camera.width, camera.height], dtype=float)
    cells = np.clip(np.floor(pixels / size * _CELLS).astype(np.int64), 0, _CELLS - 1)
    return np.asarray(cells @ [_CELLS, 1])
