# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Every reference image of a map as a query to the map without it.

Section 'Learning from SfM Model' of the paper: the tracks tell which keypoint is which point, so a
map brings its own labels to train a matcher on, and its own truth to measure one with.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from gam_relocalizer.errors import ImageError, MapError, UsageError
from gam_relocalizer.features.registry import create_extractor
from gam_relocalizer.images import read_image
from gam_relocalizer.map_encoding import unit_rows
from gam_relocalizer.mapping.colmap_model import NO_POINT
from gam_relocalizer.mapping.mapped_images import images_in_order, read_model_of
from gam_relocalizer.mapping.progress import ignore_progress
from gam_relocalizer.scene_map import SceneMap

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.features.local import LocalExtractor
    from gam_relocalizer.mapping.progress import Progress

# Keypoints of the same image and extractor agree to rounding, but for a few of the faintest.
_SAME_KEYPOINT_PX = 0.01
_MIN_KNOWN_KEYPOINTS = 0.9
# Nothing is triangulated from fewer images.
_MIN_TRACK = 2


@dataclass(frozen=True)
class ReferenceImage:
    """A reference image with all its features.

    Attributes:
        camera: Intrinsics.
        keypoints: [M,2] float32 pixels, COLMAP convention.
        descriptors: [M,D] float32, L2-normalised.
        point_of_keypoint: [M] int64, the map's point that a keypoint observes, or `NO_POINT`.
    """

    camera: pycolmap.Camera
    keypoints: NDArray[np.float32]
    descriptors: NDArray[np.float32]
    point_of_keypoint: NDArray[np.int64]


@dataclass(frozen=True)
class ReferenceImages:
    """The reference images of a map, in its order.

    Attributes:
        scene_map: The map.
        images: I images.
        descriptor_sums: [N,D] float32, over the whole track of each point.
    """

    scene_map: SceneMap
    images: tuple[ReferenceImage, ...]
    descriptor_sums: NDArray[np.float32]

    @cached_property
    def track_lengths(self) -> NDArray[np.int64]:
        """[N] number of images that see each point."""
        seen = [self.scene_map.points_seen_by(image) for image in range(len(self.images))]
        return np.bincount(np.concatenate(seen), minlength=len(self.descriptor_sums))


@dataclass(frozen=True)
class LeftOutView:
    """A reference image as a query, and what the map is without it.

    Attributes:
        image: Index of the reference image.
        reference: Index of the one that retrieval finds in its place.
        points: [N] int64 rising indices of the points that covisible images see.
        point_descriptors: [N,D] float32 means over the tracks without this image, L2-normalised.
        true_rows: [M] int64, the row of `points` that a keypoint truly observes, or `NO_POINT`.
    """

    image: int
    reference: int
    points: NDArray[np.int64]
    point_descriptors: NDArray[np.float32]
    true_rows: NDArray[np.int64]


def read_reference_images(
    scene_map: SceneMap, folder: Path, progress: Progress = ignore_progress
) -> ReferenceImages:
    """Describes the images that a map was built from once more, and reads their tracks.

    Args:
        scene_map: A map with its COLMAP model.
        folder: The folder of images that it was built from.
        progress: Told of the step extract.

    Raises:
        UsageError: There is no such folder.
        MapError: The map has no COLMAP model, or one that does not fit it.
        ImageError: An image is missing, unreadable, or not the one the map was built from.
        WeightsError: The extractor's weights are missing or damaged.
    """
    if not folder.is_dir():
        msg = (
            f'{folder}: no such folder of images; expected the one {scene_map.path} was built from'
        )
        raise UsageError(msg)
    observed = _read_observed_images(scene_map)
    extractor = _extractor_of(scene_map)
    images = []
    for done, image in enumerate(observed, start=1):
        images.append(_describe(image, folder / image.name, extractor))
        progress('extract', done, len(observed))
    return ReferenceImages(scene_map, tuple(images), _descriptor_sums(images, scene_map))


def reference_cameras(scene_map: SceneMap) -> tuple[pycolmap.Camera, ...]:
    """The intrinsics of each reference image of a map with a COLMAP model.

    Raises:
        MapError: The map has no COLMAP model, or one that does not fit it.
    """
    return tuple(image.camera for image in _read_observed_images(scene_map))


