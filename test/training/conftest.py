# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from gam_relocalizer.mapping.colmap_model import NO_POINT
from gam_relocalizer.mapping.leave_one_out import ReferenceImage, ReferenceImages
from gam_relocalizer.scene_map import (
    ExtractorIdentity,
    FileEntry,
    Manifest,
    MapContent,
    MapFrame,
    map_in_memory,
)

DIMENSION = 16
CLUTTER = 60
CAMERA = pycolmap.Camera(
    model='SIMPLE_RADIAL', width=640, height=480, params=[500.0, 330.0, 235.0, 0.05]
)


def make_references(
    images: int = 24, points: int = 500, seed: int = 0, name: str = 'cloud'
) -> ReferenceImages:
    """A map of a cloud of points, seen all from one side by images with a little clutter.

    A keypoint is within half a pixel of where its point projects. The last image sees clutter only.
    """
    rng = np.random.default_rng(seed)
    positions = rng.uniform([-3, -2, 4], [3, 2, 8], (points, 3))
    looks = _unit(rng.normal(size=(points, DIMENSION)))
    poses = [_pose(rng) for _ in range(images)]
    described = [_image(pose, positions, looks, rng) for pose in poses[:-1]]
    described.append(_image(poses[-1], positions[:0], looks[:0], rng))
    seen = [np.sort(i.point_of_keypoint[i.point_of_keypoint != NO_POINT]) for i in described]
    sums = np.zeros((points, DIMENSION), np.float32)
    for image in described:
        observes = image.point_of_keypoint != NO_POINT
        sums[image.point_of_keypoint[observes]] += image.descriptors[observes]
    scene_map = map_in_memory(
        Path(name),
        MapContent(
            image_names=tuple(map(str, range(images))),
            camera_from_sfm=tuple(poses),
            points=positions,
            descriptors=_unit(sums).astype(np.float16),
            observation_offsets=np.cumsum([0, *map(len, seen)], dtype=np.int64),
            observation_points=np.concatenate(seen).astype(np.int32),
            global_descriptors=_unit(rng.normal(size=(images, 8))),
            codebook=np.zeros((1, DIMENSION), np.float32),
        ),
        Manifest(
            ExtractorIdentity('synthetic', DIMENSION, ''),
            'vlad',
            MapFrame(),
            {},
            files={'points.npy': FileEntry(1, f'{name} {seed}')},
        ),
    )
    return ReferenceImages(scene_map, tuple(described), sums)


def _pose(rng: np.random.Generator) -> pycolmap.Rigid3d:
    turn = Rotation.from_rotvec(rng.normal(0, 0.08, 3)).as_quat()
    return pycolmap.Rigid3d(pycolmap.Rotation3d(turn), rng.normal(0, 0.5, 3))


def _image(
    camera_from_map: pycolmap.Rigid3d,
    positions: np.ndarray,
    looks: np.ndarray,
    rng: np.random.Generator,
) -> ReferenceImage:
    places = np.asarray(CAMERA.img_from_cam(camera_from_map * positions)).reshape(-1, 2)
    inside = ((places >= 0) & (places < [CAMERA.width, CAMERA.height])).all(axis=1)
    sees = np.flatnonzero(inside & (rng.random(len(positions)) < 0.7))
    clutter = rng.uniform([0, 0], [CAMERA.width, CAMERA.height], (CLUTTER, 2))
    noisy = places[sees] + rng.uniform(-0.3, 0.3, (len(sees), 2))
    order = rng.permutation(len(sees) + CLUTTER)
    observed = looks[sees] + rng.normal(0, 0.08, (len(sees), DIMENSION))
    descriptors = np.concatenate([observed, rng.normal(size=(CLUTTER, DIMENSION))])
    return ReferenceImage(
        camera=CAMERA,
        keypoints=np.concatenate([noisy, clutter])[order].astype(np.float32),
        descriptors=_unit(descriptors)[order],
        point_of_keypoint=np.concatenate([sees, np.full(CLUTTER, NO_POINT)])[order],
    )


def _unit(rows: np.ndarray) -> np.ndarray:
    norms = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.asarray(rows / np.maximum(norms, 1e-9), np.float32)


@pytest.fixture(scope='session')
def references() -> ReferenceImages:
    """A small map of which all is known."""
    return make_references()


@pytest.fixture(scope='session')
def other_references() -> ReferenceImages:
    """Another small map."""
    return make_references(images=4, seed=1, name='other')


@pytest.fixture(scope='session')
def lonely_references() -> ReferenceImages:
    """A map whose images hold nothing to learn from."""
    return make_references(images=3, points=20, name='lonely')
