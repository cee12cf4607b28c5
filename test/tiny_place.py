# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from gam_relocalizer.cameras import parse_camera
from gam_relocalizer.demo import trajectories
from gam_relocalizer.demo.recording import (
    IMAGE_TOPIC,
    START_NS,
    record_mapping_pass,
    record_query_bag,
    robot_camera,
)
from gam_relocalizer.demo.world import tiny_world
from gam_relocalizer.geometry import read_poses
from gam_relocalizer.image_set import ImageSet
from gam_relocalizer.mapping.build import build_map
from gam_relocalizer.replay.bag import open_bag
from gam_relocalizer.replay.messages import image_in

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np
    import pycolmap
    from numpy.typing import NDArray

DRIVE_S = 4.0
QUERY_STEP = 5


@dataclass(frozen=True)
class TinyPlace:
    """One room with a map, and a robot's drive through it with known truth.

    Attributes:
        map_path: The map bundle; metric.
        bag: The drive as a rosbag2, with the topics of the demo.
        camera: The camera of the drive, a pinhole.
        queries: Some images of the drive, RGB [H,W,3], each with its camera_from_map.
    """

    map_path: Path
    bag: Path
    camera: pycolmap.Camera
    queries: tuple[tuple[NDArray[np.uint8], pycolmap.Rigid3d], ...]


def make_tiny_place(folder: Path) -> TinyPlace:
    """Renders a room, maps it, and drives through it."""
    world = tiny_world()
    recording, map_path, bag = folder / 'mapping', folder / 'map', folder / 'drive'
    record_mapping_pass(world, recording, workers=1)
    images = ImageSet.of_folder(
        recording / 'images',
        parse_camera(recording / 'camera.txt'),
        read_poses(recording / 'poses.txt'),
    )
    build_map(images, map_path)
    record_query_bag(world, bag, duration_s=DRIVE_S, workers=1)
    drive = trajectories.drive(world.drive_route)
    with open_bag(bag) as messages:
        images = [(m.stamp_ns, image_in(m)) for m in messages.messages([IMAGE_TOPIC])]
    queries = tuple(
        (image, drive.camera_from_map((stamp_ns - START_NS) / 1e9))
        for stamp_ns, image in images[::QUERY_STEP]
    )
    return TinyPlace(map_path, bag, robot_camera(), queries)
