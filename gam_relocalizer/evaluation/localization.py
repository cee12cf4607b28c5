# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""How well images with a known pose are localized, by each way to choose scenes and to match.

Section 'Visual Localization' of the paper, Table II: first the matchers, each on the best scene
alone, then the ways to make scenes, with one matcher.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.cameras import undistort
from gam_relocalizer.evaluation.calibration import calibrate, precision_recall
from gam_relocalizer.evaluation.metrics import CORRECT, accuracy
from gam_relocalizer.evaluation.query_set import read_query
from gam_relocalizer.geometry import pose_error
from gam_relocalizer.localization.localizer import Localizer, LocalizerOptions
from gam_relocalizer.localization.pictures import Foremost, Illustration
from gam_relocalizer.localization.result import Status
from gam_relocalizer.localization.retrieval import retrieve
from gam_relocalizer.localization.scenes import Coarse
from gam_relocalizer.mapping.progress import ignore_progress

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.evaluation.calibration import Calibration, PrecisionRecall
    from gam_relocalizer.evaluation.metrics import Accuracy
    from gam_relocalizer.evaluation.query_set import QuerySet
    from gam_relocalizer.features.global_descriptor import GlobalDescriptor
    from gam_relocalizer.features.local import LocalExtractor
    from gam_relocalizer.geometry import PoseError
    from gam_relocalizer.localization.result import LocalizationResult
    from gam_relocalizer.mapping.progress import Progress
    from gam_relocalizer.matching.matcher import Matcher
    from gam_relocalizer.scene_map import SceneMap

RANKS = (1, 5, 10, 20)
"""Recall of retrieval is measured among the best so many images."""

# A reference image sees what the query sees when so many of its points, and such a share of them,
# are in the query's view, from directions that differ by at most so much. Beyond that angle local
# features hardly match, and with a wide one most images of a room are covisible.
COVISIBLE_POINTS = 30
COVISIBLE_SHARE = 0.2
COVISIBLE_ANGLE_DEG = 30.0

# So many poses are kept to be drawn.
WORST_SHOWN = 4

# A point that the camera model folds back into the image has another ray than its pixel.
_SAME_RAY = 1e-2


@dataclass(frozen=True)
class Method:
    """A row of the table.

    Attributes:
        name: That of the paper for the way to choose scenes.
        matcher: Name of the matcher.
        coarse: How retrieved images become scenes.
        max_scenes: Scenes tried before giving up.
    """

    name: str
    matcher: str
    coarse: Coarse
    max_scenes: int


@dataclass(frozen=True)
class Outcome:
    """What a method made of a query.

    Attributes:
        status: The verdict.
        error: Of the best pose found, accepted or not [unit of the truth]; None without a pose or
            without a truth.
        confidence: In that pose.
        milliseconds: For matching and pose, over all scenes tried.
        camera_from_world: The best pose found, in the world of the truth; None without one.
    """

    status: Status
    error: PoseError | None
    confidence: float
    milliseconds: float
    camera_from_world: pycolmap.Rigid3d | None


@dataclass(frozen=True)
class MethodScore:
    """What a method achieved on a set of queries.

    Attributes:
        found: Errors of all poses found, whatever the verdict: the paper's numbers.
        accepted: Errors of the accepted poses; a rejected one counts as none.
        worst_position: The greatest error of an accepted pose; NaN without any.
        worst_rotation_deg: The greatest error of an accepted pose; NaN without any.
        milliseconds: Median over the queries, for matching and pose.
    """

    found: Accuracy
    accepted: Accuracy
    worst_position: float
    worst_rotation_deg: float
    milliseconds: float


@dataclass(frozen=True)
class Tally:
    """What a method found, whether or not anybody knows the truth.

    Attributes:
        queries: All of them.
        found: Those with a pose, whatever the verdict.
        accepted: Those with an accepted pose.
        milliseconds: Median over the queries, for matching and pose.
    """

    queries: int
    found: int
    accepted: int
    milliseconds: float


@dataclass(frozen=True)
class RetrievalScore:
    """How well retrieval finds reference images that see what the query sees.

    Attributes:
        queries: Queries that any reference image is covisible with; the others count nowhere.
        covisible: Mean share of the reference images that are: what a random image would score.
        recall: [R] share of the queries with a covisible image among the best 1, 2, ..., R.
    """

    queries: int
    covisible: float
    recall: tuple[float, ...]


@dataclass(frozen=True)
class Sights:
    """What pictures of an evaluation show beyond its numbers.

    Attributes:
        scene_map: The map.
        positions: [3] true positions of the cameras in the frame of the map, by name of image.
        worst: By name of image, the few poses of the last method with the largest errors, or
            without truth the fewest inliers.
    """

    scene_map: SceneMap
    positions: Mapping[str, NDArray[np.float64]]
    worst: Mapping[str, Illustration]


