# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Maps real image sets, localizes their query images, prints a Markdown table.

A set is a folder with `mapping/`, `query/`, `camera.txt`, and true poses in `poses_mapping.txt` and
`poses_query.txt` (`name qw qx qy qz tx ty tz`, camera_from_world). Each set is mapped twice: with
the true poses of the mapping images (triangulation only), and from images alone (structure from
motion; the map is then laid over the truth by the similarity that fits the mapping cameras best).

    python benchmarks/real_data.py DATA --out build/benchmarks
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.cameras import parse_camera
from gam_relocalizer.evaluation.metrics import accuracy
from gam_relocalizer.evaluation.query_set import world_from_map_of
from gam_relocalizer.geometry import PoseError, pose_error, read_poses
from gam_relocalizer.image_set import ImageSet
from gam_relocalizer.images import list_images, read_image
from gam_relocalizer.localization.localizer import Localizer
from gam_relocalizer.mapping.build import MapBuildOptions, build_map

if TYPE_CHECKING:
    from collections.abc import Mapping

    from gam_relocalizer.localization.result import LocalizationResult
    from gam_relocalizer.mapping.report import BuildReport

SETS = ('redkitchen', 'castle-p30', 'fountain-p11', 'fox')
# The calibration that comes with these is nominal; structure from motion refines it.
NOMINAL_CAMERAS = frozenset({'redkitchen'})
STAGES = ('extraction', 'retrieval', 'matching', 'pose', 'verdict', 'total')


@dataclass(frozen=True)
class Outcome:
    """One row of the table."""

    name: str
    mapped_from: str
    report: BuildReport
    results: Mapping[str, LocalizationResult]
    errors: tuple[PoseError, ...]


def main() -> None:
    """Runs every set both ways."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('data', type=Path, help='folder of the image sets')
    parser.add_argument('--out', type=Path, default=Path('build/benchmarks'), help='for the maps')
    parser.add_argument('--sets', nargs='+', default=SETS)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    outcomes = [
        _run(arguments.data / name, arguments.out / f'{name}-{mapped_from}', mapped_from)
        for name in arguments.sets
        for mapped_from in ('poses', 'images')
    ]
    print(_table(outcomes))


def map_set(folder: Path, map_path: Path, mapped_from: str) -> BuildReport:
    """Builds the map of a set from its `poses`, or from `images` alone."""
    images = ImageSet.of_folder(
        folder / 'mapping',
        parse_camera(folder / 'camera.txt'),
        read_poses(folder / 'poses_mapping.txt') if mapped_from == 'poses' else None,
    )
    options = MapBuildOptions(refine_camera=folder.name in NOMINAL_CAMERAS)
    return build_map(images, map_path, options)


def _run(folder: Path, map_path: Path, mapped_from: str) -> Outcome:
    """Maps a set and localizes its queries."""
    report = map_set(folder, map_path, mapped_from)
    truth = read_poses(folder / 'poses_query.txt')
    camera = parse_camera(report.cameras[0])
    localizer = Localizer.load(map_path)
    true_mapping = read_poses(folder / 'poses_mapping.txt')
    world_from_map = world_from_map_of(localizer.scene_map, true_mapping)
    results = {
        name: localizer.localize(read_image(folder / 'query' / name), camera)
        for name in list_images(folder / 'query')
    }
    poses = {
        name: world_from_map.transform_camera_world(result.estimate.camera_from_map)
        for name, result in results.items()
        if result.accepted and result.estimate is not None
    }
    errors = tuple(pose_error(poses[name], truth[name]) for name in poses)
    print(f'{folder.name} from {mapped_from}: {len(errors)} of {len(results)}', flush=True)
    return Outcome(folder.name, mapped_from, report, results, errors)


def _table(outcomes: list[Outcome]) -> str:
    header = (
        '| set | mapped from | images | points | track | px | localized | median error '
        '| within 5 cm / 5 deg | 10 cm / 5 deg | 25 cm / 2 deg | ms: '
        f'{" / ".join(STAGES)} |'
    )
    rows = [_row(outcome) for outcome in outcomes]
    return '\n'.join([header, '|---' * 12 + '|', *rows])


def _row(outcome: Outcome) -> str:
    report, found = outcome.report, accuracy(outcome.errors, len(outcome.results))
    recalls = list(found.recall.values())[:3]
    milliseconds = [
        float(np.median([getattr(result.timings, stage) for result in outcome.results.values()]))
        for stage in STAGES
    ]
    cells = [
        outcome.name,
        outcome.mapped_from,
        f'{report.images_registered}/{report.images_given}',
        str(report.points),
        f'{report.mean_track_length:.1f}',
        f'{report.mean_reprojection_error:.2f}',
        f'{found.localized}/{found.queries}',
        f'{100 * found.median_position:.1f} cm, {found.median_rotation_deg:.2f} deg',
        *(f'{recall:.0%}' for recall in recalls),
        ' / '.join(f'{value:.0f}' for value in milliseconds),
    ]
    return f'| {" | ".join(cells)} |'


if __name__ == '__main__':
    main()
