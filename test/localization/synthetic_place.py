# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""A made-up room whose every number is known: points with descriptors, seen by a ring of cameras.

Images of it are drawn as numbers, not as pixels: the first bytes of an image are the number of a
view, and the extractor answers with that view's features.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from gam_relocalizer.features.local import LocalFeatures
from gam_relocalizer.features.vlad import RETRIEVAL_NAME, Vlad
from gam_relocalizer.geometry import rigid3d_from_rotation
from gam_relocalizer.scene_map import (
    ExtractorIdentity,
    Manifest,
    MapContent,
    MapFrame,
    SceneMap,
    load_map,
    map_in_memory,
    save_map,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

IDENTITY = ExtractorIdentity('synthetic', 64, 'none')
CAMERA = pycolmap.Camera(
    camera_id=1, model='PINHOLE', width=640, height=480, params=[500, 505, 318, 243]
)
NUM_IMAGES = 24


def unit_rows(rows: np.ndarray) -> np.ndarray:
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


class Place:
    """Points on the walls of a room, with descriptors."""

    def __init__(self, seed: int = 0, num_points: int = 6000) -> None:
        rng = np.random.default_rng(seed)
        self.points = rng.uniform(-1.0, 1.0, (num_points, 3)) * [6.0, 5.0, 2.0]
        wall = rng.integers(2, size=num_points)
        side = rng.choice([-1.0, 1.0], num_points) * np.array([6.0, 5.0])[wall]
        self.points[np.arange(num_points), wall] = side + rng.normal(0.0, 0.3, num_points)
        self.descriptors = unit_rows(rng.normal(size=(num_points, 64))).astype(np.float32)

    def seen_by(
        self, camera_from_map: pycolmap.Rigid3d, camera: pycolmap.Camera = CAMERA
    ) -> tuple[np.ndarray, np.ndarray]:
        """Indices [K] of the visible points and their pixels [K,2]."""
        in_camera = camera_from_map * self.points
        front = np.flatnonzero(in_camera[:, 2] > 0.5)
        pixels = np.asarray(camera.img_from_cam(in_camera[front]))
        inside = ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1)
        return front[inside], pixels[inside]


