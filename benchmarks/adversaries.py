# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Tries to make the localizer accept wrong poses; prints a Markdown table, fails if it did.

Queries are the images of the real sets (see `real_data.py`), in their own map, spoilt by every
adversary, and in the maps of the others; frames of the walks, which are in no map; and rendered
ones: the demo's rooms with moved furniture, from anywhere, from right before a picture, and
redecorated (other pictures, other wear), another room, and a corridor of identical doors. Nothing
is done twice: what `--out` holds is kept, so delete `queries.jsonl` there to localize anew.

    python benchmarks/adversaries.py DATA --out build/adversaries --maps build/benchmarks
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import zlib
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pycolmap
import torch
from adversarial_queries import CORRIDOR, DEMO, EXTRACTOR, MIXED_UP, prepare
from real_data import SETS

from gam_relocalizer.cameras import parse_camera
from gam_relocalizer.demo.shipped import demo_map_path
from gam_relocalizer.evaluation.adversaries import (
    ADVERSARIES,
    View,
    another_building,
    is_false_accept,
    metre_of,
    with_mixed_up_descriptors,
)
from gam_relocalizer.evaluation.calibration import (
    calibrate,
    normalised_error_squared,
    precision_recall,
    precision_recall_figure,
    reliability_figure,
    summarise_nees,
)
from gam_relocalizer.evaluation.metrics import CORRECT
from gam_relocalizer.features.registry import create_extractor
from gam_relocalizer.geometry import pose_error, write_text
from gam_relocalizer.images import read_image
from gam_relocalizer.localization.localizer import Localizer
from gam_relocalizer.localization.result import Status
from gam_relocalizer.matching.registry import create_matcher
from gam_relocalizer.plots import write_picture
from gam_relocalizer.scene_map import load_map

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from adversarial_queries import Job

    from gam_relocalizer.features.local import LocalExtractor
    from gam_relocalizer.localization.result import LocalizationResult
    from gam_relocalizer.matching.matcher import Matcher
    from gam_relocalizer.scene_map import SceneMap

MATCHER = 'gam'
# The truth of this one has no scale.
NOT_METRIC = frozenset({'fox'})
ANOTHER_BUILDING = 'another-building'
WRONG_CAMERA = ('focal-length-too-long', 'focal-length-too-short')
# A photograph of a flat wall that fills the view is a view of that wall, and no image can tell. It
# is reported, and does not fail the benchmark.
UNDECIDABLE = 'photograph'
SPOILT = frozenset({*ADVERSARIES, ANOTHER_BUILDING, MIXED_UP})


@dataclass(frozen=True)
class Record:
    """One line of `queries.jsonl`.

    Attributes:
        key: Unique: map, adversary and image.
        map: Name of the map.
        adversary: What was done to the query, or its source where nothing was.
        has_truth: Whether there is a right pose.
        status: Name of the verdict.
        reason: The verdict in words.
        confidence: In the best pose found.
        matches: In the scene that decided.
        scenes_tried: Number of scenes.
        image: Set or kind of rendering, folder and file.
        keypoints: Of the image.
        milliseconds: For the whole query.
        is_right: The best pose found is no false one, accepted or not.
        is_correct: It is what the confidence promises.
        belief: That this pose is right, by its evidence alone.
        inliers: Of that pose.
        inlier_ratio: Per match.
        coverage: Share of the image.
        reprojection_error: [px].
        error_position: Of the best pose found [m, or what stands for it]; None without a truth.
        error_rotation_deg: The same.
        nees: Its normalised estimation error squared.
    """

    key: str
    map: str
    adversary: str
    has_truth: bool
    status: str
    reason: str
    confidence: float
    matches: int
    scenes_tried: int
    image: str = ''
    keypoints: int = 0
    milliseconds: float = 0.0
    is_right: bool = False
    is_correct: bool = False
    belief: float = 0.0
    inliers: int = 0
    inlier_ratio: float = 0.0
    coverage: float = 0.0
    reprojection_error: float | None = None
    error_position: float | None = None
    error_rotation_deg: float | None = None
    nees: float | None = None

    @property
    def is_accepted(self) -> bool:
        """Whether the robot was told a pose."""
        return self.status == Status.ACCEPTED.name

    @property
    def is_false(self) -> bool:
        """Whether the robot was told a wrong one."""
        return self.is_accepted and not self.is_right


