# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Joins two maps of one place: the second is laid over the first, whose frame and poses stay."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pycolmap

from gam_relocalizer.errors import MapBuildError, MapError
from gam_relocalizer.features.vlad import RETRIEVAL_NAME, Vlad
from gam_relocalizer.mapping.build import check_names, check_output, save_bundle
from gam_relocalizer.mapping.colmap_model import NO_POINT
from gam_relocalizer.mapping.mapped_images import (
    assemble,
    changed_manifest,
    check_no_name_twice,
    content_of,
    joined_cameras,
    read_mapped_images,
    with_prefix,
)
from gam_relocalizer.mapping.matching import match_pairs
from gam_relocalizer.mapping.pairs import choose_pairs_between
from gam_relocalizer.mapping.progress import StepTimer, ignore_progress
from gam_relocalizer.mapping.sfm import (
    SfmInput,
    adjust_images,
    image_id_of,
    numbered_by_sight,
    quiet_colmap,
    verify_pairs,
)

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from gam_relocalizer.mapping.mapped_images import MappedImages
    from gam_relocalizer.mapping.progress import Progress

# Two points are one when they are as near as this, by the distance that the first was seen from.
_SAME_PLACE = 0.03
# Less than this may be chance, or one poster that hangs in two places.
_MIN_SAME_POINTS = 50
_MIN_SAME_SHARE = 0.3
_MIN_PAIRS = 2
_SEED = 0
_MAX_TRIALS = 10_000
# Scales of two metric maps that differ by more contradict each other.
_SAME_SCALE = 0.03


@dataclass(frozen=True)
class MergeReport:
    """How two maps fit together.

    Attributes:
        images: Reference images of the first map and of the second.
        pairs_matched: Image pairs, one of each map, that were compared.
        pairs_verified: Image pairs whose matches obey one geometry.
        points_matched: Pairs of points, one of each map, that such matches take for the same.
        points_joined: Those that are in the same place, and one point now.
        median_distance: How far these were apart when the maps had been laid over each other
            [units of the first map].
        scale: Units of the first map for one of the second.
        points: Points of the merged map.
        observations: Their observations.
        mean_reprojection_error: Over all observations [px].
        warnings: What to look at, in words.
        seconds: Time per step.
    """

    images: tuple[int, int]
    pairs_matched: int
    pairs_verified: int
    points_matched: int
    points_joined: int
    median_distance: float
    scale: float
    points: int
    observations: int
    mean_reprojection_error: float
    warnings: tuple[str, ...]
    seconds: Mapping[str, float]


def merge_maps(
    first_path: Path,
    second_path: Path,
    out: Path,
    *,
    prefix: str = '',
    progress: Progress = ignore_progress,
) -> MergeReport:
    """Joins two maps of one place; neither is changed, unless `out` is one of them.

    Args:
        first_path: The map whose frame, alignment and poses are kept.
        second_path: The map that is laid over it.
        out: The bundle to write.
        prefix: Put in front of the image names of the second map.
        progress: Told of the steps match, verify, adjust and save.

    Raises:
        MapError: A map is damaged, lacks its COLMAP model, or they were made by different
            extractors or global descriptors; or `out` exists and is no map.
        UsageError: Both maps have an image of the same name.
        MapBuildError: The maps do not show the same place, or contradict each other.
    """
    check_output(out)
    first, second = read_mapped_images(first_path), read_mapped_images(second_path)
    _check_alike(first, second)
    second = replace(second, images=with_prefix(second.images, prefix))
    names = [image.name for image in second.images]
    check_names(names)
    check_no_name_twice(first_path, first.content.image_names, names)
    timer = StepTimer()
    described = _described_as_in(first, second)
    with timer.step('match'):
        likeness = described @ first.content.global_descriptors.T
        pairs = sorted((old, new) for new, old in choose_pairs_between(likeness))
        sfm_input = _compared(first, second, pairs, progress)
    with timer.step('verify'):
        verified = _verified(sfm_input, progress)
    matched = _matched_points(first, second, verified)
    laid = _lay_over(first, second, matched, len(pairs), len(verified))
    with timer.step('adjust'), quiet_colmap():
        progress('adjust', 0, 1)
        model = _joined(first, second, sfm_input, laid)
        progress('adjust', 1, 1)
    progress('save', 0, 1)
    content = content_of(
        model,
        sfm_input.images,
        np.concatenate([first.content.global_descriptors, described]),
        first.content.codebook,
    )
    unit = first.manifest.frame.scale
    scale = unit * float(laid.first_from_second.scale) / second.manifest.frame.scale
    change = {
        'what': 'merge',
        'map': second_path.absolute().name,
        'map_id': second.manifest.map_id,
        'prefix': prefix,
        'images': len(second.images),
        'points_joined': len(laid.same),
        'median_distance': unit * laid.median_distance,
        'scale': scale,
    }
    save_bundle(out, content, changed_manifest(first.manifest, change, model), model)
    progress('save', 1, 1)
    return MergeReport(
        images=(len(first.images), len(second.images)),
        pairs_matched=len(pairs),
        pairs_verified=len(verified),
        points_matched=len(matched),
        points_joined=len(laid.same),
        median_distance=unit * laid.median_distance,
        scale=scale,
        points=len(content.points),
        observations=len(content.observation_points),
        mean_reprojection_error=model.compute_mean_reprojection_error(),
        warnings=tuple(_warnings(first, second, scale)),
        seconds={step: round(seconds, 2) for step, seconds in timer.seconds.items()},
    )


