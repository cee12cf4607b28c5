# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What a map stores of a reconstruction: points, their descriptors, and who sees them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.mapping.sfm import image_id_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.mapping.extraction import MappingImage


@dataclass(frozen=True)
class DescribedPoints:
    """Points with descriptors, and observations by image.

    Attributes:
        points: [N,3] float64, SfM frame.
        descriptors: [N,D] float32, mean over the track, L2-normalised.
        images: Indices of the images that see a point, rising; I of them.
        observation_offsets: [I+1] int64.
        observation_points: [nnz] int32 indices into `points`.
    """

    points: NDArray[np.float64]
    descriptors: NDArray[np.float32]
    images: tuple[int, ...]
    observation_offsets: NDArray[np.int64]
    observation_points: NDArray[np.int32]


def describe_points(
    model: pycolmap.Reconstruction, images: Sequence[MappingImage]
) -> DescribedPoints:
    """Averages the descriptors of each track of a model with at least one point."""
    point_ids = np.array(sorted(model.point3D_ids()), dtype=np.uint64)
    points = np.array([model.point3D(int(point_id)).xyz for point_id in point_ids])
    sums = np.zeros((len(points), images[0].features.descriptors.shape[1]))
    seeing: list[int] = []
    seen: list[NDArray[np.int32]] = []
    for index, image in enumerate(images):
        keypoints, observed = _observations(model, index, point_ids)
        if not len(keypoints):
            continue
        np.add.at(sums, observed, image.features.descriptors[keypoints])
        seeing.append(index)
        seen.append(np.unique(observed).astype(np.int32))
    return DescribedPoints(
        points=points,
        descriptors=(sums / np.linalg.norm(sums, axis=1, keepdims=True)).astype(np.float32),
        images=tuple(seeing),
        observation_offsets=np.cumsum([0, *(len(one) for one in seen)], dtype=np.int64),
        observation_points=np.concatenate(seen),
    )


def _observations(
    model: pycolmap.Reconstruction, index: int, point_ids: NDArray[np.uint64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Keypoints of an image that belong to a point, and the row of that point."""
    image_id = image_id_of(index)
    if not model.exists_image(image_id) or not model.image(image_id).has_pose:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    image = model.image(image_id)
    keypoints = np.array(image.get_observation_point2D_idxs(), dtype=np.int64)
    ids = np.array([image.point2D(int(one)).point3D_id for one in keypoints], dtype=np.uint64)
    return keypoints, np.searchsorted(point_ids, ids).astype(np.int64)