@dataclass(frozen=True)
class SetEvaluation:
    """All methods on one set of queries.

    Attributes:
        name: Name of the map's folder.
        map_id: Which map exactly.
        metric: Whether the unit of the map is a metre.
        global_descriptor: Name of what retrieves.
        aligned: See `QuerySet`.
        queries: Number of queries.
        images_without_truth: Number of images left out.
        retrieval: Of the reference images; None when no truth is known.
        outcomes: By method and name of image.
        others: Errors of the poses that other localizers found, by name of the localizer and of
            the image; an image without such a pose is not there.
        sights: For pictures; None when there are to be none.
    """

    name: str
    map_id: str
    metric: bool
    global_descriptor: str
    aligned: bool
    queries: int
    images_without_truth: int
    retrieval: RetrievalScore | None
    outcomes: Mapping[Method, Mapping[str, Outcome]]
    others: Mapping[str, Mapping[str, PoseError]]
    sights: Sights | None = None

    @property
    def has_truth(self) -> bool:
        """Whether the true poses of the queries are known."""
        return self.retrieval is not None


def methods_of(matchers: Sequence[str]) -> tuple[Method, ...]:
    """The rows of the paper's table: SR1 with every matcher; IR, CC and SR with the last one."""
    scenes, last = LocalizerOptions().max_scenes, matchers[-1]
    return (
        *(Method('SR1', matcher, Coarse.EXPANDED, max_scenes=1) for matcher in matchers),
        Method('IR', last, Coarse.TOGETHER, scenes),
        Method('CC', last, Coarse.CLUSTERS, scenes),
        Method('SR', last, Coarse.EXPANDED, scenes),
    )


def evaluate_set(
    query_set: QuerySet,
    extractor: LocalExtractor,
    describer: GlobalDescriptor,
    matchers: Mapping[str, Matcher],
    retrieved_images: int,
    progress: Progress = ignore_progress,
    others: Mapping[str, Mapping[str, pycolmap.Rigid3d]] | None = None,
) -> SetEvaluation:
    """Localizes every query by every method; it is described once.

    Args:
        query_set: The queries.
        extractor: That of the map.
        describer: That of the map.
        matchers: By name; see `methods_of` for what their order means.
        retrieved_images: R of the paper.
        progress: Told of the step localize.
        others: camera_from_world of queries, by name of the localizer that found them and of the
            image; scored against the truth.

    Raises:
        MapError: The map was made with another local or global descriptor.
        ImageError: An image cannot be read.
        CameraError: An image has another size than the camera.
    """
    scene_map = query_set.scene_map
    localizers = {
        method: Localizer(
            scene_map,
            extractor,
            matchers[method.matcher],
            LocalizerOptions(
                retrieved_images=retrieved_images,
                max_scenes=method.max_scenes,
                coarse=method.coarse,
            ),
            describer,
        )
        for method in methods_of(tuple(matchers))
    }
    truth, map_from_world = query_set.truth, query_set.world_from_map.inverse()
    outcomes: dict[Method, dict[str, Outcome]] = {method: {} for method in localizers}
    *_, whole = localizers
    found, covisible = [], []
    positions: dict[str, NDArray[np.float64]] = {}
    worst = Foremost[tuple[str, Illustration]](WORST_SHOWN)
    for done, name in enumerate(query_set.names, start=1):
        image, camera = read_query(query_set, name), query_set.cameras[name]
        features = extractor.extract(image)
        described = describer.describe(image, features)
        for method, localizer in localizers.items():
            result = localizer.localize_features(features, described, camera)
            outcome = _outcome(result, truth.get(name), query_set.world_from_map)
            outcomes[method][name] = outcome
            if method == whole and result.estimate is not None:
                illustration = Illustration(image, camera, result.estimate)
                worst.consider((name, illustration), _badness(outcome, result))
        if name in truth:
            found.append(retrieve(described, scene_map, RANKS[-1]).images)
            camera_from_map = map_from_world.transform_camera_world(truth[name])
            covisible.append(covisible_images(scene_map, camera_from_map, camera))
            positions[name] = camera_from_map.tgt_origin_in_src()
        progress('localize', done, len(query_set.names))
    return SetEvaluation(
        name=scene_map.path.resolve().name,
        map_id=scene_map.manifest.map_id,
        metric=scene_map.manifest.frame.metric,
        global_descriptor=scene_map.manifest.retrieval,
        aligned=query_set.aligned,
        queries=len(query_set.names),
        images_without_truth=query_set.images_without_truth,
        retrieval=score_retrieval(found, covisible) if truth else None,
        outcomes=outcomes,
        others={
            localizer: {
                name: pose_error(pose, truth[name]) for name, pose in poses.items() if name in truth
            }
            for localizer, poses in (others or {}).items()
        },
        sights=Sights(scene_map, positions, dict(worst.items)),
    )


