# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The whole query: from an image to a pose in the map, or a reason why not."""

from __future__ import annotations

import time
from collections import defaultdict
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.cameras import have_known_rays
from gam_relocalizer.errors import MapError
from gam_relocalizer.features.registry import (
    DEFAULT_MAX_KEYPOINTS,
    EXTRACTOR_NAMES,
    create_extractor,
    global_descriptor_of,
)
from gam_relocalizer.features.vlad import Vlad
from gam_relocalizer.localization.confidence import (
    Evidence,
    belief_as_expected,
    belief_in,
    nearness,
    scaled_residual,
)
from gam_relocalizer.localization.covariance import point_covariances
from gam_relocalizer.localization.focal_length import focal_length_of
from gam_relocalizer.localization.look_alikes import look_alike_of, points_around
from gam_relocalizer.localization.pose import MIN_MATCHES, PoseOptions, estimate_pose
from gam_relocalizer.localization.prior import Prior, tilt_deg
from gam_relocalizer.localization.result import (
    LocalizationResult,
    PoseEstimate,
    Status,
    Timings,
)
from gam_relocalizer.localization.retrieval import retrieve
from gam_relocalizer.localization.scenes import Coarse, distinct, orientation_kept
from gam_relocalizer.localization.search import candidates, search
from gam_relocalizer.localization.sharpening import sharpened
from gam_relocalizer.localization.support import support_of
from gam_relocalizer.localization.verdict import (
    VerdictOptions,
    coverage_of,
    judge,
    judge_focal_length,
    judge_look_alike,
    judge_mirrored,
    judge_rival,
    judge_tilt,
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

    from gam_relocalizer.features.global_descriptor import GlobalDescriptor
    from gam_relocalizer.features.local import LocalExtractor, LocalFeatures
    from gam_relocalizer.localization.look_alikes import LookAlike
    from gam_relocalizer.localization.pose import AbsolutePose
    from gam_relocalizer.localization.scenes import Scene
    from gam_relocalizer.localization.search import Candidate
    from gam_relocalizer.localization.verdict import Verdict
    from gam_relocalizer.matching.matcher import Matcher, Matches
    from gam_relocalizer.scene_map import SceneMap


@dataclass(frozen=True)
class LocalizerOptions:
    """How a query is run.

    Attributes:
        retrieved_images: Reference images retrieved (R in the paper).
        scene_images: Images in an expanded scene (m in the paper).
        max_scenes: Scenes tried before giving up; as many before them near a hint.
        coarse: How retrieved images become scenes.
        enough_inliers: An accepted pose with so many inliers ends the search (early stop), but for
            scenes that look as alike.
        max_keypoints: Local features taken from the image, when the localizer is loaded.
        matcher: One of `MATCHER_NAMES`, when the localizer is loaded.
        weights: Of a learned matcher instead of the shipped ones, when the localizer is loaded.
        global_weights: Of the map's global descriptor, when it has any and the localizer is loaded.
        pose: How poses are searched.
        verdict: What a pose must show.
    """

    retrieved_images: int = 10
    scene_images: int = 20
    max_scenes: int = 5
    coarse: Coarse = Coarse.EXPANDED
    enough_inliers: int = 200
    max_keypoints: int = DEFAULT_MAX_KEYPOINTS
    matcher: str = DEFAULT_MATCHER
    weights: Path | None = None
    global_weights: Path | None = None
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
        describer: GlobalDescriptor | None = None,
    ) -> None:
        """Puts the parts together; without a `describer` images are retrieved by the map's VLAD.

        Raises:
            MapError: The map was made with another local or global descriptor.
        """
        self._describer = describer or Vlad(scene_map.codebook)
        _check_identity(scene_map, extractor, self._describer)
        self._scene_map = scene_map
        self._extractor = extractor
        self._matcher = matcher
        self._options = options or LocalizerOptions()

    @classmethod
    def load(cls, map_path: Path, options: LocalizerOptions | None = None) -> Localizer:
        """Loads a map, the descriptors that it names and the matcher that the options name.

        Raises:
            MapError: The map is damaged, or made with descriptors or weights that are not here.
            UsageError: The matcher is unknown, or weights are given to what has none.
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
        describer = global_descriptor_of(scene_map, options.global_weights)
        return cls(scene_map, extractor, matcher, options, describer)

    @property
    def scene_map(self) -> SceneMap:
        """The map."""
        return self._scene_map

    def with_options(self, options: LocalizerOptions) -> Localizer:
        """The same map and networks under other options; what was for loading changes nothing."""
        return Localizer(self._scene_map, self._extractor, self._matcher, options, self._describer)

    def localize(
        self, image: NDArray[np.uint8], camera: pycolmap.Camera, prior: Prior | None = None
    ) -> LocalizationResult:
        """Finds the pose of the camera that took an image.

        Args:
            image: RGB [H,W,3] or grey [H,W].
            camera: Its intrinsics and distortion; the image is used as it is, never resampled.
            prior: What else is known about the camera's pose.

        Returns:
            Always a result; look at `accepted` before acting on its estimate.
        """
        if unusable := _unusable(image, camera):
            return unusable
        clock = _Clock()
        with clock.stage('extraction'):
            features = self._extractor.extract(image)
        with clock.stage('retrieval'):
            described = self._describer.describe(image, features)
        query = _Query(_seen_by(camera, features), described, camera, prior or Prior(), clock)
        result = self._localize_query(query)
        if not result.accepted:
            return result
        with clock.stage('verdict'):
            verdict = self._judge_mirrored(image, described)
        if verdict is not None:
            result = result.judged(verdict.status, verdict.reason)
        return replace(result, timings=clock.timings())

    def localize_features(
        self,
        features: LocalFeatures,
        described: NDArray[np.float32],
        camera: pycolmap.Camera,
    ) -> LocalizationResult:
        """The same for an image whose local features and global descriptor are known already.

        Without the image itself nothing can tell whether it is mirrored.
        """
        return self._localize_query(_Query(_seen_by(camera, features), described, camera))

    def attempts(
        self,
        features: LocalFeatures,
        described: NDArray[np.float32],
        camera: pycolmap.Camera,
    ) -> list[LocalizationResult]:
        """One result for every scene tried, not yet held against each other, nor sharpened."""
        return self._attempts(_Query(_seen_by(camera, features), described, camera))

    def _judge_mirrored(
        self, image: NDArray[np.uint8], described: NDArray[np.float32]
    ) -> Verdict | None:
        """Rejects an image that looks much more like the map when it is mirrored.

        A facade that is symmetric fits its mirror image to the pixel, with hundreds of inliers.
        """
        mirrored = np.ascontiguousarray(image[:, ::-1])
        as_mirrored = self._describer.describe(mirrored, self._extractor.extract(mirrored))
        likeness, mirrored_likeness = (
            float(np.max(self._scene_map.likeness(each))) for each in (described, as_mirrored)
        )
        return judge_mirrored(likeness, mirrored_likeness)

    def _localize_query(self, query: _Query) -> LocalizationResult:
        result = self._best_of_scenes(query)
        return replace(result, keypoints=len(query.features), timings=query.clock.timings())

    def _best_of_scenes(self, query: _Query) -> LocalizationResult:
        needed = self._options.verdict.min_inliers
        if len(query.features) < needed:
            return LocalizationResult(
                Status.TOO_FEW_FEATURES,
                f'{len(query.features)} local features in the image, needs {needed}; it may be '
                f'black, blurred or without texture',
            )
        attempts = self._attempts(query)
        if not attempts:
            return LocalizationResult(
                Status.NO_SCENE,
                f'no reference image was retrieved; the map has {self._scene_map.num_images}',
            )
        best = replace(self._uncontested(attempts), scenes_tried=len(attempts))
        if best.estimate is None:
            return best
        with query.clock.stage('pose'):
            return replace(best, estimate=self._sharpened(best.estimate, best.scene, query))

    def _attempts(self, query: _Query) -> list[LocalizationResult]:
        ordered = candidates(query.described, self._scene_map, self._options, query.prior.hint)
        return search(
            _timed(ordered, query.clock),
            lambda scene: self._localize_in(scene, query),
            self._options.enough_inliers,
        )

    def _uncontested(self, attempts: Sequence[LocalizationResult]) -> LocalizationResult:
        """The best attempt; rejected when another scene speaks nearly as loud for another pose."""
        best = max(attempts, key=_rank)
        if not best.accepted or best.estimate is None:
            return best
        points = self._scene_map.positions_of(best.estimate.inlier_points)
        for attempt in attempts:
            if attempt is best or attempt.estimate is None:
                continue
            verdict = judge_rival(best.estimate, attempt.estimate, points, self._options.verdict)
            if verdict is not None:
                return best.judged(verdict.status, verdict.reason)
        return best

    def _sharpened(self, estimate: PoseEstimate, scene: str, query: _Query) -> PoseEstimate:
        """The same with a pose that more matches speak for; what was judged stays as it is."""
        camera_from_map = sharpened(
            estimate.camera_from_map,
            estimate.covariance,
            query.features,
            query.camera,
            query.scenes[scene].points,
            self._scene_map,
        )
        return replace(estimate, camera_from_map=camera_from_map)

    def _localize_in(self, scene: Scene, query: _Query) -> LocalizationResult:
        with query.clock.stage('matching'):
            matches = self._match(scene, query)
        name = self._scene_map.image_names[scene.image]
        query.scenes[name] = scene
        result = LocalizationResult(
            Status.TOO_FEW_MATCHES,
            matches=len(distinct(matches.keypoint_indices)),
            scene=name,
        )
        needed = max(MIN_MATCHES, self._options.verdict.min_inliers)
        if result.matches < needed:
            reason = f'{result.matches} matches with the scene around `{name}`, needs {needed}'
            return replace(result, reason=reason)
        with query.clock.stage('pose'):
            pose = self._pose(matches, scene, query)
        if pose is None:
            reason = f'the {result.matches} matches with the scene around `{name}` fit no pose'
            return replace(result, status=Status.NO_POSE, reason=reason)
        with query.clock.stage('verdict'):
            estimate = self._estimate(pose, matches, scene, query)
            verdict = self._judge(estimate, scene, query)
            confidence = estimate.belief * nearness(estimate.covariance)
        found = replace(result, estimate=estimate, confidence=confidence)
        return found.judged(verdict.status, verdict.reason)

    def _judge(self, estimate: PoseEstimate, scene: Scene, query: _Query) -> Verdict:
        """The cheap checks first; the others only for a pose that would be accepted."""
        camera_from_map, gravity = estimate.camera_from_map, query.prior.gravity
        points = self._scene_map.positions_of(estimate.inlier_points)
        kept = orientation_kept(camera_from_map, estimate.inlier_points, scene, self._scene_map)
        verdict = judge(estimate, points, kept, self._options.verdict)
        if verdict.status is not Status.ACCEPTED:
            return verdict
        keypoints = estimate.inlier_keypoints.astype(np.float64)
        focal_length = focal_length_of(camera_from_map, keypoints, points, query.camera)
        look_alike = self._look_alike(estimate, query)
        return (
            judge_focal_length(focal_length)
            or (gravity and judge_tilt(tilt_deg(camera_from_map, gravity), gravity.tolerance_deg))
            or (look_alike and judge_look_alike(estimate, look_alike, points))
            or verdict
        )

    def _look_alike(self, estimate: PoseEstimate, query: _Query) -> LookAlike | None:
        """What looks the same in all that was retrieved, the scene itself included."""
        options = self._options
        alike = retrieve(query.described, self._scene_map, options.retrieved_images)
        around = points_around(alike.images.tolist(), self._scene_map, options.scene_images)
        return look_alike_of(
            estimate.camera_from_map,
            estimate.inlier_features,
            query.features,
            query.camera,
            around,
            self._scene_map,
            options.pose,
        )

    def _match(self, scene: Scene, query: _Query) -> Matches:
        # the matcher wants points as a camera near the query sees them
        reference_from_map = self._scene_map.camera_from_map[scene.image]
        given = MatchInput(
            keypoints=normalise_keypoints(query.features.keypoints, query.camera),
            focal_length=normalised_focal_length(query.camera),
            descriptors=query.features.descriptors,
            points=reference_from_map * self._scene_map.positions_of(scene.points),
            point_descriptors=self._scene_map.descriptors_of(scene.points),
        )
        return self._matcher.match(given)

    def _pose(self, matches: Matches, scene: Scene, query: _Query) -> AbsolutePose | None:
        """The pose of matches between features and points of a scene."""
        points = scene.points[matches.point_indices]
        return estimate_pose(
            query.features.keypoints[matches.keypoint_indices],
            self._scene_map.positions_of(points),
            matches.weights,
            query.camera,
            self._options.pose,
            matches.nearest,
            point_covariances(self._scene_map, points, scene.images),
        )

    def _estimate(
        self, pose: AbsolutePose, matches: Matches, scene: Scene, query: _Query
    ) -> PoseEstimate:
        """A pose of matches, and what speaks for it."""
        camera = query.camera
        features = matches.keypoint_indices[pose.inliers]
        keypoints = query.features.keypoints[features]
        points = scene.points[matches.point_indices[pose.inliers]]
        support = support_of(
            pose.camera_from_map, camera, keypoints, points, scene, self._scene_map
        )
        coverage = coverage_of(keypoints, camera)
        error = float(np.sqrt(np.mean(np.square(pose.errors[pose.inliers]))))
        residual = scaled_residual(error, max(camera.width, camera.height))
        belief = belief_in(Evidence(coverage, residual, support.unmatched))
        expectation = query.prior.expectation
        if expectation is not None and expectation.agrees_with(pose.camera_from_map):
            belief = belief_as_expected(belief)
        return PoseEstimate(
            camera_from_map=pose.camera_from_map,
            covariance=pose.covariance,
            inlier_keypoints=keypoints,
            inlier_features=features,
            inlier_points=points,
            inlier_ratio=len(points) / len(distinct(matches.keypoint_indices)),
            coverage=coverage,
            reprojection_error=error,
            support=support,
            belief=belief,
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


@dataclass(frozen=True)
class _Query:
    """An image as the search for its pose knows it, and the scenes tried, by their image."""

    features: LocalFeatures
    described: NDArray[np.float32]
    camera: pycolmap.Camera
    prior: Prior = field(default_factory=Prior)
    clock: _Clock = field(default_factory=_Clock)
    scenes: dict[str, Scene] = field(default_factory=dict)


def _timed(scenes: Iterator[Candidate], clock: _Clock) -> Iterator[Candidate]:
    """Scenes are computed when asked for: their time belongs to the retrieval."""
    while True:
        with clock.stage('retrieval'):
            scene = next(scenes, None)
        if scene is None:
            return
        yield scene


def _rank(result: LocalizationResult) -> tuple[bool, float, int]:
    """Accepted before rejected, then by belief, then by matches."""
    belief = 0.0 if result.estimate is None else result.estimate.belief
    return result.accepted, belief, result.matches


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
    known = have_known_rays(features.keypoints, camera)
    return replace(
        features,
        keypoints=features.keypoints[known],
        descriptors=features.descriptors[known],
        scores=features.scores[known],
    )


def _check_identity(
    scene_map: SceneMap, extractor: LocalExtractor, describer: GlobalDescriptor
) -> None:
    made_with, present = scene_map.manifest.extractor, extractor.identity
    if made_with != present:
        msg = (
            f'{scene_map.path}: made with {made_with}, here is {present}; descriptors of different '
            f'extractors cannot be compared: build the map again with this one'
        )
        raise MapError(msg)
    manifest = scene_map.manifest
    described_by = (
        manifest.retrieval,
        manifest.retrieval_weights_sha256,
        manifest.global_dimension,
    )
    here = describer.name, describer.weights_sha256, describer.dimension
    if described_by != here:
        msg = (
            f'{scene_map.path}: its global descriptors are {_in_words(*described_by)}, here is '
            f'{_in_words(*here)}; give the weights that the map was built with, or build it again'
        )
        raise MapError(msg)


def _in_words(name: str, weights_sha256: str, length: int) -> str:
    weights = f' with weights of sha256 {weights_sha256}' if weights_sha256 else ''
    return f'`{name}` of length {length}{weights}'
