# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What a map takes: bytes for a point, time to load, memory of a query; prints Markdown tables.

Maps are taken as they are and written again with descriptors of 16 and of 8 bits. Queries of a map
come from the set of images that its name begins with (see `real_data.py`), of the demo's map from
its bag. Recall is that of all poses found, and of those that were accepted (fixes), but for the
check whether an image is mirrored, which no width of the map changes.

A made-up drive of any length tells how load time and memory grow with a map: two laps of a street,
all queries of a map in a process of its own, with networks, options and code of the real ones. Its
files have just been written, so that loading does not wait for the disk.

    python benchmarks/map_size.py sizes maps/demo build/benchmarks/*-images
    python benchmarks/map_size.py recall DATA maps/demo build/benchmarks/*
    python benchmarks/map_size.py growth --points 100000 1000000
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
from process_usage import resources

from gam_relocalizer.demo.shipped import demo_map_path
from gam_relocalizer.demo.trajectories import BASE_FROM_CAMERA
from gam_relocalizer.evaluation.metrics import THRESHOLDS, Threshold, accuracy
from gam_relocalizer.evaluation.query_set import read_query_set
from gam_relocalizer.features.local import LocalFeatures
from gam_relocalizer.features.registry import create_extractor
from gam_relocalizer.features.vlad import RETRIEVAL_NAME, Vlad
from gam_relocalizer.geometry import pose_error
from gam_relocalizer.images import read_image
from gam_relocalizer.localization.continuity import ContinuityOptions
from gam_relocalizer.localization.localizer import Localizer, LocalizerOptions
from gam_relocalizer.localization.pose import PoseOptions
from gam_relocalizer.map_encoding import unit_rows
from gam_relocalizer.matching.registry import DEFAULT_MATCHER, create_matcher
from gam_relocalizer.replay.replay import ReplayOptions, replay_bag
from gam_relocalizer.scene_map import (
    DESCRIPTOR_BITS,
    IMAGES,
    MANIFEST,
    RUN_TIME_FILES,
    Manifest,
    MapContent,
    MapFrame,
    load_content,
    load_map,
    read_manifest,
    save_map,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray
    from pycolmap import Rigid3d, Sim3d

    from gam_relocalizer.geometry import PoseError
    from gam_relocalizer.localization.prior import Prior
    from gam_relocalizer.localization.result import LocalizationResult

# Groups of files by how their names begin; what is left is the last.
PARTS = {
    'positions': ('points',),
    'descriptors': ('descriptors',),
    'global': ('global',),
    'observations': ('observation',),
    'covisibility': ('covisibility',),
    'the rest': ('codebook', IMAGES, MANIFEST),
}
EXTRACTOR = 'xfeat'
DEMO_BAG = Path('build/demo/query_bag')
SAMPLINGS = 3

# The street is full of things; cameras look along it, and go along it twice [m].
SPACING = 0.5
POINTS_PER_IMAGE = 125
SEEN_FROM = (9.5, 20.0)
WIDTH, HEIGHT = 12.0, 9.0
EYE = 1.5
MEAN_TRACK = 3.3
SHARE_OF_FIRST_LAP, SHARE_OF_BOTH = 0.7, 0.4
LANE = 0.3
CAMERA = pycolmap.Camera(
    camera_id=1, model='PINHOLE', width=640, height=480, params=[500, 500, 320, 240]
)
WORDS, DIMENSION = 64, 64
LOOKS_CHANGE_AFTER = 5.0
CLUTTER = 800
QUERIES = 20


@dataclass(frozen=True)
class Usage:
    """What one process needed.

    Attributes:
        load_s: To load the map.
        loaded_mib: Resident memory that loading added.
        queries_mib: Resident memory that queries added, each in another place, and the networks.
        query_ms: Median time of a query without the extraction.
        accepted: Queries with a fix.
    """

    load_s: float
    loaded_mib: float
    queries_mib: float
    query_ms: float
    accepted: int


def main() -> None:
    """Prints what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest='command', required=True)
    sizes = commands.add_parser('sizes', help='bytes for a point, by file')
    sizes.add_argument('maps', type=Path, nargs='+')
    recall = commands.add_parser('recall', help='what 8 bits lose')
    recall.add_argument('data', type=Path, help='folder of the image sets')
    recall.add_argument('maps', type=Path, nargs='+')
    recall.add_argument(
        '--demo-bag', type=Path, default=DEMO_BAG, help='queries of the map of the demo'
    )
    growth = commands.add_parser('growth', help='load time and memory of a large map')
    growth.add_argument('--points', type=int, nargs='+', default=[100_000, 1_000_000])
    use = commands.add_parser('use', help='(what `growth` calls in a process of its own)')
    use.add_argument('map', type=Path)
    arguments = parser.parse_args()
    if arguments.command == 'sizes':
        print(_sizes_table(arguments.maps))
    elif arguments.command == 'recall':
        print(_recall_table(arguments.data, arguments.maps, arguments.demo_bag))
    elif arguments.command == 'growth':
        print(_growth_table(arguments.points))
    else:
        print(json.dumps(asdict(_use(arguments.map))))


def _sizes_table(maps: Sequence[Path]) -> str:
    """A row for each map and width."""
    header = ['map', 'images', 'points', 'seen by', 'bits', *PARTS, 'bytes per point']
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for path in maps:
            rows += [
                _sizes_row(path.name, _written_with(bits, path, Path(folder)))
                for bits in DESCRIPTOR_BITS
            ]
    return _table(header, rows)


def _sizes_row(name: str, path: Path) -> list[str]:
    manifest = read_manifest(path)
    counts, points = manifest.counts, manifest.counts['points']
    size_of = {file: (path / file).stat().st_size for file in (*RUN_TIME_FILES, MANIFEST)}
    parts = [
        sum(size for file, size in size_of.items() if file.startswith(begins))
        for begins in PARTS.values()
    ]
    return [
        name,
        str(counts['images']),
        str(points),
        f'{counts["observations"] / points:.1f}',
        str(manifest.descriptor_bits),
        *(f'{part / points:.1f}' for part in parts),
        f'{sum(size_of.values()) / points:.1f}',
    ]


def _written_with(bits: int, path: Path, folder: Path) -> Path:
    """The map with descriptors of so many bits, without its COLMAP model."""
    manifest, content = load_content(path)
    written = folder / f'{path.resolve().name}-{bits}'
    save_map(written, content, replace(manifest, descriptor_bits=bits), None)
    return written


def _recall_table(data: Path, maps: Sequence[Path], demo_bag: Path) -> str:
    """Two rows for each map, one for each width, and for all queries, with what 8 bits lose."""
    limits = [_in_words(threshold) for threshold in THRESHOLDS[:3]]
    fixes = [f'fixes {limit}' for limit in limits]
    header = ['map', 'bits', 'attempts', 'median error', *limits, 'fixes', *fixes]
    rows = []
    everything = {bits: _Answers() for bits in DESCRIPTOR_BITS}
    for path in maps:
        with tempfile.TemporaryDirectory() as folder:
            localizers = _Localizers(path, Path(folder))
            if path.resolve() == demo_map_path().resolve():
                answers = _answers_to_bag(localizers, demo_bag)
            else:
                answers = _answers_to_set(localizers, data / path.name.rpartition('-')[0])
        for bits, of_width in answers.items():
            rows.append([path.name, f'{bits}', *of_width.cells()])
            print(' '.join(rows[-1]), file=sys.stderr, flush=True)
            everything[bits].add(of_width)
    rows += [['all', f'{bits}', *answers.cells()] for bits, answers in everything.items()]
    full, small = (everything[bits].shares() for bits in (16, 8))
    lost = [f'{100 * (more - less):.2f}' for more, less in zip(full, small, strict=True)]
    rows.append(['points lost', '8', '', '', *lost])
    return _table(header, rows)


class _Answers:
    """What became of queries."""

    def __init__(self) -> None:
        self.attempts = 0
        self.found: list[PoseError] = []
        self.fixes: list[PoseError] = []

    def take(self, result: LocalizationResult, world_from_map: Sim3d, truth: Rigid3d) -> None:
        """Adds the best pose of an attempt, which is a fix when it was accepted."""
        self.attempts += 1
        if result.estimate is not None:
            found = world_from_map.transform_camera_world(result.estimate.camera_from_map)
            self.found.append(pose_error(found, truth))
            self.fixes += self.found[-1:] if result.accepted else []

    def add(self, others: _Answers) -> None:
        """Takes in all others."""
        self.attempts += others.attempts
        self.found += others.found
        self.fixes += others.fixes

    def shares(self) -> list[float]:
        """Shares of the attempts: poses within each threshold, fixes, and these within each."""
        found, fixes = (accuracy(errors, self.attempts) for errors in (self.found, self.fixes))
        thresholds = THRESHOLDS[:3]
        return [
            *(found.recall[threshold] for threshold in thresholds),
            fixes.localized / self.attempts,
            *(fixes.recall[threshold] for threshold in thresholds),
        ]

    def cells(self) -> list[str]:
        """Of a row."""
        found = accuracy(self.found, self.attempts)
        return [
            f'{self.attempts}',
            f'{100 * found.median_position:.2f} cm, {found.median_rotation_deg:.3f} deg',
            *(f'{100 * share:.1f} %' for share in self.shares()),
        ]


class _Localizers:
    """One map in all widths, each with several samplings: an image is described once for all.

    Which poses are drawn decides whether an attempt at the edge of a threshold is a fix, and a
    change in the last bit draws others. More than one sampling tells that from a loss.
    """

    def __init__(self, path: Path, folder: Path) -> None:
        scene_map = load_map(path)
        self.path = path
        self._extractor = create_extractor(scene_map.manifest.extractor.name)
        self._vlad = Vlad(scene_map.codebook)
        matcher = create_matcher(DEFAULT_MATCHER, extractor=scene_map.manifest.extractor.name)
        maps = {bits: load_map(_written_with(bits, path, folder)) for bits in DESCRIPTOR_BITS}
        self._localizers = [
            (bits, Localizer(maps[bits], self._extractor, matcher, _sampled(seed)))
            for bits in DESCRIPTOR_BITS
            for seed in range(SAMPLINGS)
        ]

    def attempts(
        self, image: NDArray[np.uint8], camera: pycolmap.Camera
    ) -> list[tuple[int, LocalizationResult]]:
        """Widths and what they made of an image."""
        features = self._extractor.extract(image)
        described = self._vlad.describe(image, features)
        return [
            (bits, localizer.localize_features(features, described, camera))
            for bits, localizer in self._localizers
        ]


def _sampled(seed: int) -> LocalizerOptions:
    return LocalizerOptions(pose=PoseOptions(seed=seed))


def _answers_to_set(localizers: _Localizers, folder: Path) -> dict[int, _Answers]:
    query_set = read_query_set(
        localizers.path,
        folder / 'query',
        folder / 'poses_query.txt',
        reference=folder / 'poses_mapping.txt',
    )
    answers = {bits: _Answers() for bits in DESCRIPTOR_BITS}
    for name, truth in query_set.truth.items():
        image = read_image(folder / 'query' / name)
        for bits, result in localizers.attempts(image, query_set.cameras[name]):
            answers[bits].take(result, query_set.world_from_map, truth)
    return answers


def _answers_to_bag(localizers: _Localizers, bag: Path) -> dict[int, _Answers]:
    """The same for every image of the demo's bag, each by itself."""
    listening = _Listening(localizers)
    options = ReplayOptions(
        period=0.0, truth_topic='/ground_truth', continuity=ContinuityOptions(metric=False)
    )
    replayed = replay_bag(bag, listening, options)
    answers = {bits: _Answers() for bits in DESCRIPTOR_BITS}
    for attempt, results in zip(replayed.attempts, listening.heard, strict=True):
        if attempt.truth is not None:
            truth = (attempt.truth * BASE_FROM_CAMERA).inverse()
            for bits, result in results:
                answers[bits].take(result, pycolmap.Sim3d(), truth)
    return answers


class _Listening:
    """Lets a replay ask all localizers."""

    def __init__(self, localizers: _Localizers) -> None:
        self._localizers = localizers
        self.heard: list[list[tuple[int, LocalizationResult]]] = []

    def localize(
        self,
        image: NDArray[np.uint8],
        camera: pycolmap.Camera,
        prior: Prior | None = None,  # noqa: ARG002 - each image by itself
    ) -> LocalizationResult:
        """See `Localizer`."""
        self.heard.append(self._localizers.attempts(image, camera))
        return self.heard[-1][0][1]


def _in_words(threshold: Threshold) -> str:
    return f'{100 * threshold.position:.0f} cm, {threshold.rotation_deg:.0f} deg'


def _growth_table(sizes: Sequence[int]) -> str:
    """A row for each size and width, and the last of each width divided by the first."""
    header = [
        'points',
        'images',
        'bits',
        'bytes per point',
        'load s',
        'loading MiB',
        f'{QUERIES} queries MiB',
        'query ms',
        'fixes',
    ]
    rows, usages = [], {}
    for bits in DESCRIPTOR_BITS:
        for points in sizes:
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder, 'street')
                manifest = save_street(path, points, bits)
                usages[bits, points] = usage = _used_by_a_process(path)
                counts = manifest.counts
                in_all = sum(entry.size for entry in manifest.files.values())
            rows.append(
                [
                    f'{counts["points"]}',
                    f'{counts["images"]}',
                    f'{bits}',
                    f'{in_all / counts["points"]:.1f}',
                    f'{usage.load_s:.2f}',
                    f'{usage.loaded_mib:.1f}',
                    f'{usage.queries_mib:.1f}',
                    f'{usage.query_ms:.0f}',
                    f'{usage.accepted}/{QUERIES}',
                ]
            )
            print(' '.join(rows[-1]), file=sys.stderr, flush=True)
    for bits in DESCRIPTOR_BITS:
        first, last = usages[bits, sizes[0]], usages[bits, sizes[-1]]
        rows.append(
            [
                f'x {sizes[-1] / sizes[0]:.0f}',
                '',
                f'{bits}',
                '',
                f'x {last.load_s / first.load_s:.1f}',
                f'x {last.loaded_mib / first.loaded_mib:.1f}',
                f'x {last.queries_mib / first.queries_mib:.1f}',
                f'x {last.query_ms / first.query_ms:.1f}',
                '',
            ]
        )
    return _table(header, rows)


def save_street(path: Path, points: int, bits: int) -> Manifest:
    """A map of a street of about so many points; their rows follow the images that see them."""
    rng = np.random.default_rng(0)
    images_of_lap = max(round(points / POINTS_PER_IMAGE / 2), 60)
    along = SPACING * np.arange(images_of_lap)
    positions = np.concatenate(
        [
            np.column_stack([along, np.full(images_of_lap, lane), np.full(images_of_lap, EYE)])
            for lane in (0.0, LANE)
        ]
    )
    places, first_image, seen = _street_points(points, images_of_lap, rng)
    order = np.argsort(first_image, kind='stable')
    row_of = np.empty_like(order)
    row_of[order] = np.arange(points)
    image_of, point_of = seen
    by_image = np.argsort(image_of, kind='stable')
    counts = np.bincount(image_of, minlength=len(positions))
    content = MapContent(
        image_names=tuple(f'{index:06}.jpg' for index in range(len(positions))),
        camera_from_sfm=tuple(_looking_along(position) for position in positions),
        points=places[order],
        descriptors=unit_rows(rng.normal(size=(points, DIMENSION)).astype(np.float32)),
        observation_offsets=np.concatenate([[0], np.cumsum(counts)]),
        observation_points=row_of[point_of[by_image]].astype(np.int32),
        global_descriptors=_street_looks(positions[:, 0], rng),
        codebook=unit_rows(rng.normal(size=(WORDS, DIMENSION))),
    )
    frame = MapFrame(metric=True, source='made up')
    identity = create_extractor(EXTRACTOR, 1).identity
    manifest = Manifest(identity, RETRIEVAL_NAME, frame, {}, descriptor_bits=bits)
    return save_map(path, content, manifest, None)


def _street_points(
    points: int, images_of_lap: int, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.int64], tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Places [N,3], the first image of each [N], and observations: images [nnz], points [nnz]."""
    nearest, farthest = (round(distance / SPACING) for distance in SEEN_FROM)
    # index of the camera beside each point
    beside = rng.uniform(farthest, images_of_lap + nearest, points)
    places = np.column_stack(
        [
            SPACING * beside,
            rng.uniform(-WIDTH / 2, WIDTH / 2, points),
            EYE + rng.uniform(-HEIGHT / 2, HEIGHT / 2, points),
        ]
    )
    chance = rng.random(points)
    in_lap = np.stack([chance < SHARE_OF_FIRST_LAP, chance > SHARE_OF_FIRST_LAP - SHARE_OF_BOTH])
    first_image = np.full(points, 2 * images_of_lap)
    images, observed = [], []
    for lap, seen in enumerate(in_lap):
        begin = np.ceil(beside - farthest).astype(int) + rng.integers(0, 8, points)
        length = np.minimum(1 + rng.geometric(1.0 / (MEAN_TRACK - 1.0), points), 12)
        for step in range(12):
            image = begin + step
            sees = seen & (step < length) & (image >= 0) & (image < images_of_lap)
            images.append(image[sees] + lap * images_of_lap)
            observed.append(np.flatnonzero(sees))
            first_image[sees] = np.minimum(first_image[sees], images[-1])
    return places, first_image, (np.concatenate(images), np.concatenate(observed))


def _street_looks(along: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float32]:
    """Global descriptors [I,G] that change along the street."""
    stations = rng.normal(size=(int(along.max() / LOOKS_CHANGE_AFTER) + 2, WORDS * DIMENSION))
    station = (along / LOOKS_CHANGE_AFTER).astype(int)
    share = (along / LOOKS_CHANGE_AFTER - station)[:, None].astype(np.float32)
    stations = stations.astype(np.float32)
    return unit_rows(stations[station] * (1.0 - share) + stations[station + 1] * share)


def _looking_along(position: NDArray[np.float64]) -> pycolmap.Rigid3d:
    """camera_from_sfm of a camera that looks along the street (x), z up."""
    rotation = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    return pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ position)


def _used_by_a_process(path: Path) -> Usage:
    done = subprocess.run(
        [sys.executable, __file__, 'use', str(path)], stdout=subprocess.PIPE, check=True
    )
    return Usage(**json.loads(done.stdout))


def _use(path: Path) -> Usage:
    """Loads a map of a street and localizes in it."""
    extractor = create_extractor(EXTRACTOR, 2048)
    matcher = create_matcher(DEFAULT_MATCHER, extractor=EXTRACTOR)
    before = _resident_mib()
    begin = time.perf_counter()
    scene_map = load_map(path)
    load_s = time.perf_counter() - begin
    loaded = _resident_mib()
    localizer = Localizer(scene_map, extractor, matcher)
    rng = np.random.default_rng(1)
    milliseconds, accepted = [], 0
    for image in np.linspace(60, scene_map.num_images - 60, QUERIES).astype(int):
        seen = scene_map.points_seen_by(int(image))
        in_camera = scene_map.camera_from_map[image] * scene_map.positions_of(seen)
        features = _features_of(in_camera, scene_map.descriptors_of(seen), rng)
        described = scene_map.global_descriptor_of(int(image))
        begin = time.perf_counter()
        result = localizer.localize_features(features, described, CAMERA)
        milliseconds.append(1e3 * (time.perf_counter() - begin))
        accepted += result.accepted
    return Usage(
        load_s=load_s,
        loaded_mib=loaded - before,
        queries_mib=_resident_mib() - loaded,
        query_ms=float(np.median(milliseconds)),
        accepted=accepted,
    )


def _features_of(
    in_camera: NDArray[np.float64], descriptors: NDArray[np.float32], rng: np.random.Generator
) -> LocalFeatures:
    """Half of what an image saw, a pixel off, among things that are not in the map."""
    pixels = np.asarray(CAMERA.img_from_cam(in_camera)) + rng.normal(0.0, 1.0, (len(in_camera), 2))
    inside = ((pixels >= 0) & (pixels < [CAMERA.width, CAMERA.height])).all(axis=1)
    inside &= rng.random(len(inside)) < 0.5
    others = rng.uniform([0, 0], [CAMERA.width, CAMERA.height], (CLUTTER, 2))
    looks = descriptors[inside] + rng.normal(0.0, 0.03, (inside.sum(), DIMENSION))
    keypoints = np.concatenate([pixels[inside], others]).astype(np.float32)
    return LocalFeatures(
        keypoints=keypoints,
        descriptors=unit_rows(np.concatenate([looks, rng.normal(size=(CLUTTER, DIMENSION))])),
        scores=np.ones(len(keypoints), np.float32),
    )


def _resident_mib() -> float:
    return resources(os.getpid()).resident_mib


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [' | '.join(header), '|'.join(['---'] * len(header)), *(' | '.join(r) for r in rows)]
    return '\n'.join(f'| {line} |' if '---' not in line else f'|{line}|' for line in lines)


if __name__ == '__main__':
    main()