def leave_out(references: ReferenceImages, image: int) -> LeftOutView:
    """Takes an image out of its map: from the means of its points, and from retrieval.

    Its keypoints stay in the triangulation of the points, as in the paper.
    """
    scene_map, left_out = references.scene_map, references.images[image]
    covisible = scene_map.covisibility[[image]].indices
    seen = [scene_map.points_seen_by(other) for other in covisible if other != image]
    points = np.unique(np.concatenate([np.empty(0, np.int32), *seen])).astype(np.int64)

    observes = np.flatnonzero(left_out.point_of_keypoint != NO_POINT)
    observed = left_out.point_of_keypoint[observes]
    row_of_point = np.full(scene_map.num_points, NO_POINT)
    row_of_point[points] = np.arange(len(points))
    true_rows = np.full(len(left_out.keypoints), NO_POINT)
    true_rows[observes] = row_of_point[observed]

    sums = references.descriptor_sums[points]
    inside = true_rows != NO_POINT
    np.subtract.at(sums, true_rows[inside], left_out.descriptors[inside])
    return LeftOutView(
        image=image,
        reference=_retrieved_without(scene_map, image),
        points=points,
        point_descriptors=unit_rows(sums),
        true_rows=true_rows,
    )


@dataclass(frozen=True)
class MapWithout(SceneMap):
    """A map as if one of its reference images had never been taken; made in no time.

    Points keep their indices. A point that only one other image sees is seen by none here: it would
    not have been triangulated. The others keep their places, though the image helped to find them.

    Attributes:
        whole: The map with the image.
        image: The image left out, an index of the whole map.
        points_lost: [L] int64 rising indices of the points it sees and at most one other image.
        points_changed: [K] int64 rising indices of the other points it sees.
        changed_descriptors: [K,D] float32 their mean descriptors without it, of length one.
    """

    whole: SceneMap
    image: int
    points_lost: NDArray[np.int64]
    points_changed: NDArray[np.int64]
    changed_descriptors: NDArray[np.float32]

    def points_seen_by(self, image: int) -> NDArray[np.int32]:
        """See `SceneMap`."""
        seen = self.whole.points_seen_by(int(self._others[image]))
        return seen[~np.isin(seen, self.points_lost)]

    def observations(self) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """See `SceneMap`."""
        seen = [self.points_seen_by(image) for image in range(self.num_images)]
        offsets = np.cumsum([0, *map(len, seen)], dtype=np.int64)
        return offsets, np.concatenate([np.empty(0, np.int32), *seen])

    def descriptors_of(self, points: NDArray[np.integer]) -> NDArray[np.float32]:
        """See `SceneMap`."""
        descriptors = self.whole.descriptors_of(points)
        changed = np.isin(points, self.points_changed)
        rows = np.searchsorted(self.points_changed, points[changed])
        descriptors[changed] = self.changed_descriptors[rows]
        return descriptors

    def likeness(self, global_descriptor: NDArray[np.float32]) -> NDArray[np.float32]:
        """See `SceneMap`."""
        return self.whole.likeness(global_descriptor)[self._others]

    def global_descriptor_of(self, image: int) -> NDArray[np.float32]:
        """See `SceneMap`."""
        return self.whole.global_descriptor_of(int(self._others[image]))

    @cached_property
    def covisibility(self) -> csr_matrix:
        """See `SceneMap`."""
        # a lost point had one other observer: no two of them shared it
        covisibility = csr_matrix(self.whole.covisibility[self._others][:, self._others])
        covisibility.setdiag(self.num_points_seen)
        covisibility.eliminate_zeros()
        return covisibility

    @cached_property
    def _others(self) -> NDArray[np.int64]:
        """[I-1] the images of this map, by their indices in the whole one."""
        return np.delete(np.arange(self.whole.num_images), self.image)


def map_without(references: ReferenceImages, image: int) -> MapWithout:
    """The whole map but for one image, for a localizer."""
    whole = references.scene_map
    seen = whole.points_seen_by(image).astype(np.int64)
    enough = references.track_lengths[seen] > _MIN_TRACK
    changed, lost = seen[enough], seen[~enough]
    others = np.delete(np.arange(whole.num_images), image)
    return MapWithout(
        path=whole.path,
        manifest=whole.manifest,
        image_names=tuple(whole.image_names[other] for other in others),
        camera_from_map=tuple(whole.camera_from_map[other] for other in others),
        num_points_seen=(whole.num_points_seen - _seen_by_each(whole, image, lost))[others],
        stored=whole.stored,
        whole=whole,
        image=image,
        points_lost=lost,
        points_changed=changed,
        changed_descriptors=_descriptors_without(references, image, changed),
    )


