# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""How well matchers find the tracks of a map: every reference image against the map without it.

Section '2D-3D Matching' of the paper: the tracks tell the true correspondences of an image, and
its pose in the map is the truth for the pose that the matches lead to.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.errors import MapError
from gam_relocalizer.geometry import PoseError, pose_error
from gam_relocalizer.localization.pose import estimate_pose, reprojection_errors
from gam_relocalizer.mapping.colmap_model import NO_POINT
from gam_relocalizer.mapping.leave_one_out import leave_out
from gam_relocalizer.mapping.progress import ignore_progress
from gam_relocalizer.matching.bmnet import normalise_keypoints, normalised_focal_length
from gam_relocalizer.matching.candidates import knn_ratio
from gam_relocalizer.matching.gam import NEIGHBOURS, RATIO
from gam_relocalizer.matching.matcher import Matches, MatchInput

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.mapping.leave_one_out import ReferenceImages
    from gam_relocalizer.mapping.progress import Progress
    from gam_relocalizer.matching.matcher import Matcher

# A match is right in the image within 8 px where the longer side has 640.
GEOMETRIC_THRESHOLD = 1.0 / 80.0
PER_MILLE = 1000.0
TRUE_CANDIDATES = '(true candidates)'
"""Name of the bound: all kNN ratio candidates that are correspondences of the tracks."""
NO_POSE = PoseError(math.inf, math.inf)


@dataclass(frozen=True)
class EvaluationOptions:
    """What of a map is evaluated.

    Attributes:
        keypoints: The best so many keypoints of an image; all without a number.
        every: Every so many-th reference image is a query.
    """

    keypoints: int | None = None
    every: int = 1


@dataclass(frozen=True)
class Query:
    """A reference image to match with the map without it.

    Attributes:
        camera: Intrinsics.
        camera_from_map: The truth.
        keypoints: [M,2] pixels, COLMAP convention.
        descriptors: [M,D] of the keypoints.
        points: [N,3] map frame.
        points_in_reference: [N,3] the same in the frame of the image that retrieval finds.
        point_descriptors: [N,D] of the points.
        true_rows: [M] row of the point that a keypoint observes, or `NO_POINT`.
    """

    camera: pycolmap.Camera
    camera_from_map: pycolmap.Rigid3d
    keypoints: NDArray[np.float32]
    descriptors: NDArray[np.float32]
    points: NDArray[np.float64]
    points_in_reference: NDArray[np.float64]
    point_descriptors: NDArray[np.float32]
    true_rows: NDArray[np.int64]

    @property
    def num_true(self) -> int:
        """Number of keypoints with a true correspondence."""
        return int(np.count_nonzero(self.true_rows != NO_POINT))

    @property
    def depth(self) -> float:
        """Median depth of the points that the image observes [unit of the map]."""
        observed = self.points[self.true_rows[self.true_rows != NO_POINT]]
        return float(np.median((self.camera_from_map * observed)[:, 2]))


@dataclass(frozen=True)
class ImageScore:
    """What a matcher achieved on one image.

    Attributes:
        matches: Number of matches.
        precision: Share of the matches that are correspondences of the tracks; 0 without matches.
        recall: Share of the correspondences of the tracks that are among the matches.
        geometric_precision: Share of the matches that reproject near the keypoint; 0 without any.
        geometric_recall: Share of the keypoints with a true correspondence that have such a match.
        position: Error of the pose from the matches [unit of the map]; infinite without a pose.
        position_permille: The same in per mille of the median depth of the points in the image.
        rotation_deg: Error of the pose from the matches; infinite without a pose.
    """

    matches: int
    precision: float
    recall: float
    geometric_precision: float
    geometric_recall: float
    position: float
    position_permille: float
    rotation_deg: float


@dataclass(frozen=True)
class Score:
    """What a matcher achieved on a map, or on the mean over maps.

    Attributes:
        precision: Mean share over the images.
        recall: Mean share over the images.
        geometric_precision: Mean share over the images.
        geometric_recall: Mean share over the images.
        matches: Mean number over the images.
        poses: Share of the images for which a pose was found.
        position_permille: Median over the images; infinite if most have no pose.
        rotation_deg: Median over the images; infinite if most have no pose.
    """

    precision: float
    recall: float
    geometric_precision: float
    geometric_recall: float
    matches: float
    poses: float
    position_permille: float
    rotation_deg: float


@dataclass(frozen=True)
class MapScore(Score):
    """A score on one map.

    Attributes:
        position: Median over the images [unit of the map]; infinite if most have no pose.
    """

    position: float


@dataclass(frozen=True)
class MapEvaluation:
    """All matchers on one map.

    Attributes:
        name: Name of the map's folder.
        map_id: Which map exactly.
        metric: Whether the unit of the map is a metre.
        images: Number of images the scores are taken over.
        images_without_truth: Number of images left out, for none of their keypoints is a point that
            another image sees.
        scores: By the name of the matcher, and of `TRUE_CANDIDATES`.
    """

    name: str
    map_id: str
    metric: bool
    images: int
    images_without_truth: int
    scores: Mapping[str, MapScore]


