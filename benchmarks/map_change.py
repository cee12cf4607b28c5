# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Extends, merges and prunes maps and localizes the query images in each; prints Markdown tables.

    python benchmarks/real_data.py DATA --out build/benchmarks     # the maps that are pruned
    python benchmarks/map_change.py DATA --maps build/benchmarks --out build/map_change

A set is a folder as in `real_data.py`. The rendered rooms of the demo stand for another light: they
are mapped by day, the queries are of an evening with other furniture about.
"""

from __future__ import annotations

import argparse
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pycolmap
from real_data import NOMINAL_CAMERAS

from gam_relocalizer.cameras import parse_camera
from gam_relocalizer.demo import recording, trajectories
from gam_relocalizer.demo.renderer import Renderer
from gam_relocalizer.demo.shipped import demo_map_path
from gam_relocalizer.demo.world import demo_world
from gam_relocalizer.evaluation.query_set import world_from_map_of
from gam_relocalizer.geometry import pose_error, read_poses, write_poses
from gam_relocalizer.image_set import ImageSet
from gam_relocalizer.images import list_images, read_image
from gam_relocalizer.localization.localizer import Localizer
from gam_relocalizer.mapping.build import MapBuildOptions, build_map
from gam_relocalizer.mapping.extend import extend_map
from gam_relocalizer.mapping.merge import merge_maps
from gam_relocalizer.mapping.prune import prune_map
from gam_relocalizer.scene_map import load_map, read_manifest

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from gam_relocalizer.mapping.report import BuildReport

CHANGED_SETS = ('redkitchen', 'fox')
PRUNED_SETS = ('redkitchen-poses', 'castle-p30-poses', 'fox-poses')
KEPT = (1.0, 0.5, 0.25, 0.1)
DEMO = 'demo'
# Truth of redkitchen is centimetres and a degree or two off.
RIGHT_POSITION, RIGHT_ROTATION_DEG = 0.25, 5.0
EVENING_SPACING = 1.6
EVENING_QUERIES = 45


@dataclass(frozen=True)
class Queries:
    """Images with the truth.

    Attributes:
        folder: Where they are.
        camera: That took them.
        truth: By name.
        mapping: True poses of the mapping images by name; None where the maps are in their frame.
    """

    folder: Path
    camera: pycolmap.Camera
    truth: Mapping[str, pycolmap.Rigid3d]
    mapping: Mapping[str, pycolmap.Rigid3d] | None = None


def main() -> None:
    """Runs all or some of it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('data', type=Path, help='folder of the image sets')
    parser.add_argument('--maps', type=Path, default=Path('build/benchmarks'))
    parser.add_argument('--out', type=Path, default=Path('build/map_change'))
    parser.add_argument('--parts', nargs='+', default=['extend', 'prune'])
    parser.add_argument('--sets', nargs='+', default=[*CHANGED_SETS, *PRUNED_SETS, DEMO])
    parser.add_argument('--kept', nargs='+', type=float, default=KEPT)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    if 'extend' in arguments.parts:
        _print_header('set', 'map', 'images', 'points', 'seconds', 'accepted', 'right')
        for name in [name for name in CHANGED_SETS if name in arguments.sets]:
            extend_and_merge(arguments.data / name, arguments.out / name)
        if DEMO in arguments.sets:
            extend_by_evening(arguments.out / 'evening')
    if 'prune' in arguments.parts:
        _print_header('map', 'keep', 'size', 'images', 'points', 'accepted', 'right')
        for name in [name for name in PRUNED_SETS if name in arguments.sets]:
            folder = arguments.data / name.removesuffix('-poses')
            camera = parse_camera(
                read_manifest(arguments.maps / name).build['report']['cameras'][0]
            )
            queries = Queries(folder / 'query', camera, read_poses(folder / 'poses_query.txt'))
            prune(name, arguments.maps / name, queries, arguments.out / 'small', arguments.kept)
        if DEMO in arguments.sets:
            queries = _evening_queries(arguments.out / 'evening')
            prune(DEMO, demo_map_path(), queries, arguments.out / 'small', arguments.kept)