def looking(yaw: float, position: np.ndarray, pitch: float = 0.0) -> pycolmap.Rigid3d:
    """camera_from_map of a camera that looks along a horizontal direction (z is up)."""
    optical_from_level = Rotation.from_matrix([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    rotation = optical_from_level * Rotation.from_euler('yz', [pitch, -yaw])
    return rigid3d_from_rotation(rotation, -rotation.apply(position))


def ring_pose(index: int) -> pycolmap.Rigid3d:
    yaw = 2.0 * np.pi * index / NUM_IMAGES
    return looking(yaw, np.array([np.cos(yaw), np.sin(yaw), 0.1 * np.sin(3 * yaw)]))


def query_pose(index: int) -> pycolmap.Rigid3d:
    rng = np.random.default_rng(1000 + index)
    yaw = rng.uniform(0.0, 2.0 * np.pi)
    return looking(yaw, rng.normal(0.0, 0.5, 3) * [1.0, 1.0, 0.2], rng.normal(0.0, 0.1))


def features_of(
    place: Place,
    camera_from_map: pycolmap.Rigid3d,
    seed: int,
    camera: pycolmap.Camera = CAMERA,
    clutter: int = 100,
) -> LocalFeatures:
    """Noisy features of a view: one pixel, blurred descriptors, and some that match nothing."""
    rng = np.random.default_rng(seed)
    visible, pixels = place.seen_by(camera_from_map, camera)
    keypoints = np.vstack(
        [
            pixels + rng.normal(0.0, 1.0, pixels.shape),
            rng.uniform([0, 0], [camera.width, camera.height], (clutter, 2)),
        ]
    )
    descriptors = np.vstack(
        [
            place.descriptors[visible] + rng.normal(0.0, 0.04, (len(visible), 64)),
            rng.normal(size=(clutter, 64)),
        ]
    )
    return LocalFeatures(
        keypoints=keypoints.astype(np.float32),
        descriptors=unit_rows(descriptors).astype(np.float32),
        scores=np.linspace(1.0, 0.5, len(keypoints)).astype(np.float32),
    )


class ViewExtractor:
    """Looks up features by the number that `image_of` wrote into the image."""

    identity = IDENTITY

    def __init__(self, views: dict[int, LocalFeatures]) -> None:
        self._views = views

    def extract(self, image: np.ndarray) -> LocalFeatures:
        return self._views[int(image.flat[0]) + 256 * int(image.flat[1])]


def image_of(view: int, camera: pycolmap.Camera = CAMERA) -> np.ndarray:
    image = np.zeros((camera.height, camera.width), np.uint8)
    image.flat[:2] = [view % 256, view // 256]
    return image


def no_features() -> LocalFeatures:
    return LocalFeatures(
        np.zeros((0, 2), np.float32), np.zeros((0, 64), np.float32), np.zeros(0, np.float32)
    )


def twin_of(place: Place, offset: np.ndarray) -> tuple[Place, list[pycolmap.Rigid3d]]:
    """The place and, at an offset, the same place again; and the rings of both."""
    twins = Place()
    twins.points = np.vstack([place.points, place.points + offset])
    twins.descriptors = np.vstack([place.descriptors, place.descriptors])
    back = pycolmap.Rigid3d(rotation=pycolmap.Rotation3d(), translation=-offset)
    ring = [ring_pose(index) for index in range(NUM_IMAGES)]
    return twins, [*ring, *(pose * back for pose in ring)]


def bare_map(
    points: np.ndarray, poses: Sequence[pycolmap.Rigid3d], seen: Sequence[np.ndarray]
) -> SceneMap:
    """A map of points, and of which of them each camera sees; nothing looks like anything."""
    return map_in_memory(
        Path('nowhere'),
        MapContent(
            image_names=tuple(f'{index:03}.png' for index in range(len(poses))),
            camera_from_sfm=tuple(poses),
            points=points,
            descriptors=np.zeros((len(points), 64), np.float16),
            observation_offsets=np.cumsum([0, *map(len, seen)], dtype=np.int64),
            observation_points=np.concatenate(seen).astype(np.int32),
            global_descriptors=np.zeros((len(poses), 16), np.float32),
            codebook=np.zeros((0, 64), np.float32),
        ),
        Manifest(IDENTITY, RETRIEVAL_NAME, MapFrame(), {}),
    )


def save_place(
    path: Path,
    place: Place,
    map_frame: MapFrame | None = None,
    poses: list[pycolmap.Rigid3d] | None = None,
) -> SceneMap:
    """Saves reference images, the ring if no others are given, as a map bundle and loads it."""
    poses = poses or [ring_pose(index) for index in range(NUM_IMAGES)]
    seen = [place.seen_by(pose)[0] for pose in poses]
    everything = np.vstack([place.descriptors[visible] for visible in seen])
    vlad = Vlad.train(everything, words=16)
    content = MapContent(
        image_names=tuple(f'{index:03}.png' for index in range(len(poses))),
        camera_from_sfm=tuple(poses),
        points=place.points,
        descriptors=place.descriptors,
        observation_offsets=np.cumsum([0, *map(len, seen)], dtype=np.int64),
        observation_points=np.concatenate(seen).astype(np.int32),
        global_descriptors=np.array(
            [vlad.aggregate(place.descriptors[visible]) for visible in seen], np.float32
        ),
        codebook=vlad.codebook,
    )
    counts: dict[str, int] = {}
    save_map(
        path, content, Manifest(IDENTITY, RETRIEVAL_NAME, map_frame or MapFrame(), counts), None
    )
    return load_map(path)
