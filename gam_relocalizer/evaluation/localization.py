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
import pycolmap

from gam_relocalizer.cameras import parse_camera, undistort
from gam_relocalizer.errors import CameraError, MapError, UsageError
from gam_relocalizer.evaluation.calibration import calibrate, precision_recall
from gam_relocalizer.evaluation.metrics import CORRECT, accuracy
from gam_relocalizer.geometry import PoseError, pose_error, read_poses
from gam_relocalizer.images import list_images, read_image
from gam_relocalizer.localization.localizer import Localizer, LocalizerOptions
from gam_relocalizer.localization.result import Status
from gam_relocalizer.localization.retrieval import retrieve
from gam_relocalizer.localization.scenes import Coarse
from gam_relocalizer.mapping.progress import ignore_progress
from gam_relocalizer.scene_map import load_map

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from gam_relocalizer.evaluation.calibration import Calibration, PrecisionRecall
    from gam_relocalizer.evaluation.metrics import Accuracy
    from gam_relocalizer.features.global_descriptor import GlobalDescriptor
    from gam_relocalizer.features.local import LocalExtractor
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

# A point that the camera model folds back into the image has another ray than its pixel.
_SAME_RAY = 1e-2


@dataclass(frozen=True)
class QuerySet:
    """Images to localize in a map, with the truth.

    Attributes:
        scene_map: The map.
        folder: Where the images are.
        camera: Of all images.
        truth: By name of image, camera_from_world.
        images_without_truth: Number of further images in the folder; they are no queries.
        world_from_map: Identity where the truth is in the frame of the map.
        aligned: Whether `world_from_map` was fitted to true poses of the map's images.
    """

    scene_map: SceneMap
    folder: Path
    camera: pycolmap.Camera
    truth: Mapping[str, pycolmap.Rigid3d]
    images_without_truth: int
    world_from_map: pycolmap.Sim3d
    aligned: bool


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
        error: Of the best pose found, accepted or not [unit of the truth]; None without a pose.
        confidence: In that pose.
        milliseconds: For matching and pose, over all scenes tried.
    """

    status: Status
    error: PoseError | None
    confidence: float
    milliseconds: float


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
        retrieval: Of the reference images.
        outcomes: By method and name of image.
    """

    name: str
    map_id: str
    metric: bool
    global_descriptor: str
    aligned: bool
    queries: int
    images_without_truth: int
    retrieval: RetrievalScore
    outcomes: Mapping[Method, Mapping[str, Outcome]]


def methods_of(matchers: Sequence[str]) -> tuple[Method, ...]:
    """The rows of the paper's table: SR1 with every matcher; IR, CC and SR with the last one."""
    scenes, last = LocalizerOptions().max_scenes, matchers[-1]
    return (
        *(Method('SR1', matcher, Coarse.EXPANDED, max_scenes=1) for matcher in matchers),
        Method('IR', last, Coarse.TOGETHER, scenes),
        Method('CC', last, Coarse.CLUSTERS, scenes),
        Method('SR', last, Coarse.EXPANDED, scenes),
    )


def read_query_set(
    map_path: Path,
    folder: Path,
    truth: Path,
    camera: str | None = None,
    reference: Path | None = None,
) -> QuerySet:
    """Reads all but the images.

    Args:
        map_path: The map bundle.
        folder: The images; those that the truth names are queries.
        truth: Poses file, camera_from_world.
        camera: See `parse_camera`; the map's own if none is given.
        reference: Poses file of the images that the map was built from, in the world of the truth.

    Raises:
        UsageError: No such folder, no query in it, or a reference that lacks an image of the map.
        PosesFileError: A poses file is missing or malformed.
        CameraError: The camera cannot be understood, or the map has not exactly one of its own.
        MapError: The map is damaged, or does not fit over the reference.
    """
    names = list_images(folder)
    poses = read_poses(truth)
    true_mapping = None if reference is None else read_poses(reference)
    parsed_camera = None if camera is None else parse_camera(camera)
    queries = {name: poses[name] for name in names if name in poses}
    if not queries:
        msg = (
            f'{truth}: names none of the {len(names)} images in {folder}; expected names like '
            f'`{names[0]}`, found names like `{next(iter(poses))}`'
        )
        raise UsageError(msg)
    scene_map = load_map(map_path)
    return QuerySet(
        scene_map=scene_map,
        folder=folder,
        camera=parsed_camera or own_camera(scene_map),
        truth=queries,
        images_without_truth=len(names) - len(queries),
        world_from_map=(
            pycolmap.Sim3d() if true_mapping is None else world_from_map_of(scene_map, true_mapping)
        ),
        aligned=true_mapping is not None and not scene_map.manifest.frame.metric,
    )