def _seen_by_each(scene_map: SceneMap, image: int, points: NDArray[np.int64]) -> NDArray[np.int64]:
    """[I] how many of some points of an image each image sees."""
    counts = np.zeros(scene_map.num_images, np.int64)
    for one in scene_map.covisible_with(np.array([image])):
        counts[one] = np.isin(points, scene_map.points_seen_by(one)).sum()
    return counts


def _descriptors_without(
    references: ReferenceImages, image: int, points: NDArray[np.int64]
) -> NDArray[np.float32]:
    """[K,D] mean descriptors, of length one, of points [K] that other images see, too."""
    left_out = references.images[image]
    keypoints = np.flatnonzero(np.isin(left_out.point_of_keypoint, points))
    rows = np.searchsorted(points, left_out.point_of_keypoint[keypoints])
    sums = references.descriptor_sums[points]
    np.subtract.at(sums, rows, left_out.descriptors[keypoints])
    return unit_rows(sums)


def _retrieved_without(scene_map: SceneMap, image: int) -> int:
    scores = scene_map.likeness(scene_map.global_descriptor_of(image))
    scores[image] = -np.inf
    return int(np.argmax(scores))


@dataclass(frozen=True)
class _ObservedImage:
    """What the COLMAP model knows of a reference image."""

    name: str
    camera: pycolmap.Camera
    keypoints: NDArray[np.float64]
    point_of_keypoint: NDArray[np.int64]


def _read_observed_images(scene_map: SceneMap) -> list[_ObservedImage]:
    """The map's images, in its order."""
    model = read_model_of(scene_map.path, scene_map.manifest)
    images = images_in_order(model, scene_map.image_names, scene_map.num_points)
    return [
        _ObservedImage(image.name, model.cameras[image.camera_id], image.keypoints, image.points)
        for image in images
    ]


def _extractor_of(scene_map: SceneMap) -> LocalExtractor:
    """The extractor that made the map, with as many keypoints as then."""
    manifest = scene_map.manifest
    options = manifest.build.get('options')
    max_keypoints = options.get('max_keypoints') if isinstance(options, dict) else None
    if not isinstance(max_keypoints, int):
        msg = f'{scene_map.path}: its manifest does not tell `max_keypoints`; build the map again'
        raise MapError(msg)
    extractor = create_extractor(manifest.extractor.name, max_keypoints)
    if extractor.identity != manifest.extractor:
        msg = (
            f'{scene_map.path}: its descriptors come from another extractor than here: expected '
            f'{extractor.identity}, found {manifest.extractor}; build it again with `map build`'
        )
        raise MapError(msg)
    return extractor


def _describe(observed: _ObservedImage, file: Path, extractor: LocalExtractor) -> ReferenceImage:
    features = extractor.extract(read_image(file))
    same = _same_keypoints(features.keypoints, observed.keypoints)
    known = np.count_nonzero(same < len(observed.keypoints))
    if known < _MIN_KNOWN_KEYPOINTS * max(len(features), len(observed.keypoints)):
        msg = (
            f'{file}: {known} of its {len(features)} features are among the '
            f'{len(observed.keypoints)} in the map; expected the very image that the map was '
            f'built from'
        )
        raise ImageError(msg)
    return ReferenceImage(
        camera=observed.camera,
        keypoints=features.keypoints,
        descriptors=features.descriptors,
        point_of_keypoint=np.append(observed.point_of_keypoint, NO_POINT)[same],
    )


def _same_keypoints(
    keypoints: NDArray[np.floating], observed: NDArray[np.floating]
) -> NDArray[np.int64]:
    """For each keypoint the index of the same observed one, or their number if there is none.

    Keypoints of almost equal score change places with the number of threads, and the last ones are
    another selection. SIFT has several at one place, which the order tells apart.
    """
    _, same = cKDTree(observed).query(keypoints, distance_upper_bound=_SAME_KEYPOINT_PX)
    common = min(len(keypoints), len(observed))
    distances = np.linalg.norm(keypoints[:common] - observed[:common], axis=1)
    in_order = np.flatnonzero(distances < _SAME_KEYPOINT_PX)
    same[in_order] = in_order
    return np.asarray(same, np.int64)


def _descriptor_sums(images: Sequence[ReferenceImage], scene_map: SceneMap) -> NDArray[np.float32]:
    shape = scene_map.num_points, scene_map.manifest.extractor.dimension
    sums = np.zeros(shape, np.float32)
    for image in images:
        observes = image.point_of_keypoint != NO_POINT
        np.add.at(sums, image.point_of_keypoint[observes], image.descriptors[observes])
    return sums