def main() -> None:
    """Prepares maps and images, runs what is missing, reports."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('data', type=Path, help='folder of the image sets')
    parser.add_argument('--out', type=Path, default=Path('build/adversaries'))
    parser.add_argument('--maps', type=Path, default=Path('build/benchmarks'))
    parser.add_argument('--workers', type=int, default=2)
    parser.add_argument('--every', type=int, default=1, help='use every so many-th image only')
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    workers = ProcessPoolExecutor(
        arguments.workers, mp_context=get_context('spawn'), initializer=_use_one_thread
    )
    with workers:
        jobs = prepare(arguments.data, arguments.out, arguments.maps, workers)
        jobs = jobs[:: arguments.every]
        maps = _map_paths(arguments.out, arguments.maps)
        records = _run(jobs, maps, arguments.out / 'queries.jsonl', workers)
    report = _report(records, arguments.out)
    write_text(arguments.out / 'adversaries.md', f'{report}\n')
    print(report)
    sys.exit(any(record.is_false and record.adversary != UNDECIDABLE for record in records))


def _map_paths(out: Path, maps: Path) -> dict[str, Path]:
    real = {name: maps / f'{name}-poses' for name in SETS}
    return {**real, DEMO: demo_map_path(), CORRIDOR: out / 'corridor_map'}


def _use_one_thread() -> None:
    torch.set_num_threads(1)
    cv2.setNumThreads(1)


@cache
def _scene_map(path: Path) -> SceneMap:
    return load_map(path)


@cache
def _parts() -> tuple[LocalExtractor, Matcher]:
    return create_extractor(EXTRACTOR), create_matcher(MATCHER, extractor=EXTRACTOR)


@cache
def _localizer(path: Path, *, mixed_up: bool = False) -> Localizer:
    scene_map = _scene_map(path)
    if mixed_up:
        scene_map = with_mixed_up_descriptors(scene_map, np.random.default_rng(0))
    return Localizer(scene_map, *_parts())


@cache
def _metre(path: Path, *, metric: bool) -> float:
    return metre_of(_scene_map(path), metric=metric)


def _run(
    jobs: Sequence[Job], maps: Mapping[str, Path], path: Path, workers: ProcessPoolExecutor
) -> list[Record]:
    """Runs what `path` does not hold yet, and appends it there line by line."""
    wanted = [task.key for job in jobs for task in _tasks(job)]
    records = {record.key: record for record in _read(path)}
    left = [job for job in jobs if any(task.key not in records for task in _tasks(job))]
    # In no order, so that the time to go can be guessed from the time gone by.
    np.random.default_rng(0).shuffle(left)
    begin = time.perf_counter()
    with path.open('a', encoding='utf-8') as stream:
        running = [workers.submit(_run_job, job, maps, frozenset(records)) for job in left]
        for done, finished in enumerate(as_completed(running), start=1):
            new = finished.result()
            stream.writelines(f'{json.dumps(asdict(record))}\n' for record in new)
            stream.flush()
            records |= {record.key: record for record in new}
            if done % 50 == 0:
                seconds = time.perf_counter() - begin
                print(f'{done} of {len(left)} images, {seconds:.0f} s', file=sys.stderr)
    return [records[key] for key in wanted]


def _read(path: Path) -> Iterator[Record]:
    """The records of an earlier run; its last line may be cut off."""
    if not path.is_file():
        return
    for line in path.read_text(encoding='utf-8').splitlines():
        with suppress(json.JSONDecodeError):
            yield Record(**json.loads(line))


def _run_job(job: Job, maps: Mapping[str, Path], done: frozenset[str]) -> list[Record]:
    """All queries of one image that are not done."""
    truth = None if job.truth is None else pycolmap.Rigid3d(np.array(job.truth))
    view = View(read_image(job.path), parse_camera(job.camera), truth)
    records = []
    for task in _tasks(job):
        if task.key in done:
            continue
        localizer = _localizer(maps[task.map_name], mixed_up=task.adversary == MIXED_UP)
        query = view
        if task.adversary == ANOTHER_BUILDING:
            query = another_building(view)
        elif task.adversary in ADVERSARIES:
            rng = np.random.default_rng(zlib.crc32(task.key.encode()))
            query = ADVERSARIES[task.adversary](view, rng)
        result = localizer.localize(query.image, query.camera)
        metre = _metre(maps[task.map_name], metric=task.map_name not in NOT_METRIC)
        record = _record(task, query.camera_from_map, result, metre)
        records.append(
            replace(
                record,
                keypoints=result.keypoints,
                milliseconds=result.timings.total,
                image=_image_name(job),
            )
        )
    return records


@dataclass(frozen=True)
class _Task:
    """One query: an image, what is done to it, and the map to find it in."""

    key: str
    map_name: str
    adversary: str


def _tasks(job: Job) -> list[_Task]:
    at_home = [job.source, *job.spoilt_by] if job.home else []
    pairs = [
        *((job.home, adversary) for adversary in at_home),
        *((name, ANOTHER_BUILDING) for name in job.elsewhere),
    ]
    image = _image_name(job)
    return [_Task(f'{name}/{adversary}/{image}', name, adversary) for name, adversary in pairs]


def _image_name(job: Job) -> str:
    """The set or the kind of rendering that it is of, folder and file."""
    return '/'.join(job.path.parts[-3:])


def _record(
    task: _Task, truth: pycolmap.Rigid3d | None, result: LocalizationResult, metre: float
) -> Record:
    """All but what is known of the image."""
    found = Record(
        key=task.key,
        map=task.map_name,
        adversary=task.adversary,
        has_truth=truth is not None,
        status=result.status.name,
        reason=result.reason,
        confidence=result.confidence,
        matches=result.matches,
        scenes_tried=result.scenes_tried,
    )
    estimate = result.estimate
    if estimate is None:
        return found
    found = replace(
        found,
        is_right=not is_false_accept(estimate.camera_from_map, truth, metre),
        belief=estimate.belief,
        inliers=estimate.inliers,
        inlier_ratio=estimate.inlier_ratio,
        coverage=estimate.coverage,
        reprojection_error=estimate.reprojection_error,
    )
    if truth is None:
        return found
    error = pose_error(estimate.camera_from_map, truth)
    error = replace(error, position=error.position / metre)
    return replace(
        found,
        is_correct=CORRECT.admits(error),
        error_position=error.position,
        error_rotation_deg=error.rotation_deg,
        nees=normalised_error_squared(estimate.camera_from_map, truth, estimate.covariance),
    )


def _report(records: Sequence[Record], out: Path) -> str:
    """Tables in Markdown; writes the figures beside."""
    # What an adversary shows is not what a robot sees: how often poses are right is another matter.
    plain = [record for record in records if record.has_truth and record.adversary not in SPOILT]
    calibration = calibrate(
        [record.confidence for record in plain], [record.is_correct for record in plain]
    )
    with_pose = [record for record in records if record.inliers]
    curve = precision_recall(
        [record.confidence for record in with_pose],
        [record.is_right for record in with_pose],
        sum(record.has_truth for record in records),
    )
    write_picture(out / 'reliability.png', reliability_figure(calibration))
    write_picture(out / 'precision_recall.png', precision_recall_figure(curve))
    reliability = [
        f'| {one.low:.1f} - {one.high:.1f} | {one.count} | {one.confidence:.3f} '
        f'| {one.correct:.3f} |'
        for one in calibration.bins
    ]
    sections = (
        _table_of('adversary', records, lambda record: record.adversary),
        _table_of('map', records, lambda record: record.map),
        '\n'.join(
            [
                f'The {len(plain)} queries that are as a robot sees them:',
                '',
                '| confidence | queries | mean | correct |',
                '|---' * 4 + '|',
                *reliability,
                '',
                f'Expected calibration error {calibration.expected_calibration_error:.4f}, Brier '
                f'score {calibration.brier_score:.4f}; recall without a false pose, by confidence '
                f'alone: {curve.recall_without_error:.1%}.',
            ]
        ),
        _nees_table(records),
        _false_accepts(records),
    )
    return '\n\n'.join(sections)


def _table_of(title: str, records: Sequence[Record], group_of: Callable[[Record], str]) -> str:
    """A row per group, and one for all."""
    groups: defaultdict[str, list[Record]] = defaultdict(list)
    for record in records:
        groups[group_of(record)].append(record)
    rows = [_row(name, group) for name, group in sorted(groups.items())]
    header = f'| {title} | queries | accepted | falsely | with a right pose | rightly accepted '
    header += '| median ms |'
    return '\n'.join([header, '|---' * 7 + '|', *rows, _row('**all**', records)])


def _row(name: str, records: Sequence[Record]) -> str:
    with_truth = [record for record in records if record.has_truth]
    right = sum(record.is_accepted and not record.is_false for record in with_truth)
    cells = (
        name,
        len(records),
        sum(record.is_accepted for record in records),
        sum(record.is_false for record in records),
        len(with_truth),
        f'{right / len(with_truth):.1%}' if with_truth else '-',
        f'{np.median([record.milliseconds for record in records]):.0f}',
    )
    return f'| {" | ".join(map(str, cells))} |'


def _nees_table(records: Sequence[Record]) -> str:
    """Of accepted poses, for every map; not of cameras that the localizer was told wrongly of."""
    groups: defaultdict[str, list[float]] = defaultdict(list)
    for record in records:
        is_calibrated = record.adversary not in WRONG_CAMERA
        if record.is_accepted and record.is_right and record.nees is not None and is_calibrated:
            groups[record.map].append(record.nees)
            groups['**all**'].append(record.nees)
    header = (
        '| map | accepted poses | NEES (6 is right) | its 95 % band | within 95 % | worst sigma |'
    )
    rows = []
    for name, values in sorted(groups.items()):
        found = summarise_nees(values)
        low, high = found.band
        rows.append(
            f'| {name} | {found.trials} | {found.mean:.1f} | {low:.2f} - {high:.2f} '
            f'| {found.within:.0%} | {found.worst_sigma:.1f} |'
        )
    return '\n'.join([header, '|---' * 6 + '|', *rows])


def _false_accepts(records: Sequence[Record]) -> str:
    counted = [record for record in records if record.adversary != UNDECIDABLE]
    photographs = [record for record in records if record.adversary == UNDECIDABLE]
    lines = [
        f'False accepts: {sum(record.is_false for record in counted)} of {len(counted)}, and '
        f'{sum(record.is_false for record in photographs)} of {len(photographs)} photographs.'
    ]
    for record in records:
        if record.is_false:
            error = '' if record.error_position is None else f'{record.error_position:.2f} m off, '
            lines.append(
                f'- {record.key}: {error}confidence {record.confidence:.2f}, {record.reason}'
            )
    return '\n'.join(lines)


if __name__ == '__main__':
    main()
