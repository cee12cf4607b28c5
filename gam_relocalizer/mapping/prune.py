# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Makes a map small: leaves out images and points that tell least, and says what that costs."""

from __future__ import annotations

import tempfile
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.errors import UsageError
from gam_relocalizer.features.local import LocalFeatures
from gam_relocalizer.features.registry import global_descriptor_of
from gam_relocalizer.geometry import pose_error
from gam_relocalizer.images import read_image
from gam_relocalizer.mapping.build import check_output, save_bundle
from gam_relocalizer.mapping.colmap_model import NO_POINT
from gam_relocalizer.mapping.coverage import tolerance_of
from gam_relocalizer.mapping.leave_one_out import map_without, read_reference_images
from gam_relocalizer.mapping.mapped_images import (
    assemble,
    changed_manifest,
    read_mapped_images,
)
from gam_relocalizer.mapping.progress import ignore_progress
from gam_relocalizer.mapping.selection import MIN_OBSERVERS, order_images, order_points
from gam_relocalizer.mapping.sfm import MIN_IMAGES
from gam_relocalizer.mapping.trials import localizers_in
from gam_relocalizer.scene_map import (
    DESCRIPTOR_BITS,
    SFM,
    load_map,
    map_in_memory,
    save_map,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.localization.result import LocalizationResult
    from gam_relocalizer.mapping.coverage import Tolerance
    from gam_relocalizer.mapping.leave_one_out import ReferenceImages
    from gam_relocalizer.mapping.mapped_images import MappedImages
    from gam_relocalizer.mapping.progress import Progress
    from gam_relocalizer.scene_map import Manifest, MapContent, SceneMap

DEFAULT_DESCRIPTOR_BITS = 8
# Where images take more than this of the bundle, too few points are left for them to see.
_IMAGES_SHARE = 0.4
_MAX_QUERIES = 100
_TRIALS = 8
_CLOSE_ENOUGH = 0.01


@dataclass(frozen=True)
class Recall:
    """How often reference images are found in the map without them.

    Attributes:
        queries: Reference images that were localized.
        before: Share of them that were accepted at their pose, in the map as it was.
        after: The same in the pruned map.
    """

    queries: int
    before: float
    after: float


@dataclass(frozen=True)
class PruneReport:
    """What is left of a map; pairs are before and after.

    Attributes:
        images: Reference images.
        points: Points.
        size: Bytes of the bundle besides `sfm/`.
        recall: What that costs, if it was measured.
    """

    images: tuple[int, int]
    points: tuple[int, int]
    size: tuple[int, int]
    recall: Recall | None


def prune_map(
    path: Path,
    out: Path,
    keep: float,
    *,
    descriptor_bits: int = DEFAULT_DESCRIPTOR_BITS,
    folder: Path | None = None,
    global_weights: Path | None = None,
    progress: Progress = ignore_progress,
) -> PruneReport:
    """Writes a small map with most of what a big one can do.

    Poses of images and places of points stay as they are. A point stays only if two of the images
    that stay see it: what else it was seen by is forgotten.

    Args:
        path: The map; it is not changed unless `out` is the same.
        out: The bundle to write.
        keep: Share of the size of the bundle, without `sfm/`, above 0 and at most 1.
        descriptor_bits: Of each number of a descriptor in the small map.
        folder: The images that the map was built from, to measure what is lost.
        global_weights: Of the map's global descriptor, when it has any and `folder` is given.
        progress: Told of the steps select, extract, localize and save.

    Raises:
        UsageError: `keep` or `descriptor_bits` are impossible, or so small that no map is left; or
            there is no such folder.
        MapError: The map is damaged or lacks its COLMAP model; or `out` exists and is no map.
        ImageError: An image in the folder is not the one that the map was built from.
    """
    if not 0 < keep <= 1:
        msg = f'--keep is {keep:g}; expected a share of the size above 0 and at most 1'
        raise UsageError(msg)
    if descriptor_bits not in DESCRIPTOR_BITS:
        known = ' or '.join(map(str, DESCRIPTOR_BITS))
        msg = f'--descriptor-bits is {descriptor_bits}; expected {known}'
        raise UsageError(msg)
    check_output(out)
    scene_map, mapped = load_map(path), read_mapped_images(path)
    manifest = replace(mapped.manifest, descriptor_bits=descriptor_bits)
    selection = _select(scene_map, mapped, manifest, keep, progress)
    content = _some_of(mapped.content, selection)
    recall = None
    if folder is not None:
        references = read_reference_images(scene_map, folder, progress)
        small = _SmallMap(manifest, content, selection)
        recall = _recall(references, folder, small, global_weights, progress)
    model = _model_of(mapped, selection)
    report = PruneReport(
        images=(scene_map.num_images, len(content.image_names)),
        points=(scene_map.num_points, len(content.points)),
        size=(_size(mapped.manifest), _trial_size(content, manifest)),
        recall=recall,
    )
    change = {'what': 'prune', 'keep': keep, **asdict(report)}
    progress('save', 0, 1)
    save_bundle(out, content, changed_manifest(manifest, change, model), model)
    progress('save', 1, 1)
    return report


@dataclass(frozen=True)
class _Selection:
    """What stays.

    Attributes:
        images: Rising indices of images.
        points: Rows of points, in the order that they have in the small map.
    """

    images: NDArray[np.int64]
    points: NDArray[np.int64]


@dataclass(frozen=True)
class _SmallMap:
    manifest: Manifest
    content: MapContent
    selection: _Selection


def _select(
    scene_map: SceneMap, mapped: MappedImages, manifest: Manifest, keep: float, progress: Progress
) -> _Selection:
    """The images and points that tell most and fit into the size."""
    budget = keep * _size(mapped.manifest)

    def size_of(images: NDArray[np.int64], points: NDArray[np.int64]) -> int:
        selection = _by_sight(mapped.content, images, points)
        return _trial_size(_some_of(mapped.content, selection), manifest)

    progress('select', 0, 2)
    everything = np.arange(scene_map.num_images), np.arange(scene_map.num_points)
    if size_of(*everything) <= budget:
        progress('select', 2, 2)
        return _by_sight(mapped.content, *everything)
    ordered, no_points = order_images(scene_map.covisibility), np.empty(0, np.int64)
    kept_images = _most_that_fit(
        len(ordered), _IMAGES_SHARE * budget, lambda count: size_of(ordered[:count], no_points)
    )
    images = ordered[: max(kept_images, MIN_IMAGES)]
    progress('select', 1, 2)
    points = order_points(scene_map, images)
    kept_points = _most_that_fit(len(points), budget, lambda count: size_of(images, points[:count]))
    progress('select', 2, 2)
    if not kept_points:
        msg = (
            f'--keep {keep:g}: {budget:.0f} bytes do not hold a map of {len(images)} images and '
            f'their points; keep more'
        )
        raise UsageError(msg)
    return _by_sight(mapped.content, images, points[:kept_points])


def _by_sight(
    content: MapContent, images: NDArray[np.int64], points: NDArray[np.int64]
) -> _Selection:
    """Images in their order, points as `numbered_by_sight` would have them."""
    chosen = np.zeros(len(content.points), bool)
    chosen[points] = True
    first, last = np.full((2, len(content.points)), NO_POINT)
    for image in np.sort(images).tolist():
        seen = _seen_by(content, image)
        first[seen] = np.where(first[seen] == NO_POINT, image, first[seen])
        last[seen] = image
    rows = np.flatnonzero(chosen)
    return _Selection(np.sort(images), rows[np.lexsort((rows, last[rows], first[rows]))])


def _most_that_fit(count: int, budget: float, size_of: Callable[[int], int]) -> int:
    """The largest number, at most `count`, whose size is within the budget; 0 if none is.

    The size grows almost evenly, so that a straight line tells where to look next.
    """
    low, high = 0, count
    low_size, high_size = size_of(low), size_of(high)
    if high_size <= budget:
        return high
    if low_size > budget:
        return 0
    for _ in range(_TRIALS):
        if high - low <= 1 or budget - low_size < _CLOSE_ENOUGH * budget:
            break
        share = (budget - low_size) / (high_size - low_size)
        middle = min(max(low + int(share * (high - low)), low + 1), high - 1)
        size = size_of(middle)
        if size <= budget:
            low, low_size = middle, size
        else:
            high, high_size = middle, size
    return low


def _size(manifest: Manifest) -> int:
    return sum(
        entry.size for name, entry in manifest.files.items() if not name.startswith(f'{SFM}/')
    )


def _trial_size(content: MapContent, manifest: Manifest) -> int:
    with tempfile.TemporaryDirectory(prefix='map_prune_') as folder:
        return _size(save_map(Path(folder) / 'trial', content, manifest, None))


def _some_of(content: MapContent, selection: _Selection) -> MapContent:
    """A part of a map."""
    rows = np.full(len(content.points), NO_POINT, np.int64)
    rows[selection.points] = np.arange(len(selection.points))
    seen = [rows[_seen_by(content, image)] for image in selection.images.tolist()]
    seen = [one[one != NO_POINT] for one in seen]
    return replace(
        content,
        image_names=tuple(content.image_names[image] for image in selection.images),
        camera_from_sfm=tuple(content.camera_from_sfm[image] for image in selection.images),
        points=content.points[selection.points],
        descriptors=content.descriptors[selection.points],
        observation_offsets=np.cumsum([0, *(len(one) for one in seen)], dtype=np.int64),
        observation_points=np.concatenate([np.empty(0, np.int32), *seen]).astype(np.int32),
        global_descriptors=content.global_descriptors[selection.images],
    )


def _seen_by(content: MapContent, image: int) -> NDArray[np.int32]:
    begin, end = content.observation_offsets[image : image + 2]
    return content.observation_points[begin:end]


def _model_of(mapped: MappedImages, selection: _Selection) -> pycolmap.Reconstruction:
    rows = np.full(len(mapped.points) + 1, NO_POINT, np.int64)  # the last is that of NO_POINT
    rows[selection.points] = np.arange(len(selection.points))
    images = selection.images.tolist()
    cameras = mapped.cameras
    return assemble(
        replace(cameras, of_image=tuple(cameras.of_image[image] for image in images)),
        [mapped.images[image] for image in images],
        [mapped.camera_from_sfm[image] for image in images],
        mapped.points[selection.points],
        [rows[mapped.point_of_keypoint[image]] for image in images],
    )


def _recall(
    references: ReferenceImages,
    folder: Path,
    small: _SmallMap,
    global_weights: Path | None,
    progress: Progress,
) -> Recall:
    """Localizes reference images in both maps, always in what the map is without them.

    Whether an image is mirrored is not looked at: that asks the same of both maps.
    """
    scene_map = references.scene_map
    localizer_in, tolerance = localizers_in(scene_map, global_weights), tolerance_of(scene_map)
    describer = global_descriptor_of(scene_map, global_weights)
    every = -(-scene_map.num_images // _MAX_QUERIES)
    queries = range(0, scene_map.num_images, every)
    found = np.zeros((len(queries), 2), bool)
    for done, image in enumerate(queries):
        progress('localize', done, len(queries))
        query, pose = references.images[image], scene_map.camera_from_map[image]
        unknown = np.zeros(len(query.keypoints), np.float32)
        features = LocalFeatures(query.keypoints, query.descriptors, unknown)
        described = describer.describe(read_image(folder / scene_map.image_names[image]), features)
        for which, left in enumerate(
            (map_without(references, image), _small_without(references, image, small))
        ):
            result = localizer_in(left).localize_features(features, described, query.camera)
            found[done, which] = _is_right(result, pose, tolerance)
    progress('localize', len(queries), len(queries))
    before, after = found.mean(axis=0).tolist()
    return Recall(len(queries), before, after)


def _small_without(references: ReferenceImages, image: int, small: _SmallMap) -> SceneMap:
    """The small map as if a reference image of the whole one had never been taken."""
    content, selection = small.content, small.selection
    left_out = references.images[image]
    seen = np.unique(left_out.point_of_keypoint[left_out.point_of_keypoint != NO_POINT])
    rows = np.flatnonzero(np.isin(selection.points, seen))
    sums = references.descriptor_sums[selection.points[rows]]
    row_of = np.full(len(references.descriptor_sums), NO_POINT, np.int64)
    row_of[selection.points[rows]] = np.arange(len(rows))
    of_keypoint = np.append(row_of, NO_POINT)[left_out.point_of_keypoint]
    known = of_keypoint != NO_POINT
    np.subtract.at(sums, of_keypoint[known], left_out.descriptors[known])
    descriptors = np.array(content.descriptors, np.float32)
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    descriptors[rows] = sums / np.maximum(lengths, np.finfo(np.float32).tiny)
    content = replace(content, descriptors=descriptors)
    kept = np.flatnonzero(selection.images != image)
    if len(kept) < len(selection.images):
        observers = np.bincount(content.observation_points, minlength=len(content.points))
        observers[_seen_by(content, int(np.flatnonzero(selection.images == image)[0]))] -= 1
        points = np.flatnonzero(observers >= MIN_OBSERVERS)
        content = _some_of(content, _Selection(kept, points))
    return map_in_memory(references.scene_map.path, content, small.manifest)


def _is_right(
    result: LocalizationResult, camera_from_map: pycolmap.Rigid3d, tolerance: Tolerance
) -> bool:
    if not result.accepted or result.estimate is None:
        return False
    error = pose_error(result.estimate.camera_from_map, camera_from_map)
    return error.position <= tolerance.position and error.rotation_deg <= tolerance.rotation_deg