def own_camera(scene_map: SceneMap) -> pycolmap.Camera:
    """The camera that took all images of a map, as its build left it.

    Raises:
        CameraError: There are several, or the manifest does not tell.
    """
    report = scene_map.manifest.build.get('report')
    lines = report.get('cameras') if isinstance(report, dict) else None
    if not isinstance(lines, list) or len(lines) != 1 or not isinstance(lines[0], str):
        found = f'{len(lines)} cameras' if isinstance(lines, list) else 'no cameras'
        msg = (
            f'{scene_map.path}: its manifest tells of {found}, expected one that took the queries '
            f'too; give the camera of the queries with --camera'
        )
        raise CameraError(msg)
    return parse_camera(lines[0])


def world_from_map_of(
    scene_map: SceneMap, true_mapping: Mapping[str, pycolmap.Rigid3d]
) -> pycolmap.Sim3d:
    """The similarity that lays the map's cameras over the true ones; identity for a metric map.

    Args:
        scene_map: A map.
        true_mapping: camera_from_world of its images, by name.

    Raises:
        UsageError: An image of the map has no true pose.
        MapError: No similarity fits.
    """
    if scene_map.manifest.frame.metric:
        return pycolmap.Sim3d()
    missing = [name for name in scene_map.image_names if name not in true_mapping]
    if missing:
        msg = (
            f'{scene_map.path}: {len(missing)} of its {scene_map.num_images} images have no true '
            f'pose in the reference, the first is `{missing[0]}`'
        )
        raise UsageError(msg)
    in_map = [pose.tgt_origin_in_src() for pose in scene_map.camera_from_map]
    in_world = [true_mapping[name].tgt_origin_in_src() for name in scene_map.image_names]
    fitted = pycolmap.estimate_sim3d(np.array(in_map), np.array(in_world))
    if fitted is None:
        msg = f'{scene_map.path}: no similarity lays its cameras over the true ones'
        raise MapError(msg)
    return fitted


def evaluate_set(
    query_set: QuerySet,
    extractor: LocalExtractor,
    describer: GlobalDescriptor,
    matchers: Mapping[str, Matcher],
    retrieved_images: int,
    progress: Progress = ignore_progress,
) -> SetEvaluation:
    """Localizes every query by every method; it is described once.

    Args:
        query_set: The queries.
        extractor: That of the map.
        describer: That of the map.
        matchers: By name; see `methods_of` for what their order means.
        retrieved_images: R of the paper.
        progress: Told of the step localize.

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
    map_from_world = query_set.world_from_map.inverse()
    outcomes: dict[Method, dict[str, Outcome]] = {method: {} for method in localizers}
    found, covisible = [], []
    for done, (name, truth) in enumerate(query_set.truth.items(), start=1):
        image = _read_query(query_set, name)
        features = extractor.extract(image)
        described = describer.describe(image, features)
        for method, localizer in localizers.items():
            result = localizer.localize_features(features, described, query_set.camera)
            outcomes[method][name] = _outcome(result, truth, query_set.world_from_map)
        found.append(retrieve(described, scene_map, RANKS[-1]).images)
        camera_from_map = map_from_world.transform_camera_world(truth)
        covisible.append(covisible_images(scene_map, camera_from_map, query_set.camera))
        progress('localize', done, len(query_set.truth))
    return SetEvaluation(
        name=scene_map.path.resolve().name,
        map_id=scene_map.manifest.map_id,
        metric=scene_map.manifest.frame.metric,
        global_descriptor=scene_map.manifest.retrieval,
        aligned=query_set.aligned,
        queries=len(query_set.truth),
        images_without_truth=query_set.images_without_truth,
        retrieval=score_retrieval(found, covisible),
        outcomes=outcomes,
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


def calibration_of(outcomes: Iterable[Outcome]) -> tuple[Calibration, PrecisionRecall]:
    """Reliability, and precision and recall, of the confidence in the poses that were found."""
    every = list(outcomes)
    posed = [(one.confidence, one.error) for one in every if one.error is not None]
    confidence = [confidence for confidence, _ in posed]
    correct = [CORRECT.admits(error) for _, error in posed]
    return calibrate(confidence, correct), precision_recall(confidence, correct, len(every))


def _outcome(
    result: LocalizationResult, truth: pycolmap.Rigid3d, world_from_map: pycolmap.Sim3d
) -> Outcome:
    error = None
    if result.estimate is not None:
        pose = world_from_map.transform_camera_world(result.estimate.camera_from_map)
        error = pose_error(pose, truth)
    milliseconds = result.timings.matching + result.timings.pose
    return Outcome(result.status, error, result.confidence, milliseconds)


def _read_query(query_set: QuerySet, name: str) -> NDArray[np.uint8]:
    image, camera = read_image(query_set.folder / name), query_set.camera
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        msg = (
            f'{query_set.folder / name}: the image has {width} x {height} pixels, the camera '
            f'{camera.width} x {camera.height}; give the camera of the queries with --camera'
        )
        raise CameraError(msg)
    return image


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
