# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Views of real places: every reference image of a map, seen by a part of the map without it.

Section 'Learning from SfM Model' of the paper. The tracks are the truth. What is drawn at random
makes many views of one image: which covisible images the points and their descriptors come from
(often the least alike ones only), which of them is the reference camera, a crop and a roll of the
image, the keypoints and points that are left, and how much the descriptors are disturbed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from gam_relocalizer.cameras import have_known_rays
from gam_relocalizer.mapping.colmap_model import NO_POINT
from gam_relocalizer.matching.bmnet import normalise_keypoints, normalised_focal_length
from gam_relocalizer.training.labelled import meet

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.mapping.leave_one_out import ReferenceImage, ReferenceImages

MAX_COVISIBLE = 20
FEWEST_KEYPOINTS = 32
FEWEST_POINTS = 50


@dataclass(frozen=True)
class MapView:
    """See `View`.

    Attributes:
        keypoints: [M, 2].
        focal_length: In the unit of the keypoints.
        descriptors: [M, D].
        points: [N, 3].
        point_descriptors: [N, D].
        projections: [N, 2] true normalised projections of the points, nan behind the camera.
        rows: [M] int64, the row of `points` that a keypoint observes, or `NO_POINT`.
    """

    keypoints: NDArray[np.float32]
    focal_length: float
    descriptors: NDArray[np.float32]
    points: NDArray[np.float32]
    point_descriptors: NDArray[np.float32]
    projections: NDArray[np.float32]
    rows: NDArray[np.int64]

    def labels(self, edges: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which edges are true: those of the tracks, and those as good as one.

        Structure from motion often makes two points of one place, each with a part of the track.
        """
        in_track = self.rows[edges[:, 0]] == edges[:, 1]
        return np.asarray(in_track | meet(edges, self.keypoints, self.projections))


@dataclass(frozen=True)
class _Part:
    """Points that some reference images see, with the mean of what these see."""

    points: NDArray[np.int64]
    descriptors: NDArray[np.float32]


def map_view(
    references: ReferenceImages,
    image: int,
    rng: np.random.Generator,
    keypoints: tuple[int, int],
    points: tuple[int, int],
) -> MapView | None:
    """Draws a view of a reference image; None where it came out too small to learn from.

    Args:
        references: The reference images of a map.
        image: The one to be the query.
        rng: Source of everything random.
        keypoints: Least and greatest number of keypoints.
        points: Least and greatest number of points.
    """
    scene_map, query = references.scene_map, references.images[image]
    covisible = _some_covisible(references, image, rng)
    if not len(covisible):
        return None
    kept_keypoints = _some_keypoints(query, _log_uniform(rng, keypoints), rng)
    part = _part(references, covisible)
    kept_points = np.sort(rng.permutation(len(part.points))[: _log_uniform(rng, points)])
    if len(kept_keypoints) < FEWEST_KEYPOINTS or len(kept_points) < FEWEST_POINTS:
        return None
    reference_from_map = scene_map.camera_from_map[covisible[0]]
    row_of_point = np.full(scene_map.num_points + 1, NO_POINT)
    row_of_point[part.points[kept_points]] = np.arange(len(kept_points))
    positions = scene_map.positions_of(part.points[kept_points])
    in_reference = reference_from_map * positions
    image_from_image = _roll(rng)
    normalised = normalise_keypoints(query.keypoints[kept_keypoints], query.camera)
    projections = _projected(scene_map.camera_from_map[image] * positions, query.camera)
    return MapView(
        keypoints=(normalised @ image_from_image.T).astype(np.float32),
        focal_length=normalised_focal_length(query.camera),
        descriptors=_disturbed(query.descriptors[kept_keypoints], rng),
        points=in_reference.astype(np.float32),
        point_descriptors=part.descriptors[kept_points],
        projections=(projections @ image_from_image.T).astype(np.float32),
        # the last row of the table stands for no point
        rows=row_of_point[query.point_of_keypoint[kept_keypoints]],
    )


def _some_covisible(
    references: ReferenceImages, image: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Covisible images, a reference first: often few, and not those that see the most of it."""
    row = references.scene_map.covisibility[[image]]
    others = row.indices[row.indices != image]
    shared = row.data[row.indices != image]
    nearest_first = others[np.lexsort((others, -shared))]
    if rng.random() < 0.4:
        nearest = nearest_first[:MAX_COVISIBLE]
        return np.roll(nearest, -int(rng.integers(1 + len(nearest) // 4)))
    skipped = int(rng.integers(1 + 2 * len(nearest_first) // 3))
    count = int(rng.integers(1, 1 + MAX_COVISIBLE // 2))
    return rng.permutation(nearest_first[skipped:])[:count]


def _some_keypoints(
    query: ReferenceImage, count: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Some of the keypoints, of the whole image or of a square in it."""
    chosen = rng.permutation(np.flatnonzero(have_known_rays(query.keypoints, query.camera)))
    if rng.random() < 0.4:
        size = np.array([query.camera.width, query.camera.height])
        centre, side = rng.uniform(0, 1, 2) * size, rng.uniform(0.4, 0.9) * size.max()
        offsets = np.abs(query.keypoints[chosen] - centre)
        chosen = chosen[(offsets < side / 2).all(axis=1)]
    return chosen[:count]


def _part(references: ReferenceImages, images: Sequence[int] | NDArray[np.int64]) -> _Part:
    seen = [references.images[i] for i in images]
    observed = [image.point_of_keypoint != NO_POINT for image in seen]
    points, rows = np.unique(
        np.concatenate(
            [image.point_of_keypoint[o] for image, o in zip(seen, observed, strict=True)]
        ),
        return_inverse=True,
    )
    sums = np.zeros((len(points), references.descriptor_sums.shape[1]), np.float32)
    described = [image.descriptors[o] for image, o in zip(seen, observed, strict=True)]
    np.add.at(sums, rows, np.concatenate(described))
    norms = np.linalg.norm(sums, axis=1, keepdims=True)
    return _Part(points, sums / np.maximum(norms, np.finfo(np.float32).tiny))


def _roll(rng: np.random.Generator) -> NDArray[np.float64]:
    """A turn about the optical axis: hands are not steady, and now and then hold it upright."""
    angle = rng.normal(0, 0.08) if rng.random() < 0.8 else rng.uniform(0, 2 * np.pi)
    return np.asarray(Rotation.from_euler('z', angle).as_matrix()[:2, :2])


def _projected(in_camera: NDArray[np.float64], camera: pycolmap.Camera) -> NDArray[np.float64]:
    """Normalised as keypoints are; undistorted, for so are those."""
    depths = np.where(in_camera[:, 2] > 0, in_camera[:, 2], np.nan)
    return np.asarray(in_camera[:, :2] / depths[:, None] * normalised_focal_length(camera))


def _disturbed(descriptors: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Half of the views look more different from the map than those of one walk do."""
    if rng.random() < 0.5:
        return descriptors
    noise = rng.normal(size=descriptors.shape)
    noise *= rng.uniform(0, 0.6) / np.linalg.norm(noise, axis=1, keepdims=True)
    noisy = descriptors + noise
    return np.asarray(noisy / np.linalg.norm(noisy, axis=1, keepdims=True), np.float32)


def _log_uniform(rng: np.random.Generator, limits: tuple[int, int]) -> int:
    return round(float(np.exp(rng.uniform(*np.log(limits)))))