def evaluate_map(
    references: ReferenceImages,
    matchers: Mapping[str, Matcher],
    options: EvaluationOptions | None = None,
    progress: Progress = ignore_progress,
) -> MapEvaluation:
    """Leaves every image out in turn and matches it with the rest.

    Args:
        references: The reference images of a map.
        matchers: By name.
        options: What is evaluated.
        progress: Told of the step match.

    Raises:
        MapError: No image has a true correspondence.
    """
    options = options or EvaluationOptions()
    scene_map = references.scene_map
    images = range(0, scene_map.num_images, options.every)
    scores: dict[str, list[ImageScore]] = {name: [] for name in (*matchers, TRUE_CANDIDATES)}
    without_truth = 0
    for done, image in enumerate(images, start=1):
        query = query_of(references, image, options.keypoints)
        without_truth += not query.num_true
        if query.num_true:
            for name, matcher in matchers.items():
                scores[name].append(score_matches(query, match(query, matcher)))
            scores[TRUE_CANDIDATES].append(score_matches(query, true_candidates(query)))
        progress('match', done, len(images))
    if without_truth == len(images):
        msg = (
            f'{scene_map.path}: there is nothing to evaluate: none of {len(images)} images '
            f'observes a point that another image observes too'
        )
        raise MapError(msg)
    return MapEvaluation(
        name=scene_map.path.resolve().name,
        map_id=scene_map.manifest.map_id,
        metric=scene_map.manifest.frame.metric,
        images=len(images) - without_truth,
        images_without_truth=without_truth,
        scores={name: summarise(of_matcher) for name, of_matcher in scores.items()},
    )


def mean_over_maps(evaluations: Sequence[MapEvaluation]) -> dict[str, Score]:
    """The mean of every number over at least one map, each map counting the same."""
    return {
        name: Score(
            **{
                field.name: float(
                    np.mean([getattr(one.scores[name], field.name) for one in evaluations])
                )
                for field in fields(Score)
            }
        )
        for name in evaluations[0].scores
    }


def query_of(references: ReferenceImages, image: int, keypoints: int | None = None) -> Query:
    """An image, with its best so many keypoints, and what the map is without it."""
    scene_map, described = references.scene_map, references.images[image]
    view = leave_out(references, image)
    points = scene_map.positions_of(view.points)
    return Query(
        camera=described.camera,
        camera_from_map=scene_map.camera_from_map[image],
        keypoints=described.keypoints[:keypoints],
        descriptors=described.descriptors[:keypoints],
        points=points,
        points_in_reference=scene_map.camera_from_map[view.reference] * points,
        point_descriptors=view.point_descriptors,
        true_rows=view.true_rows[:keypoints],
    )


def match(query: Query, matcher: Matcher) -> Matches:
    """The matches of an image."""
    return matcher.match(
        MatchInput(
            keypoints=normalise_keypoints(query.keypoints, query.camera),
            focal_length=normalised_focal_length(query.camera),
            descriptors=query.descriptors,
            points=query.points_in_reference,
            point_descriptors=query.point_descriptors,
        )
    )


def true_candidates(query: Query) -> Matches:
    """What a matcher that knows the tracks would keep of the kNN ratio candidates."""
    edges = knn_ratio(query.descriptors, query.point_descriptors, NEIGHBOURS, RATIO).edges
    true = edges[query.true_rows[edges[:, 0]] == edges[:, 1]]
    weights, nearest = np.ones(len(true), np.float32), np.ones(len(true), np.bool_)
    return Matches(true[:, 0], true[:, 1], weights, nearest)


def score_matches(query: Query, matches: Matches) -> ImageScore:
    """Compares matches, possibly several per keypoint, with the truth.

    Args:
        query: An image with at least one true correspondence.
        matches: Of its keypoints with its points.
    """
    keypoints = query.keypoints[matches.keypoint_indices].astype(np.float64)
    points = query.points[matches.point_indices]
    is_true = query.true_rows[matches.keypoint_indices] == matches.point_indices
    errors = reprojection_errors(query.camera_from_map, keypoints, points, query.camera)
    is_near = errors <= GEOMETRIC_THRESHOLD * max(query.camera.width, query.camera.height)
    has_truth = query.true_rows[matches.keypoint_indices] != NO_POINT
    found = np.unique(matches.keypoint_indices[is_true])
    near = np.unique(matches.keypoint_indices[has_truth & (is_true | is_near)])
    pose = estimate_pose(keypoints, points, matches.weights, query.camera, nearest=matches.nearest)
    error = NO_POSE if pose is None else pose_error(pose.camera_from_map, query.camera_from_map)
    return ImageScore(
        matches=len(matches),
        precision=_share(is_true),
        recall=len(found) / query.num_true,
        geometric_precision=_share(is_near),
        geometric_recall=len(near) / query.num_true,
        position=error.position,
        position_permille=PER_MILLE * error.position / query.depth,
        rotation_deg=error.rotation_deg,
    )


def summarise(scores: Sequence[ImageScore]) -> MapScore:
    """Means and medians over at least one image."""
    return MapScore(
        precision=float(np.mean([score.precision for score in scores])),
        recall=float(np.mean([score.recall for score in scores])),
        geometric_precision=float(np.mean([score.geometric_precision for score in scores])),
        geometric_recall=float(np.mean([score.geometric_recall for score in scores])),
        matches=float(np.mean([score.matches for score in scores])),
        poses=float(np.mean([math.isfinite(score.position) for score in scores])),
        position=float(np.median([score.position for score in scores])),
        position_permille=float(np.median([score.position_permille for score in scores])),
        rotation_deg=float(np.median([score.rotation_deg for score in scores])),
    )


def _share(which: NDArray[np.bool_]) -> float:
    return float(which.mean()) if len(which) else 0.0
