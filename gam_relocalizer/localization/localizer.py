# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The whole query: from an image to a pose in the map, or a reason why not."""

from __future__ import annotations

import time
from collections import defaultdict
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.errors import MapError
from gam_relocalizer.features.registry import (
    DEFAULT_MAX_KEYPOINTS,
    EXTRACTOR_NAMES,
    create_extractor,
)
from gam_relocalizer.features.vlad import RETRIEVAL_NAME, Vlad
from gam_relocalizer.localization.pose import (
    MIN_MATCHES,
    PoseOptions,
    estimate_pose,
    undistort,
)
from gam_relocalizer.localization.result import (
    LocalizationResult,
    PoseEstimate,
    Status,
    Timings,
)
from gam_relocalizer.localization.retrieval import retrieve
from gam_relocalizer.localization.scenes import expanded_scenes, orientation_kept
from gam_relocalizer.localization.verdict import (
    VerdictOptions,
    coverage_of,
    judge,
    judge_rival,
)
from gam_relocalizer.matching.bmnet import normalise_keypoints, normalised_focal_length
from gam_relocalizer.matching.matcher import MatchInput
from gam_relocalizer.matching.registry import DEFAULT_MATCHER, create_matcher
from gam_relocalizer.scene_map import load_map

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.features.local import LocalExtractor, LocalFeatures
    from gam_relocalizer.localization.scenes import Scene
    from gam_relocalizer.localization.verdict import Verdict
    from gam_relocalizer.matching.matcher import Matcher, Matches
    from gam_relocalizer.scene_map import SceneMap

# A scene whose image looks this much as alike as the best one is tried even when a pose is found:
# it may be the same thing in another place.
COMPETING_SCORE = 0.95


@dataclass(frozen=True)
class LocalizerOptions:
    """How a query is run.

    Attributes:
        retrieved_images: Reference images retrieved (R in the paper).
        scene_images: Images in an expanded scene (m in the paper).
        max_scenes: Scenes tried before giving up.
        enough_inliers: An accepted pose with so many inliers ends the search (early stop), but for
            scenes that look as alike.
        max_keypoints: Local features taken from the image, when the localizer is loaded.
        matcher: One of `MATCHER_NAMES`, when the localizer is loaded.
        weights: Of a learned matcher instead of the shipped ones, when the localizer is loaded.
        pose: How poses are searched.
        verdict: What a pose must show.
    """

    retrieved_images: int = 10
    scene_images: int = 20
    max_scenes: int = 5
    enough_inliers: int = 200
    max_keypoints: int = DEFAULT_MAX_KEYPOINTS
    matcher: str = DEFAULT_MATCHER
    weights: Path | None = None
    pose: PoseOptions = field(default_factory=PoseOptions)
    verdict: VerdictOptions = field(default_factory=VerdictOptions)


