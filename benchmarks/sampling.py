# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The pose search guided by the matcher's weights, against one that samples all matches alike.

Takes queries of the real image sets (maps of `benchmarks/real_data.py`) and of the demo (its bag,
if there is one), matches each with its first scene, and searches the pose in both ways. As matched,
and diluted: a part of the true matches among random wrong ones, whose weights are drawn from the
wrong matches of the same matcher. Prints Markdown tables.

    python benchmarks/sampling.py DATA --maps build/benchmarks
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from gam_relocalizer.cameras import camera_from_calibration, parse_camera
from gam_relocalizer.demo.recording import CAMERA_INFO_TOPIC, GROUND_TRUTH_TOPIC, IMAGE_TOPIC
from gam_relocalizer.demo.shipped import demo_map_path
from gam_relocalizer.demo.trajectories import BASE_FROM_CAMERA
from gam_relocalizer.evaluation.metrics import THRESHOLDS, accuracy
from gam_relocalizer.features.registry import create_extractor
from gam_relocalizer.features.vlad import Vlad
from gam_relocalizer.geometry import pose_error, read_poses
from gam_relocalizer.images import list_images, read_image
from gam_relocalizer.localization.localizer import LocalizerOptions
from gam_relocalizer.localization.pose import (
    REFERENCE_SIDE,
    PoseOptions,
    estimate_pose,
    reprojection_errors,
)
from gam_relocalizer.localization.retrieval import retrieve
from gam_relocalizer.localization.scenes import expanded_scenes
from gam_relocalizer.matching.bmnet import normalise_keypoints, normalised_focal_length
from gam_relocalizer.matching.matcher import MatchInput
from gam_relocalizer.matching.registry import create_matcher
from gam_relocalizer.replay.bag import open_bag
from gam_relocalizer.replay.messages import calibration_in, image_in, pose_in
from gam_relocalizer.scene_map import load_map

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from typing import TypeAlias

    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.geometry import PoseError
    from gam_relocalizer.matching.matcher import Matches
    from gam_relocalizer.scene_map import SceneMap

    Cell: TypeAlias = Callable[[Sequence['Trial']], str]
    # a row of the tables: matcher, and share of true matches
    Row: TypeAlias = tuple[str, str]

SETS = ('redkitchen', 'castle-p30', 'fountain-p11', 'fox')
MATCHERS = ('gam', 'nn-cross', 'bmnet')
AS_MATCHED = 'as matched'
TRUE_SHARES = (0.5, 0.1, 0.05, 0.02)
# Only where enough is true does the search ever stop at its least number of samples.
EARLY_STOPS = (AS_MATCHED, '50%')
DILUTED_MATCHES = 1000
# With fewer the retrieval failed, and there is no pose to search.
FEWEST_TRUE = 20
WITHIN = THRESHOLDS[2]
_NAME_OF_WITHIN = f'{100 * WITHIN.position:.0f} cm / {WITHIN.rotation_deg:.0f} deg'
CAPS = (100, 1000)
MINIMA = (20, 500)


@dataclass(frozen=True)
class View:
    """A query image with its true pose.

    Attributes:
        image: RGB.
        camera: That took it.
        camera_from_map: The truth.
    """

    image: NDArray[np.uint8]
    camera: pycolmap.Camera
    camera_from_map: pycolmap.Rigid3d


@dataclass(frozen=True)
class Problem:
    """Matches of a query, as `estimate_pose` takes them, and the truth."""

    keypoints: NDArray[np.float64]
    points: NDArray[np.float64]
    weights: NDArray[np.float32]
    nearest: NDArray[np.bool_]
    camera: pycolmap.Camera
    camera_from_map: pycolmap.Rigid3d

    @property
    def is_true(self) -> NDArray[np.bool_]:
        """Which matches the search would take for inliers of the true pose."""
        threshold = PoseOptions().max_error * max(self.camera.width, self.camera.height)
        errors = reprojection_errors(self.camera_from_map, self.keypoints, self.points, self.camera)
        return errors <= threshold / REFERENCE_SIDE