def covisible_images(
    scene_map: SceneMap, camera_from_map: pycolmap.Rigid3d, camera: pycolmap.Camera
) -> NDArray[np.bool_]:
    """Which reference images see what a camera sees, by the truth.

    A point that a reference image observes is seen when it lies in the camera's image and is looked
    at from directions that differ by at most `COVISIBLE_ANGLE_DEG`. An image is covisible with at
    least `COVISIBLE_POINTS` seen points that are at least `COVISIBLE_SHARE` of all it observes.
    What stands in between is not known, and not asked for.

    Args:
        scene_map: The map, of I images.
        camera_from_map: True pose of the camera.
        camera: Its intrinsics.

    Returns:
        [I] bool.
    """
    positions, (_, observations) = scene_map.points, scene_map.observations()
    observed = scene_map.num_points_seen
    candidates = _in_view(camera_from_map * positions, camera)[observations]
    points = positions[observations[candidates]]
    image_of = np.repeat(np.arange(scene_map.num_images), observed)[candidates]
    from_reference = points - scene_map.camera_positions[image_of]
    from_camera = points - camera_from_map.tgt_origin_in_src()
    cosines = np.einsum('nk,nk->n', from_reference, from_camera) / (
        np.linalg.norm(from_reference, axis=1) * np.linalg.norm(from_camera, axis=1)
    )
    alike = cosines >= np.cos(np.radians(COVISIBLE_ANGLE_DEG))
    seen = np.bincount(image_of[alike], minlength=scene_map.num_images)
    enough: NDArray[np.bool_] = seen >= np.maximum(COVISIBLE_POINTS, COVISIBLE_SHARE * observed)
    return enough


def score_retrieval(
    found: Sequence[NDArray[np.int64]], covisible: Sequence[NDArray[np.bool_]]
) -> RetrievalScore:
    """Recall over the number of retrieved images.

    Args:
        found: Per query the indices of the retrieved images, best first, at most `RANKS[-1]`.
        covisible: Per query [I], which reference images should be found.
    """
    answerable = [index for index, which in enumerate(covisible) if which.any()]
    hits = np.zeros((len(answerable), RANKS[-1]), bool)
    for row, index in enumerate(answerable):
        hits[row, np.flatnonzero(covisible[index][found[index]])[:1].tolist()] = True
    counts = np.maximum.accumulate(hits, axis=1).sum(axis=0)
    share = [float(covisible[index].mean()) for index in answerable]
    return RetrievalScore(
        queries=len(answerable),
        covisible=float(np.mean(share)) if share else np.nan,
        recall=tuple(float(count) / len(answerable) if share else np.nan for count in counts),
    )


def summarise(outcomes: Iterable[Outcome]) -> MethodScore:
    """Recall and medians of a method over at least one query."""
    every = list(outcomes)
    found = [one.error for one in every if one.error is not None]
    accepted = [
        one.error for one in every if one.error is not None and one.status is Status.ACCEPTED
    ]
    return MethodScore(
        found=accuracy(found, len(every)),
        accepted=accuracy(accepted, len(every)),
        worst_position=max((error.position for error in accepted), default=np.nan),
        worst_rotation_deg=max((error.rotation_deg for error in accepted), default=np.nan),
        milliseconds=float(np.median([one.milliseconds for one in every])),
    )


def tally(outcomes: Iterable[Outcome]) -> Tally:
    """Counts what a method found in at least one query."""
    every = list(outcomes)
    return Tally(
        queries=len(every),
        found=sum(one.camera_from_world is not None for one in every),
        accepted=sum(one.status is Status.ACCEPTED for one in every),
        milliseconds=float(np.median([one.milliseconds for one in every])),
    )


def calibration_of(outcomes: Iterable[Outcome]) -> tuple[Calibration, PrecisionRecall]:
    """Reliability, and precision and recall, of the confidence in the poses that were found."""
    every = list(outcomes)
    posed = [(one.confidence, one.error) for one in every if one.error is not None]
    confidence = [confidence for confidence, _ in posed]
    correct = [CORRECT.admits(error) for _, error in posed]
    return calibrate(confidence, correct), precision_recall(confidence, correct, len(every))


def _outcome(
    result: LocalizationResult, truth: pycolmap.Rigid3d | None, world_from_map: pycolmap.Sim3d
) -> Outcome:
    pose = error = None
    if result.estimate is not None:
        pose = world_from_map.transform_camera_world(result.estimate.camera_from_map)
        error = None if truth is None else pose_error(pose, truth)
    milliseconds = result.timings.matching + result.timings.pose
    return Outcome(result.status, error, result.confidence, milliseconds, pose)


def _badness(outcome: Outcome, result: LocalizationResult) -> float:
    return -result.inliers if outcome.error is None else outcome.error.position


def _in_view(in_camera: NDArray[np.float64], camera: pycolmap.Camera) -> NDArray[np.bool_]:
    """Which points [N,3], in the camera's frame, lie in its image."""
    pixels = np.asarray(camera.img_from_cam(in_camera)).reshape(-1, 2)  # NaN behind the camera
    size = [camera.width, camera.height]
    inside = np.flatnonzero(((pixels >= 0) & (pixels <= size)).all(axis=1))
    on_plane = in_camera[inside, :2] / in_camera[inside, 2:]
    unfolded = np.linalg.norm(undistort(pixels[inside], camera) - on_plane, axis=1) < _SAME_RAY
    in_view = np.zeros(len(in_camera), bool)
    in_view[inside[unfolded]] = True
    return in_view
