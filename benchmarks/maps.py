# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Builds a map of every image set, video and bag below a folder; prints a Markdown table.

Each map is built from images alone, by the very commands that a user types. Where true poses of the
mapping images exist (`poses_mapping.txt`) the map is laid into their frame by `map align`, and the
residuals are how far structure from motion and the truth are apart; a bag aligns its map by itself.
`map check` then localizes the reference images in the map without them.

    python benchmarks/maps.py DATA --out build/maps
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gam_relocalizer.mapping.coverage import Standing
from gam_relocalizer.mapping.workspace import workspace_of
from gam_relocalizer.scene_map import SFM, load_map, read_manifest

if TYPE_CHECKING:
    from collections.abc import Mapping

# The calibration that comes with these is nominal; structure from motion refines it.
NOMINAL_CAMERAS = frozenset({'redkitchen'})
# Poses of the camera itself, which no topic's type tells.
WHEREABOUTS = {'redkitchen-query_bag': ('--odom-topic', '/ground_truth/pose', '--base-frame', '')}
COLUMNS = (
    'source',
    'images',
    'in the map',
    'points',
    'seen by',
    'px',
    'minutes',
    'bytes per point',
    'load',
    'alignment: used, residual median / largest',
    'scale known to',
    'found again, wrong',
)


@dataclass(frozen=True)
class Source:
    """What a map is built from.

    Attributes:
        name: Of the row.
        options: Of `map build`.
        images: Folder of the images; None where the build chooses keyframes.
        poses: True poses of the images, when they are known.
    """

    name: str
    options: tuple[str, ...]
    images: Path | None = None
    poses: Path | None = None


def main() -> None:
    """Builds, aligns and checks one map after the other."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('data', type=Path, help='folder of image sets, bags and videos')
    parser.add_argument('--out', type=Path, default=Path('build/maps'), help='for the maps')
    parser.add_argument('--only', nargs='*', help='names of rows')
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    print(f'| {" | ".join(COLUMNS)} |\n|{"---|" * len(COLUMNS)}', flush=True)
    for source in _sources(arguments.data):
        if not arguments.only or source.name in arguments.only:
            print(f'| {" | ".join(_row(source, arguments.out / source.name))} |', flush=True)


def _sources(data: Path) -> list[Source]:
    sets = sorted(file.parent for file in data.glob('*/camera.txt'))
    bags = sorted(file.parent for file in data.glob('*/*/metadata.yaml'))
    return [
        *(_image_set(folder) for folder in sets),
        *(_bag(folder) for folder in bags),
        *(Source(video.stem, ('--video', str(video))) for video in sorted(data.glob('**/*.mp4'))),
    ]


def _image_set(folder: Path) -> Source:
    refined = ('--refine-camera',) if folder.name in NOMINAL_CAMERAS else ()
    images = folder / 'mapping'
    options = ('--images', str(images), '--camera', str(folder / 'camera.txt'), *refined)
    return Source(folder.name, options, images, folder / 'poses_mapping.txt')


def _bag(folder: Path) -> Source:
    name = f'{folder.parent.name}-{folder.name}'
    return Source(name, ('--bag', str(folder), *WHEREABOUTS.get(name, ())))


def _row(source: Source, path: Path) -> list[str]:
    work = workspace_of(path)
    for folder in (path, work):
        shutil.rmtree(folder, ignore_errors=True)
    begin = time.monotonic()
    _run('build', *source.options, '--out', str(path))
    minutes = (time.monotonic() - begin) / 60.0
    if source.poses is not None:
        _run('align', str(path), '--poses', str(source.poses))
    images = source.images or next((work / 'keyframes').iterdir())
    checked = json.loads(_run('check', str(path), '--images', str(images), '--json'))
    return [source.name, *_built(path, minutes), *_aligned(path), _found_again(checked)]


def _run(command: str, *arguments: str) -> str:
    """What a `map` command prints on stdout."""
    words = (sys.executable, '-m', 'gam_relocalizer', 'map', command, *arguments)
    done = subprocess.run(words, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode and command != 'check':
        sys.exit(f'{" ".join(words)}: exit code {done.returncode}')
    return done.stdout


def _built(path: Path, minutes: float) -> list[str]:
    manifest = read_manifest(path)
    report = manifest.build['report']
    size = sum(entry.size for name, entry in manifest.files.items() if not name.startswith(SFM))
    begin = time.monotonic()
    load_map(path)
    load_ms = 1000.0 * (time.monotonic() - begin)
    return [
        f'{report["images_given"]}',
        f'{report["images_registered"]}',
        f'{report["points"]}',
        f'{report["mean_track_length"]:.1f}',
        f'{report["mean_reprojection_error"]:.2f}',
        f'{minutes:.1f}',
        f'{size / report["points"]:.0f}',
        f'{load_ms:.0f} ms',
    ]


def _aligned(path: Path) -> list[str]:
    alignment = read_manifest(path).alignment
    if not alignment:
        return ['-', '-']
    median, largest = alignment['residual_median'], alignment['residual_max']
    return [
        f'{alignment["method"]}: {alignment["inliers"]} of {alignment["matched"]}, '
        f'{100 * median:.1f} / {100 * largest:.1f} cm',
        f'{100 * alignment["scale_sigma"]:.2f} %',
    ]


def _found_again(checked: Mapping[str, Any]) -> str:
    coverage = Counter(image['standing'] for image in checked['coverage']['images'])
    wrong = coverage[Standing.WRONG.value]
    found = coverage[Standing.FOUND.value] + coverage[Standing.WEAK.value]
    return f'{found} of {coverage.total()}, {wrong}'


if __name__ == '__main__':
    main()