@dataclass(frozen=True)
class _Laid:
    """The second map over the first.

    Attributes:
        first_from_second: Between the SfM frames.
        same: [S,2] rows of points of the first and the second map that are one.
        median_distance: Between these [units of the first map's SfM frame].
    """

    first_from_second: pycolmap.Sim3d
    same: NDArray[np.int64]
    median_distance: float


def _check_alike(first: MappedImages, second: MappedImages) -> None:
    """Refuses maps whose descriptors cannot be compared."""
    made = [
        (one.manifest.extractor, one.manifest.retrieval, one.manifest.retrieval_weights_sha256)
        for one in (first, second)
    ]
    if made[0] != made[1]:
        msg = (
            f'{second.path}: made with {made[1]}, {first.path} with {made[0]}; their descriptors '
            f'cannot be compared: build one of them again with the extractor and the global '
            f'descriptor of the other'
        )
        raise MapError(msg)


def _described_as_in(first: MappedImages, second: MappedImages) -> NDArray[np.float32]:
    """[I,G] global descriptors of the second map's images, to be compared with the first's."""
    if first.manifest.retrieval != RETRIEVAL_NAME:
        return second.content.global_descriptors
    vlad = Vlad(first.content.codebook)
    return np.stack(
        [
            vlad.aggregate(image.features.descriptors[seen != NO_POINT])
            for image, seen in zip(second.images, second.point_of_keypoint, strict=True)
        ]
    )


def _compared(
    first: MappedImages, second: MappedImages, pairs: list[tuple[int, int]], progress: Progress
) -> SfmInput:
    """The images of both maps and the matches between them."""
    images = (*first.images, *second.images)
    cameras = joined_cameras(first.cameras, second.cameras)
    shifted = [(old, len(first.images) + new) for old, new in pairs]
    matches = match_pairs(images, shifted, first.manifest.extractor.name, progress)
    return SfmInput(images, cameras, cameras.given, matches)


def _verified(sfm_input: SfmInput, progress: Progress) -> dict[tuple[int, int], NDArray[np.int64]]:
    """Those matches that obey one geometry, of the pairs that do."""
    progress('verify', 0, 1)
    geometries = verify_pairs(sfm_input.images, sfm_input.cameras, sfm_input.matches)
    progress('verify', 1, 1)
    return {
        pair: np.asarray(geometry.inlier_matches, np.int64)
        for pair, geometry in geometries.items()
        if len(geometry.inlier_matches)
    }


def _matched_points(
    first: MappedImages,
    second: MappedImages,
    verified: Mapping[tuple[int, int], NDArray[np.int64]],
) -> NDArray[np.int64]:
    """[M,2] rows of points of both maps that are matched in some pair of images, most often first.

    All keypoints that are matched observe a point; the others have no descriptor.
    """
    rows = [np.empty((0, 2), np.int64)]
    for (old, new), matches in verified.items():
        of_first = first.point_of_keypoint[old][matches[:, 0]]
        of_second = second.point_of_keypoint[new - len(first.images)][matches[:, 1]]
        rows.append(np.stack([of_first, of_second], axis=1))
    matched, votes = np.unique(np.concatenate(rows), axis=0, return_counts=True)
    return np.asarray(matched[np.argsort(-votes, kind='stable')], np.int64)