@dataclass(frozen=True)
class Trial:
    """What a search came to; no error means that it found no pose."""

    iterations: int
    milliseconds: float
    error: PoseError | None


def main() -> None:
    """Collects problems, searches all of them in all ways, prints tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('data', type=Path, help='folder of the image sets')
    parser.add_argument('--maps', type=Path, default=Path('build/benchmarks'))
    parser.add_argument('--bag', type=Path, default=Path('build/demo/query_bag'))
    parser.add_argument('--queries', type=int, default=4, help='of every set, spread evenly')
    parser.add_argument('--seeds', type=int, default=4)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    trials: dict[Row, dict[str, list[Trial]]] = defaultdict(lambda: defaultdict(list))
    shares: dict[Row, list[float]] = defaultdict(list)
    for map_path, views in _places(arguments):
        for matcher, problems in _problems(load_map(map_path), list(views)).items():
            for key, problem, seed in _all_dilutions(matcher, problems, arguments.seeds):
                shares[key].append(float(problem.is_true.mean()))
                for name, options in _samplings(key, seed).items():
                    trials[key][name].append(_search(problem, options))
    for title, shown, columns in _tables():
        print(f'\n{title}\n')
        print(_table([row for row in trials if row[1] in shown], trials, shares, columns))


def _places(arguments: argparse.Namespace) -> Iterator[tuple[Path, Iterable[View]]]:
    """Maps and views of them."""
    for name in SETS:
        yield (
            arguments.maps / f'{name}-poses',
            _views_of_set(
                arguments.data / name, arguments.maps / f'{name}-poses', arguments.queries
            ),
        )
    if arguments.bag.is_dir():
        yield demo_map_path(), _views_of_bag(arguments.bag, arguments.queries)


def _views_of_set(folder: Path, map_path: Path, count: int) -> Iterator[View]:
    report = load_map(map_path).manifest.build['report']
    camera = parse_camera(report['cameras'][0])
    truth = read_poses(folder / 'poses_query.txt')
    names = list_images(folder / 'query')
    for index in _spread(len(names), count):
        yield View(read_image(folder / 'query' / names[index]), camera, truth[names[index]])


def _views_of_bag(path: Path, count: int) -> Iterator[View]:
    with open_bag(path) as bag:
        info = next(iter(bag.messages([CAMERA_INFO_TOPIC])))
        truth = {m.stamp_ns: pose_in(m) for m in bag.messages([GROUND_TRUTH_TOPIC])}
        stamps = sorted(truth)
        wanted = {stamps[index] for index in _spread(len(stamps), count)}
        camera = camera_from_calibration(calibration_in(info), image_is_rectified=False)
        for message in bag.messages([IMAGE_TOPIC]):
            if message.stamp_ns in wanted:
                camera_from_map = (truth[message.stamp_ns] * BASE_FROM_CAMERA).inverse()
                yield View(image_in(message), camera, camera_from_map)


def _spread(total: int, count: int) -> list[int]:
    """So many indices below the total, evenly, first and last included."""
    return np.unique(np.linspace(0, total - 1, count).astype(int)).tolist()


def _problems(scene_map: SceneMap, views: Sequence[View]) -> dict[str, list[Problem]]:
    """The matches of every matcher in the first scene of every view."""
    extractor_name = scene_map.manifest.extractor.name
    extractor, vlad = create_extractor(extractor_name), Vlad(scene_map.codebook)
    matchers = {name: create_matcher(name, extractor=extractor_name) for name in MATCHERS}
    problems: dict[str, list[Problem]] = {name: [] for name in MATCHERS}
    options = LocalizerOptions()
    for view in views:
        features = extractor.extract(view.image)
        found = retrieve(vlad.aggregate(features.descriptors), scene_map, options.retrieved_images)
        scene = next(expanded_scenes(found.images.tolist(), scene_map, options.scene_images))
        points = scene_map.positions_of(scene.points)
        given = MatchInput(
            keypoints=normalise_keypoints(features.keypoints, view.camera),
            focal_length=normalised_focal_length(view.camera),
            descriptors=features.descriptors,
            points=scene_map.camera_from_map[scene.image] * points,
            point_descriptors=scene_map.descriptors_of(scene.points),
        )
        for name, matcher in matchers.items():
            problem = _problem(matcher.match(given), features.keypoints, points, view)
            if np.count_nonzero(problem.is_true) >= FEWEST_TRUE:
                problems[name].append(problem)
    return problems


def _problem(
    matches: Matches,
    keypoints: NDArray[np.float32],
    points: NDArray[np.float64],
    view: View,
) -> Problem:
    return Problem(
        keypoints=keypoints[matches.keypoint_indices].astype(np.float64),
        points=points[matches.point_indices],
        weights=matches.weights,
        nearest=matches.nearest,
        camera=view.camera,
        camera_from_map=view.camera_from_map,
    )


def _all_dilutions(
    matcher: str, problems: Sequence[Problem], seeds: int
) -> Iterator[tuple[Row, Problem, int]]:
    """Every problem as it is and diluted, under the name of its row, with every seed."""
    false_weights = np.concatenate([one.weights[~one.is_true] for one in problems] or [[]])
    for number, problem in enumerate(problems):
        for seed in range(seeds):
            yield (matcher, AS_MATCHED), problem, seed
            for share in TRUE_SHARES:
                rng = np.random.default_rng([number, seed, round(1000 * share)])
                diluted = _diluted(problem, share, false_weights, rng)
                yield (matcher, _percent(share)), diluted, seed


def _diluted(
    problem: Problem, share: float, false_weights: NDArray[np.float32], rng: np.random.Generator
) -> Problem:
    """Some true matches among random wrong ones.

    Args:
        problem: As matched.
        share: Of the true ones among all.
        false_weights: To draw from.
        rng: Chance.
    """
    true = rng.permutation(np.flatnonzero(problem.is_true))[: round(share * DILUTED_MATCHES)]
    false = round(len(true) * (1.0 / share - 1.0))
    size = np.array([problem.camera.width, problem.camera.height])
    return Problem(
        keypoints=np.vstack([problem.keypoints[true], rng.uniform(0.0, size, (false, 2))]),
        points=np.vstack([problem.points[true], rng.choice(problem.points, false)]),
        weights=np.concatenate([problem.weights[true], rng.choice(false_weights, false)]),
        nearest=np.concatenate([problem.nearest[true], rng.choice(problem.nearest, false)]),
        camera=problem.camera,
        camera_from_map=problem.camera_from_map,
    )


def _samplings(row: Row, seed: int) -> dict[str, PoseOptions]:
    """The ways to search, by name."""
    usual = PoseOptions()
    samplings = {}
    for name, guided in (('guided', True), ('uniform', False)):
        samplings[name] = PoseOptions(guided=guided, seed=seed)
        for cap in CAPS:
            samplings[f'{name}, at most {cap}'] = PoseOptions(
                min_iterations=min(usual.min_iterations, cap),
                max_iterations=cap,
                guided=guided,
                seed=seed,
            )
    for minimum in MINIMA if row[1] in EARLY_STOPS else ():
        samplings[f'guided, at least {minimum}'] = PoseOptions(min_iterations=minimum, seed=seed)
    return samplings


def _search(problem: Problem, options: PoseOptions) -> Trial:
    # of the processor: who else uses the machine does not matter
    begin = time.process_time()
    pose = estimate_pose(
        problem.keypoints,
        problem.points,
        problem.weights,
        problem.camera,
        options,
        problem.nearest,
    )
    milliseconds = 1e3 * (time.process_time() - begin)
    if pose is None:
        return Trial(options.max_iterations, milliseconds, None)
    error = pose_error(pose.camera_from_map, problem.camera_from_map)
    return Trial(pose.iterations, milliseconds, error)


def _tables() -> list[tuple[str, Sequence[str], dict[str, tuple[Sequence[str], Cell]]]]:
    """Titles, shares shown, and columns: the samplings that a cell compares, and what of them."""
    usual = PoseOptions()
    least, most = usual.min_iterations, usual.max_iterations
    both = ('guided', 'uniform')
    minima = (*(f'guided, at least {minimum}' for minimum in MINIMA), 'guided')
    capped = {
        f'at most {cap}': (tuple(f'{name}, at most {cap}' for name in both), _within)
        for cap in CAPS
    }
    shares = (AS_MATCHED, *map(_percent, TRUE_SHARES))
    return [
        (f'Guided / uniform, {least} to {most} samples:', shares, _columns(both)),
        (
            f'Guided / uniform, within {_NAME_OF_WITHIN}, by the greatest number of samples:',
            shares,
            {**capped, f'at most {most}': (both, _within)},
        ),
        (
            f'Guided, at least {" / ".join(map(str, (*MINIMA, least)))} samples:',
            EARLY_STOPS,
            _columns(minima),
        ),
    ]


def _columns(samplings: Sequence[str]) -> dict[str, tuple[Sequence[str], Cell]]:
    return {
        'samples': (samplings, _samples),
        'ms, refinement included': (samplings, _milliseconds),
        f'within {_NAME_OF_WITHIN}': (samplings, _within),
        'median cm': (samplings, _centimetres),
        'median deg': (samplings, _degrees),
        'nine of ten within cm': (samplings, _ninth_decile),
    }


def _samples(trials: Sequence[Trial]) -> str:
    return f'{np.median([trial.iterations for trial in trials]):.0f}'


def _milliseconds(trials: Sequence[Trial]) -> str:
    return f'{np.mean([trial.milliseconds for trial in trials]):.1f}'


def _within(trials: Sequence[Trial]) -> str:
    return f'{accuracy(_errors(trials), len(trials)).recall[WITHIN]:.0%}'


def _centimetres(trials: Sequence[Trial]) -> str:
    return f'{100 * accuracy(_errors(trials), len(trials)).median_position:.1f}'


def _degrees(trials: Sequence[Trial]) -> str:
    return f'{accuracy(_errors(trials), len(trials)).median_rotation_deg:.2f}'


def _ninth_decile(trials: Sequence[Trial]) -> str:
    positions = [np.inf if trial.error is None else trial.error.position for trial in trials]
    return f'{100 * np.quantile(positions, 0.9, method="nearest"):.1f}'


def _errors(trials: Sequence[Trial]) -> list[PoseError]:
    return [trial.error for trial in trials if trial.error is not None]


def _percent(share: float) -> str:
    return f'{share:.0%}'


def _table(
    rows: Sequence[Row],
    trials: dict[Row, dict[str, list[Trial]]],
    shares: dict[Row, list[float]],
    columns: dict[str, tuple[Sequence[str], Cell]],
) -> str:
    lines = [f'| matcher | true matches | searches | {" | ".join(columns)} |']
    lines.append('|---' * (3 + len(columns)) + '|')
    for row in sorted(rows, key=lambda row: MATCHERS.index(row[0])):
        cells = [
            ' / '.join(cell(trials[row][sampling]) for sampling in samplings)
            for samplings, cell in columns.values()
        ]
        true = _percent(float(np.mean(shares[row])))
        shown = f'{true}, {AS_MATCHED}' if row[1] == AS_MATCHED else true
        lines.append(f'| {" | ".join([row[0], shown, str(len(shares[row])), *cells])} |')
    return '\n'.join(lines)


if __name__ == '__main__':
    main()