class Localizer:
    """Localizes images in one map. Same image, same answer; not to be shared between threads."""

    def __init__(
        self,
        scene_map: SceneMap,
        extractor: LocalExtractor,
        matcher: Matcher,
        options: LocalizerOptions | None = None,
    ) -> None:
        """Puts the parts together.

        Raises:
            MapError: The map was made with another extractor or another retrieval.
        """
        _check_identity(scene_map, extractor)
        self._scene_map = scene_map
        self._extractor = extractor
        self._matcher = matcher
        self._options = options or LocalizerOptions()
        self._vlad = Vlad(scene_map.codebook)

    @classmethod
    def load(cls, map_path: Path, options: LocalizerOptions | None = None) -> Localizer:
        """Loads a map, the extractor that it names and the matcher that the options name.

        Raises:
            MapError: The map is damaged, or made with an extractor that is not available here.
            UsageError: The matcher is unknown, or weights are given to one that has none.
            WeightsError: Weights are missing, damaged, or made for other descriptors.
        """
        options = options or LocalizerOptions()
        scene_map = load_map(map_path)
        name = scene_map.manifest.extractor.name
        if name not in EXTRACTOR_NAMES:
            msg = (
                f'{map_path}: made with the extractor `{name}`, known are '
                f'{", ".join(EXTRACTOR_NAMES)}; build the map again with one of them'
            )
            raise MapError(msg)
        matcher = create_matcher(options.matcher, weights=options.weights, extractor=name)
        extractor = create_extractor(name, options.max_keypoints)
        return cls(scene_map, extractor, matcher, options)

    @property
    def scene_map(self) -> SceneMap:
        """The map."""
        return self._scene_map

    def with_options(self, options: LocalizerOptions) -> Localizer:
        """The same map and networks under other options; what was for loading changes nothing."""
        return Localizer(self._scene_map, self._extractor, self._matcher, options)

    def localize(self, image: NDArray[np.uint8], camera: pycolmap.Camera) -> LocalizationResult:
        """Finds the pose of the camera that took an image.

        Args:
            image: RGB [H,W,3] or grey [H,W].
            camera: Its intrinsics and distortion; the image is used as it is, never resampled.

        Returns:
            Always a result; look at `accepted` before acting on its estimate.
        """
        if unusable := _unusable(image, camera):
            return unusable
        clock = _Clock()
        with clock.stage('extraction'):
            features = _seen_by(camera, self._extractor.extract(image))
        result = self._localize_features(features, camera, clock)
        return replace(result, keypoints=len(features), timings=clock.timings())

    def _localize_features(
        self, features: LocalFeatures, camera: pycolmap.Camera, clock: _Clock
    ) -> LocalizationResult:
        needed = self._options.verdict.min_inliers
        if len(features) < needed:
            return LocalizationResult(
                Status.TOO_FEW_FEATURES,
                f'{len(features)} local features in the image, needs {needed}; it may be black, '
                f'blurred or without texture',
            )
        with clock.stage('retrieval'):
            retrieved = retrieve(
                self._vlad.describe(features.descriptors),
                self._scene_map,
                self._options.retrieved_images,
            )
        scenes = expanded_scenes(
            retrieved.images.tolist(), self._scene_map, self._options.scene_images
        )
        scores = dict(zip(retrieved.images.tolist(), retrieved.scores.tolist(), strict=True))
        attempts: list[LocalizationResult] = []
        for scene in islice(_timed(scenes, clock), self._options.max_scenes):
            competes = scores[scene.image] >= COMPETING_SCORE * max(scores.values())
            if self._is_settled(attempts) and not competes:
                break
            attempts.append(self._localize_in(scene, features, camera, clock))
        if not attempts:
            return LocalizationResult(
                Status.NO_SCENE,
                f'no reference image was retrieved; the map has {self._scene_map.num_images}',
            )
        return replace(self._uncontested(attempts), scenes_tried=len(attempts))

    def _is_settled(self, attempts: Sequence[LocalizationResult]) -> bool:
        return any(
            attempt.accepted and attempt.inliers >= self._options.enough_inliers
            for attempt in attempts
        )

    def _uncontested(self, attempts: Sequence[LocalizationResult]) -> LocalizationResult:
        """The best attempt; rejected when another scene speaks nearly as loud for another pose."""
        best = max(attempts, key=_rank)
        if not best.accepted or best.estimate is None:
            return best
        points = self._scene_map.points[best.estimate.inlier_points]
        for attempt in attempts:
            if attempt is best or attempt.estimate is None:
                continue
            verdict = judge_rival(best.estimate, attempt.estimate, points, self._options.verdict)
            if verdict is not None:
                return replace(best, status=verdict.status, reason=verdict.reason)
        return best

    def _localize_in(
        self, scene: Scene, features: LocalFeatures, camera: pycolmap.Camera, clock: _Clock
    ) -> LocalizationResult:
        with clock.stage('matching'):
            matches = self._match(scene, features, camera)
        name = self._scene_map.image_names[scene.image]
        result = LocalizationResult(
            Status.TOO_FEW_MATCHES, matches=len(matches.weights), scene=name
        )
        needed = max(MIN_MATCHES, self._options.verdict.min_inliers)
        if result.matches < needed:
            reason = f'{result.matches} matches with the scene around `{name}`, needs {needed}'
            return replace(result, reason=reason)
        with clock.stage('pose'):
            estimate = self._estimate(matches, features.keypoints, scene.points, camera)
        if estimate is None:
            reason = f'the {result.matches} matches with the scene around `{name}` fit no pose'
            return replace(result, status=Status.NO_POSE, reason=reason)
        verdict = self._judge(estimate, scene)
        return replace(result, status=verdict.status, reason=verdict.reason, estimate=estimate)

    def _judge(self, estimate: PoseEstimate, scene: Scene) -> Verdict:
        kept = orientation_kept(
            estimate.camera_from_map, estimate.inlier_points, scene, self._scene_map
        )
        points = self._scene_map.points[estimate.inlier_points]
        return judge(estimate, points, kept, self._options.verdict)

    def _match(self, scene: Scene, features: LocalFeatures, camera: pycolmap.Camera) -> Matches:
        # the matcher wants points as a camera near the query sees them
        reference_from_map = self._scene_map.camera_from_map[scene.image]
        given = MatchInput(
            keypoints=normalise_keypoints(features.keypoints, camera),
            focal_length=normalised_focal_length(camera),
            descriptors=features.descriptors,
            points=reference_from_map * self._scene_map.points[scene.points],
            point_descriptors=self._scene_map.descriptors[scene.points],
        )
        return self._matcher.match(given)

    def _estimate(
        self,
        matches: Matches,
        keypoints_in_image: NDArray[np.float32],
        points_in_scene: NDArray[np.int64],
        camera: pycolmap.Camera,
    ) -> PoseEstimate | None:
        """The pose of matches between keypoints and points, the latter as indices into the map."""
        keypoints = keypoints_in_image[matches.keypoint_indices]
        points = points_in_scene[matches.point_indices]
        pose = estimate_pose(
            keypoints,
            self._scene_map.points[points],
            matches.weights,
            camera,
            self._options.pose,
            matches.nearest,
        )
        if pose is None:
            return None
        inlier_keypoints = keypoints[pose.inliers]
        return PoseEstimate(
            camera_from_map=pose.camera_from_map,
            covariance=pose.covariance,
            inlier_keypoints=inlier_keypoints,
            inlier_points=points[pose.inliers],
            inlier_ratio=len(inlier_keypoints) / len(keypoints),
            coverage=coverage_of(inlier_keypoints, camera),
            reprojection_error=float(np.sqrt(np.mean(np.square(pose.errors[pose.inliers])))),
        )


