# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""A map of rendered images: poses and depths are known, so there is nothing to reconstruct.

Structure from motion refuses a place that repeats itself, and rightly so. The map made here has no
fault but that: what is then accepted falsely is the localizer's doing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from gam_relocalizer.errors import MapBuildError
from gam_relocalizer.features.vlad import Vlad
from gam_relocalizer.scene_map import Manifest, MapContent, MapFrame, save_map

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.features.local import LocalExtractor, LocalFeatures

# Features of two images are of one point when they lie this close to each other [map units] and
# look this much alike (cosine).
SAME_PLACE = 0.015
SAME_LOOK = 0.8
# A keypoint on an edge belongs to the thing in front or to the one behind: who knows.
MAX_DEPTH_STEP = 0.03


@dataclass(frozen=True)
class KnownImage:
    """A reference image with its geometry.

    Attributes:
        image: RGB [H,W,3].
        depth: [H,W] z in the camera's frame at the pixel centres, infinite where nothing is.
        camera_from_map: Its pose.
    """

    image: NDArray[np.uint8]
    depth: NDArray[np.float32]
    camera_from_map: pycolmap.Rigid3d


def save_exact_map(
    path: Path,
    images: Sequence[KnownImage],
    camera: pycolmap.Camera,
    extractor: LocalExtractor,
) -> None:
    """Writes a metric map bundle whose points are keypoints that two images or more see.

    Args:
        path: The bundle.
        images: Reference images, named by their number; those that see no point are left out.
        camera: Of all of them.
        extractor: Of the local features.

    Raises:
        MapBuildError: No point is seen by two images.
    """
    found = [_on_surfaces(extractor.extract(one.image), one) for one in images]
    positions = np.concatenate(
        [
            _in_map(features.keypoints, one, camera)
            for features, one in zip(found, images, strict=True)
        ]
    )
    descriptors = np.concatenate([features.descriptors for features in found])
    image_of = np.repeat(np.arange(len(images)), [len(features) for features in found])
    tracks = _tracks(positions, descriptors, image_of)
    if not tracks.size or tracks.max() < 0:
        msg = f'{path}: no point is seen by two of the {len(images)} images; take more of them'
        raise MapBuildError(msg)
    seen = [np.unique(tracks[(image_of == one) & (tracks >= 0)]) for one in range(len(images))]
    seeing = [one for one in range(len(images)) if len(seen[one])]
    vlad = Vlad.train(descriptors)
    means = _sums(descriptors, tracks)
    content = MapContent(
        image_names=tuple(f'{one:04d}.png' for one in seeing),
        camera_from_sfm=tuple(images[one].camera_from_map for one in seeing),
        points=_sums(positions, tracks) / _sums(np.ones((len(tracks), 1)), tracks),
        descriptors=means / np.linalg.norm(means, axis=1, keepdims=True),
        observation_offsets=np.cumsum([0, *(len(seen[one]) for one in seeing)], dtype=np.int64),
        observation_points=np.concatenate(seen).astype(np.int32),
        global_descriptors=np.stack(
            [vlad.describe(images[one].image, found[one]) for one in seeing]
        ),
        codebook=vlad.codebook,
    )
    frame = MapFrame(metric=True, source='rendered')
    save_map(path, content, Manifest(extractor.identity, vlad.name, frame, {}), None)


def _on_surfaces(features: LocalFeatures, one: KnownImage) -> LocalFeatures:
    """The features whose surroundings have one depth."""
    near, far = minimum_filter(one.depth, 3), maximum_filter(one.depth, 3)
    columns, rows = np.floor(features.keypoints).astype(int).T
    with np.errstate(invalid='ignore'):
        is_smooth = far[rows, columns] <= (1.0 + MAX_DEPTH_STEP) * near[rows, columns]
    kept = is_smooth & np.isfinite(far[rows, columns])
    return type(features)(
        features.keypoints[kept], features.descriptors[kept], features.scores[kept]
    )


def _in_map(
    keypoints: NDArray[np.float32], one: KnownImage, camera: pycolmap.Camera
) -> NDArray[np.float64]:
    """Places [K,3] of keypoints [K,2], by the depth of their pixel."""
    columns, rows = np.floor(keypoints).astype(int).T
    rays = np.asarray(camera.cam_from_img(keypoints.astype(np.float64)))
    in_camera = np.column_stack([rays, np.ones(len(rays))]) * one.depth[rows, columns, None]
    return np.asarray(one.camera_from_map.inverse() * in_camera.astype(np.float64))


def _tracks(
    positions: NDArray[np.float64], descriptors: NDArray[np.float32], image_of: NDArray[np.intp]
) -> NDArray[np.int64]:
    """Number [K] of the point that each feature is of, -1 for what one image alone sees."""
    pairs = cKDTree(positions).query_pairs(SAME_PLACE, output_type='ndarray')
    first, second = pairs.T
    alike = np.einsum('kd,kd->k', descriptors[first], descriptors[second]) >= SAME_LOOK
    kept = alike & (image_of[first] != image_of[second])
    links = coo_matrix(
        (np.ones(np.count_nonzero(kept)), (first[kept], second[kept])), shape=[len(positions)] * 2
    )
    _, component = connected_components(links, directed=False)
    is_track = np.bincount(component) > 1
    number = np.where(is_track, np.cumsum(is_track) - 1, -1)
    return np.asarray(number[component], np.int64)


def _sums(values: NDArray[np.floating], tracks: NDArray[np.int64]) -> NDArray[np.float64]:
    """Sums [N,C] of the rows of values [K,C] that are of the same point."""
    sums = np.zeros((int(tracks.max()) + 1, values.shape[1]))
    np.add.at(sums, tracks[tracks >= 0], values[tracks >= 0])
    return sums
