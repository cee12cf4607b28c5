# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The images that `adversaries.py` queries: of the real sets, of walks, and rendered ones."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from real_data import SETS, map_set

from gam_relocalizer.cameras import format_camera
from gam_relocalizer.demo import adversarial_worlds, recording, trajectories
from gam_relocalizer.demo.renderer import Renderer
from gam_relocalizer.demo.world import demo_world, tiny_world
from gam_relocalizer.evaluation.adversaries import ADVERSARIES
from gam_relocalizer.evaluation.exact_map import KnownImage, save_exact_map
from gam_relocalizer.features.registry import create_extractor
from gam_relocalizer.geometry import read_poses, write_poses
from gam_relocalizer.images import list_images, read_image
from gam_relocalizer.scene_map import load_map

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from concurrent.futures import Future, ProcessPoolExecutor
    from pathlib import Path

    import pycolmap

    from gam_relocalizer.demo.renderer import Appearance
    from gam_relocalizer.demo.world import World

EXTRACTOR = 'xfeat'
DEMO, CORRIDOR = 'demo', 'corridor'
MIXED_UP = 'mixed-up-descriptors'
# Both were taken in one courtyard, it seems: an image of one may well be localized in the other.
SAME_PLACE = frozenset({('castle-p30', 'fountain-p11'), ('fountain-p11', 'castle-p30')})
# The same black image again and again would be no further evidence.
FEW, FEW_IMAGES = ('black', 'white'), 3
FRAMES_PER_WALK = 5
MAPPING_IMAGES_ELSEWHERE = 15
WALK_CAMERA_FOCAL = 1.2


@dataclass(frozen=True)
class Job:
    """One image, and what is to be done with it.

    Attributes:
        source: Which kind of image, for the table; unspoilt queries go by this name.
        path: The image.
        camera: COLMAP's one-line form.
        home: Name of the map of the place it shows, or empty.
        truth: `camera_from_map` there as [3,4] nested lists.
        spoilt_by: Adversaries to try at home, `MIXED_UP` included.
        elsewhere: Maps of other places to try.
    """

    source: str
    path: Path
    camera: str
    home: str = ''
    truth: tuple[tuple[float, ...], ...] | None = None
    spoilt_by: tuple[str, ...] = ()
    elsewhere: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Rendering:
    """A world and views of it."""

    world: World
    appearance: Appearance
    views: Sequence[pycolmap.Rigid3d]


def _renderings() -> dict[str, tuple[str, int]]:
    """Name of a group of rendered images: name of its map or empty, number of images."""
    return {
        'moved-furniture': (DEMO, 45),
        'random-views': (DEMO, 60),
        'single-picture': (DEMO, 40),
        'redecorated': (DEMO, 45),
        'another-room': ('', 45),
        'identical-doors': (CORRIDOR, 60),
        'along-the-corridor': (CORRIDOR, 30),
        'ends-of-the-corridor': (CORRIDOR, 30),
    }


def _rendering(name: str, count: int) -> _Rendering:
    """The views of a group; the same ones every time."""
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    if name in {'identical-doors', 'along-the-corridor', 'ends-of-the-corridor'}:
        world = adversarial_worlds.corridor_world()
        views = {
            'identical-doors': adversarial_worlds.bay_views,
            'along-the-corridor': adversarial_worlds.along_views,
            'ends-of-the-corridor': adversarial_worlds.end_views,
        }[name](world, count, rng)
        return _Rendering(world, recording.mapping_appearance(world), views)
    if name == 'another-room':
        world = tiny_world(seed=1)
        return _Rendering(
            world,
            recording.mapping_appearance(world),
            adversarial_worlds.random_views(world, count, rng),
        )
    world = demo_world(seed=int(name == 'redecorated'), rearranged=True)
    if name == 'random-views':
        views = adversarial_worlds.random_views(world, count, rng)
    elif name == 'single-picture':
        every = adversarial_worlds.picture_views(world, recording.robot_camera(), rng)
        views = [every[index] for index in sorted(rng.permutation(len(every))[:count])]
    else:
        drive = trajectories.drive(world.drive_route)
        views = [drive.camera_from_map(t) for t in np.linspace(0.0, drive.duration, count)]
    return _Rendering(world, recording.drive_appearance(world), views)