class _Clock:
    """Adds up the milliseconds of each stage."""

    def __init__(self) -> None:
        self._milliseconds: defaultdict[str, float] = defaultdict(float)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        begin = time.perf_counter()
        try:
            yield
        finally:
            self._milliseconds[name] += 1e3 * (time.perf_counter() - begin)

    def timings(self) -> Timings:
        return Timings(**self._milliseconds)


def _timed(scenes: Iterator[Scene], clock: _Clock) -> Iterator[Scene]:
    """Scenes are computed when asked for: their time belongs to the retrieval."""
    while True:
        with clock.stage('retrieval'):
            scene = next(scenes, None)
        if scene is None:
            return
        yield scene


def _rank(result: LocalizationResult) -> tuple[bool, int, int]:
    """Accepted before rejected, then by inliers, then by matches."""
    return result.accepted, result.inliers, result.matches


def _unusable(image: NDArray[np.uint8], camera: pycolmap.Camera) -> LocalizationResult | None:
    grey_or_rgb = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
    if image.dtype != np.uint8 or not grey_or_rgb or not image.size:
        return LocalizationResult(
            Status.UNDECODABLE_IMAGE,
            f'expected a grey [H,W] or RGB [H,W,3] image of uint8, found {image.dtype} '
            f'{list(image.shape)}',
        )
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        return LocalizationResult(
            Status.NO_CALIBRATION,
            f'the image has {width} x {height} pixels, the camera is calibrated for '
            f'{camera.width} x {camera.height}',
        )
    return None


def _seen_by(camera: pycolmap.Camera, features: LocalFeatures) -> LocalFeatures:
    """Features whose viewing ray the camera model knows; a fisheye's corners may have none."""
    known = np.isfinite(undistort(features.keypoints, camera)).all(axis=1)
    return replace(
        features,
        keypoints=features.keypoints[known],
        descriptors=features.descriptors[known],
        scores=features.scores[known],
    )


def _check_identity(scene_map: SceneMap, extractor: LocalExtractor) -> None:
    made_with, present = scene_map.manifest.extractor, extractor.identity
    if made_with != present:
        msg = (
            f'{scene_map.path}: made with {made_with}, here is {present}; descriptors of different '
            f'extractors cannot be compared: build the map again with this one'
        )
        raise MapError(msg)
    codebook, described = scene_map.codebook, scene_map.global_descriptors
    if scene_map.manifest.retrieval != RETRIEVAL_NAME or codebook.size != described.shape[1]:
        msg = (
            f'{scene_map.path}: its global descriptors are `{scene_map.manifest.retrieval}` of '
            f'length {described.shape[1]}; expected `{RETRIEVAL_NAME}` of length {codebook.size}, '
            f'the size of its codebook'
        )
        raise MapError(msg)
