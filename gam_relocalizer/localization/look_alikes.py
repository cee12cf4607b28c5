# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Could the same image have been taken somewhere else in the map?

In a corridor of identical doors a wrong pose is as good as the right one, to the pixel. Only the
map knows: the points of the inliers have look-alikes elsewhere, and these fit a pose of their own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.localization.pose import estimate_pose, reprojection_errors
from gam_relocalizer.localization.scenes import distinct, most_covisible
from gam_relocalizer.localization.verdict import are_many_look_alikes
from gam_relocalizer.matching.candidates import knn_ratio

if TYPE_CHECKING:
    from collections.abc import Iterable

    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.features.local import LocalFeatures
    from gam_relocalizer.localization.pose import PoseOptions
    from gam_relocalizer.scene_map import SceneMap

# Points are alike that are hardly less like the keypoint than the nearest one is.
_NEIGHBOURS = 8
_RATIO = 0.8
_MAX_KEYPOINTS = 300
# Points this near to where the pose sees the keypoint are no other place [search thresholds].
_APART = 3.0


@dataclass(frozen=True)
class LookAlike:
    """Another pose for the same keypoints.

    Attributes:
        camera_from_map: The pose.
        agreeing: Keypoints of the inliers that agree with it as well.
        asked: Of so many.
    """

    camera_from_map: pycolmap.Rigid3d
    agreeing: int
    asked: int

    @property
    def share(self) -> float:
        """Agreeing ones per asked one, 0 to 1."""
        return self.agreeing / self.asked


def look_alike_of(
    camera_from_map: pycolmap.Rigid3d,
    inliers: NDArray[np.int64],
    features: LocalFeatures,
    camera: pycolmap.Camera,
    points: NDArray[np.int64],
    scene_map: SceneMap,
    options: PoseOptions,
) -> LookAlike | None:
    """Searches a pose from what the inliers look like elsewhere, if enough do to matter.

    Args:
        camera_from_map: The pose in question.
        inliers: [K] indices of the features that speak for it.
        features: Of the image.
        camera: The camera.
        points: [N] indices of the points among which to search.
        scene_map: The map.
        options: How poses are searched.
    """
    chosen = inliers[
        np.linspace(0, len(inliers) - 1, min(len(inliers), _MAX_KEYPOINTS)).astype(int)
    ]
    alike = knn_ratio(
        features.descriptors[chosen], scene_map.descriptors_of(points), _NEIGHBOURS, _RATIO
    )
    keypoints = features.keypoints[chosen[alike.edges[:, 0]]].astype(np.float64)
    places = scene_map.positions_of(points[alike.edges[:, 1]])
    errors = reprojection_errors(camera_from_map, keypoints, places, camera)
    elsewhere = errors > _APART * options.threshold_px(camera)
    # no keypoint agrees with a pose twice
    if not are_many_look_alikes(len(distinct(alike.edges[elsewhere, 0])), len(chosen)):
        return None
    found = estimate_pose(
        keypoints[elsewhere], places[elsewhere], -alike.distances[elsewhere], camera, options
    )
    if found is None:
        return None
    agreeing = int(np.count_nonzero(found.inliers))
    return LookAlike(found.camera_from_map, agreeing, len(chosen))


def points_around(images: Iterable[int], scene_map: SceneMap, size: int) -> NDArray[np.int64]:
    """Indices of the points of all scenes that retrieved images expand to, rising.

    Args:
        images: Retrieved images.
        scene_map: The map.
        size: Most images in one scene.
    """
    covisible = [most_covisible(image, scene_map, size) for image in images]
    seen = [scene_map.points_seen_by(int(image)) for image in distinct(np.concatenate(covisible))]
    return distinct(np.concatenate(seen)).astype(np.int64)