def _render(name: str, count: int, folder: Path) -> None:
    """Writes `images/*.png` and, last of all, `poses.txt`."""
    rendering, camera = _rendering(name, count), recording.robot_camera()
    renderer = Renderer(rendering.world, rendering.appearance)
    (folder / 'images').mkdir(parents=True, exist_ok=True)
    poses = {f'{index:04d}.png': view for index, view in enumerate(rendering.views)}
    for seed, (image_name, view) in enumerate(poses.items()):
        image = renderer.render(camera, [view], 10_000 + seed)
        cv2.imwrite(str(folder / 'images' / image_name), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    write_poses(folder / 'poses.txt', poses)


def _map_corridor(map_path: Path) -> None:
    world = adversarial_worlds.corridor_world()
    renderer = Renderer(world, recording.mapping_appearance(world))
    camera = recording.mapping_camera()
    images = [
        KnownImage(renderer.render(camera, [view], seed), renderer.depth(camera, view), view)
        for seed, view in enumerate(adversarial_worlds.corridor_walk(world))
    ]
    save_exact_map(map_path, images, camera, create_extractor(EXTRACTOR))


def _cut_frames(walks: Path, folder: Path) -> None:
    """Writes frames spread evenly over the videos to `images/`; `folder` is there when all are."""
    temporary = folder.with_name(f'.{folder.name}.part')
    (temporary / 'images').mkdir(parents=True, exist_ok=True)
    for video in sorted(walks.glob('*.mp4')):
        capture = cv2.VideoCapture(str(video))
        count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        for index in np.linspace(0, count - 1, FRAMES_PER_WALK + 2).astype(int)[1:-1]:
            capture.set(cv2.CAP_PROP_POS_FRAMES, int(index))
            is_read, frame = capture.read()
            if is_read:
                name = f'{video.stem}_{index:05d}.png'
                cv2.imwrite(str(temporary / 'images' / name), frame)
    temporary.rename(folder)


def prepare(data: Path, out: Path, maps: Path, workers: ProcessPoolExecutor) -> list[Job]:
    """Renders and maps what is missing, and says what is to be localized."""
    missing: list[Future[object]] = [
        workers.submit(_render, name, count, out / 'renders' / name)
        for name, (_, count) in _renderings().items()
        if not (out / 'renders' / name / 'poses.txt').is_file()
    ]
    if not (out / 'corridor_map').is_dir():
        missing.append(workers.submit(_map_corridor, out / 'corridor_map'))
    missing += [
        workers.submit(map_set, data / name, maps / f'{name}-poses', 'poses')
        for name in SETS
        if not (maps / f'{name}-poses').is_dir()
    ]
    if not (out / 'walks').is_dir():
        missing.append(workers.submit(_cut_frames, data / 'walks', out / 'walks'))
    for step in missing:
        step.result()
    return [
        *(job for name in SETS for job in _jobs_of_set(data / name, maps / f'{name}-poses')),
        *_jobs_of_walks(out / 'walks' / 'images'),
        *(
            job
            for name in _renderings()
            for job in _jobs_of_rendering(name, out / 'renders' / name)
        ),
    ]


def _jobs_of_set(folder: Path, map_path: Path) -> Iterator[Job]:
    """Queries at home, spoilt and elsewhere; mapping images elsewhere."""
    camera = str(load_map(map_path).manifest.build['report']['cameras'][0])
    truth = read_poses(folder / 'poses_query.txt')
    elsewhere = tuple(
        name
        for name in (*SETS, DEMO, CORRIDOR)
        if name != folder.name and (name, folder.name) not in SAME_PLACE
    )
    for index, name in enumerate(list_images(folder / 'query')):
        yield Job(
            'real',
            folder / 'query' / name,
            camera,
            folder.name,
            _as_rows(truth[name]),
            _spoilers(index),
            elsewhere,
        )
    names = list_images(folder / 'mapping')
    rng = np.random.default_rng(zlib.crc32(folder.name.encode()))
    for index in sorted(rng.permutation(len(names))[:MAPPING_IMAGES_ELSEWHERE]):
        path = folder / 'mapping' / names[index]
        yield Job('mapping', path, camera, elsewhere=elsewhere)


def _jobs_of_walks(folder: Path) -> Iterator[Job]:
    for path in sorted(folder.glob('*.png')):
        height, width = read_image(path).shape[:2]
        focal = WALK_CAMERA_FOCAL * max(height, width)
        camera = f'SIMPLE_PINHOLE {width} {height} {focal} {width / 2} {height / 2}'
        yield Job('walk', path, camera, elsewhere=(*SETS, DEMO, CORRIDOR))


def _jobs_of_rendering(name: str, folder: Path) -> Iterator[Job]:
    home, _ = _renderings()[name]
    camera = format_camera(recording.robot_camera())
    for index, (image_name, pose) in enumerate(read_poses(folder / 'poses.txt').items()):
        path = folder / 'images' / image_name
        if not home:
            yield Job(name, path, camera, elsewhere=(DEMO, CORRIDOR, *SETS[:1]))
            continue
        spoilt = name == 'moved-furniture' or (home == CORRIDOR and index % 3 == 0)
        yield Job(
            name,
            path,
            camera,
            home,
            _as_rows(pose),
            _spoilers(index) if spoilt else (),
            (CORRIDOR if home == DEMO else DEMO,) if index % 3 == 0 else (),
        )


def _spoilers(index: int) -> tuple[str, ...]:
    names = [name for name in ADVERSARIES if name not in FEW or index < FEW_IMAGES]
    return (*names, MIXED_UP)


def _as_rows(pose: pycolmap.Rigid3d) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in pose.matrix().tolist())