def extend_and_merge(folder: Path, out: Path) -> None:
    """Maps both halves of a set, joins them in three ways, and localizes the queries in each."""
    names = list_images(folder / 'mapping')
    halves = names[: len(names) // 2], names[len(names) // 2 :]
    camera = parse_camera(folder / 'camera.txt')
    mapping = read_poses(folder / 'poses_mapping.txt')
    seconds: dict[str, float] = {}

    def build(which: str, some: Sequence[str], options: MapBuildOptions) -> BuildReport:
        begin = time.monotonic()
        images = ImageSet(folder / 'mapping', tuple(some), dict.fromkeys(some, camera))
        report = build_map(images, out / which, options)
        seconds[which] = time.monotonic() - begin
        return report

    nominal = folder.name in NOMINAL_CAMERAS
    rebuilt = build('rebuilt', names, MapBuildOptions(refine_camera=nominal))
    # half of the images may not do to calibrate the camera that took them
    camera = parse_camera(rebuilt.cameras[0])
    for which, some in zip(('first half', 'second half'), halves, strict=True):
        build(which, some, MapBuildOptions())
    begin = time.monotonic()
    extend_map(out / 'first half', ImageSet(folder / 'mapping', tuple(halves[1])), out / 'extended')
    seconds['extended'] = time.monotonic() - begin
    begin = time.monotonic()
    merge_maps(out / 'first half', out / 'second half', out / 'merged')
    seconds['merged'] = time.monotonic() - begin
    for name in ('first half', 'second half', 'extended', 'merged', 'rebuilt'):
        report = read_manifest(out / name).build['report']
        queries = Queries(
            folder / 'query',
            parse_camera(report['cameras'][0]),
            read_poses(folder / 'poses_query.txt'),
            mapping,
        )
        _print_map(folder.name, name, out / name, seconds[name], queries)


def extend_by_evening(out: Path) -> None:
    """Adds an evening's pass to the demo's map."""
    queries = _evening_queries(out)
    world = demo_world(rearranged=True)
    views = trajectories.mapping_views(world.mapping_route, spacing=EVENING_SPACING)
    poses = {f'evening-{index:04d}.png': view for index, view in enumerate(views)}
    _render(out / 'pass', recording.mapping_camera(), poses)
    images = ImageSet.of_folder(out / 'pass', recording.mapping_camera())
    begin = time.monotonic()
    extend_map(demo_map_path(), images, out / 'extended')
    seconds = time.monotonic() - begin
    _print_map('demo, evening', 'by day', demo_map_path(), 0.0, queries)
    _print_map('demo, evening', 'extended', out / 'extended', seconds, queries)
    scene_map = load_map(out / 'extended')
    errors = [
        pose_error(pose, poses[name])
        for name, pose in zip(scene_map.image_names, scene_map.camera_from_map, strict=True)
        if name in poses
    ]
    median = np.median([[error.position, error.rotation_deg] for error in errors], axis=0)
    print(
        f'\n{len(errors)} of {len(poses)} evening images registered, '
        f'{100 * median[0]:.1f} cm, {median[1]:.2f} deg in the median'
    )


def prune(name: str, path: Path, queries: Queries, out: Path, kept: Sequence[float]) -> None:
    """Prunes a map to several sizes and localizes the queries in each."""
    _print_pruned(name, '-', path, path, queries)
    for keep in kept:
        small = out / f'{name}-{keep:g}'
        prune_map(path, small, keep)
        _print_pruned(name, f'{keep:g}', small, path, queries)


def _evening_queries(out: Path) -> Queries:
    world = demo_world(rearranged=True)
    drive = trajectories.drive(world.drive_route)
    times = np.linspace(0.0, drive.duration, EVENING_QUERIES)
    poses = {f'{index:04d}.png': drive.camera_from_map(t) for index, t in enumerate(times)}
    camera = recording.robot_camera()
    _render(out / 'query', camera, poses)
    return Queries(out / 'query', camera, poses)


def _render(folder: Path, camera: pycolmap.Camera, poses: Mapping[str, pycolmap.Rigid3d]) -> None:
    """Writes images of the demo's rooms in the evening; those of an earlier run are kept."""
    if (folder.parent / f'{folder.name}.txt').is_file():
        return
    world = demo_world(rearranged=True)
    renderer = Renderer(world, recording.drive_appearance(world))
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for seed, (name, view) in enumerate(poses.items()):
        image = renderer.render(camera, [view], 20_000 + seed)
        cv2.imwrite(str(folder / name), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    write_poses(folder.parent / f'{folder.name}.txt', poses)


def _score(path: Path, queries: Queries) -> tuple[int, int, int]:
    """Queries, those accepted, and those of them at the right pose."""
    localizer = Localizer.load(path)
    world_from_map = (
        pycolmap.Sim3d()
        if queries.mapping is None
        else world_from_map_of(localizer.scene_map, queries.mapping)
    )
    accepted = right = 0
    for name in queries.truth:
        result = localizer.localize(read_image(queries.folder / name), queries.camera)
        if not result.accepted or result.estimate is None:
            continue
        accepted += 1
        pose = world_from_map.transform_camera_world(result.estimate.camera_from_map)
        error = pose_error(pose, queries.truth[name])
        right += error.position <= RIGHT_POSITION and error.rotation_deg <= RIGHT_ROTATION_DEG
    return len(queries.truth), accepted, right


def _print_map(name: str, which: str, path: Path, seconds: float, queries: Queries) -> None:
    counts = read_manifest(path).counts
    total, accepted, right = _score(path, queries)
    spent = f'{seconds:.0f}' if seconds else '-'
    _print_row(name, which, counts['images'], counts['points'], spent, f'{accepted}/{total}', right)


def _print_pruned(name: str, keep: str, path: Path, whole: Path, queries: Queries) -> None:
    counts = read_manifest(path).counts
    total, accepted, right = _score(path, queries)
    share = _size(path) / _size(whole)
    _print_row(
        name,
        keep,
        f'{_size(path) / 1e6:.2f} MB, {share:.0%}',
        counts['images'],
        counts['points'],
        f'{accepted}/{total}',
        right,
    )


def _size(path: Path) -> int:
    files = read_manifest(path).files
    return sum(entry.size for name, entry in files.items() if not name.startswith('sfm/'))


def _print_header(*cells: str) -> None:
    _print_row(*cells)
    _print_row(*['---'] * len(cells))


def _print_row(*cells: object) -> None:
    print(f'| {" | ".join(map(str, cells))} |', flush=True)


if __name__ == '__main__':
    main()