def _lay_over(
    first: MappedImages,
    second: MappedImages,
    matched: NDArray[np.int64],
    pairs: int,
    verified: int,
) -> _Laid:
    """Finds the similarity that most of the matched points agree with.

    Raises:
        MapBuildError: Too few agree.
    """
    one, other = first.points[matched[:, 0]], second.points[matched[:, 1]]
    reach = _SAME_PLACE * _viewing_distances(first)[matched[:, 0]]
    found: Any = None  # the stubs of pycolmap know another type than its documentation
    if len(matched) >= _MIN_SAME_POINTS and verified >= _MIN_PAIRS:
        options = pycolmap.RANSACOptions()
        options.max_error = float(np.median(reach))
        options.max_num_trials, options.random_seed = _MAX_TRIALS, _SEED
        found = pycolmap.estimate_sim3d_robust(other, one, options)
    first_from_second = pycolmap.Sim3d() if found is None else found['tgt_from_src']
    agreeing, distances = np.zeros(len(matched), bool), np.zeros(len(matched))
    if found is not None:
        distances = np.linalg.norm(one - first_from_second * other, axis=1)
        agreeing = distances < reach
    same = _one_to_one(matched[agreeing])
    if len(same) < _MIN_SAME_POINTS or np.mean(agreeing) < _MIN_SAME_SHARE:
        msg = (
            f'{second.path} does not fit over {first.path}: of {pairs} image pairs {verified} show '
            f'the same thing; they match {len(matched)} points, of which {len(same)} are in the '
            f'same place (needed: {_MIN_SAME_POINTS}, and {_MIN_SAME_SHARE:.0%} of all); expected '
            f'two maps whose images overlap'
        )
        raise MapBuildError(msg)
    return _Laid(first_from_second, same, float(np.median(distances[agreeing])))


def _viewing_distances(mapped: MappedImages) -> NDArray[np.float64]:
    """[N] mean distance of each point from the cameras that see it."""
    sums, counts = np.zeros(len(mapped.points)), np.zeros(len(mapped.points))
    for pose, seen in zip(mapped.camera_from_sfm, mapped.point_of_keypoint, strict=True):
        rows = seen[seen != NO_POINT]
        away = np.linalg.norm(mapped.points[rows] - pose.tgt_origin_in_src(), axis=1)
        np.add.at(sums, rows, away)
        np.add.at(counts, rows, 1)
    return np.asarray(sums / np.maximum(counts, 1))


def _one_to_one(pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Those of the pairs [K,2] of which neither side was in one before."""
    taken: tuple[set[int], set[int]] = set(), set()
    kept = []
    for one, other in pairs.tolist():
        if one not in taken[0] and other not in taken[1]:
            taken[0].add(one)
            taken[1].add(other)
            kept.append((one, other))
    return np.array(kept, np.int64).reshape(-1, 2)


def _joined(
    first: MappedImages, second: MappedImages, sfm_input: SfmInput, laid: _Laid
) -> pycolmap.Reconstruction:
    """One model of both maps; the second one's images and points are adjusted to the first's."""
    moved = [laid.first_from_second.transform_camera_world(pose) for pose in second.camera_from_sfm]
    row_of = np.full(len(second.points), NO_POINT)
    row_of[laid.same[:, 1]] = laid.same[:, 0]
    further = np.flatnonzero(row_of == NO_POINT)
    row_of[further] = len(first.points) + np.arange(len(further))
    points = np.concatenate([first.points, laid.first_from_second * second.points[further]])
    seen = [np.where(rows == NO_POINT, NO_POINT, row_of[rows]) for rows in second.point_of_keypoint]
    model = assemble(
        sfm_input.cameras,
        sfm_input.images,
        [*first.camera_from_sfm, *moved],
        points,
        [*first.point_of_keypoint, *seen],
    )
    free = [image_id_of(len(first.images) + index) for index in range(len(second.images))]
    adjust_images(model, free, shared_points=[int(row) + 1 for row in laid.same[:, 0]])
    return numbered_by_sight(model)


def _warnings(first: MappedImages, second: MappedImages, scale: float) -> list[str]:
    metric = first.manifest.frame.metric, second.manifest.frame.metric
    if all(metric) and abs(math.log(scale)) > _SAME_SCALE:
        return [
            f'both maps say they are metric, but a metre of {second.path} is {scale:.3f} m of '
            f'{first.path}: one of them is wrong; the scale of the first was kept'
        ]
    if metric == (False, True):
        return [
            f'{second.path} is metric and {first.path} is not; the frame of the first was kept: '
            f'give them in the other order, or align the result'
        ]
    return []
