# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import pytest
from corner_room import CAMERA, write_room_images

from gam_relocalizer.image_set import ImageSet
from gam_relocalizer.mapping.build import MapBuildOptions, build_map

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    import pycolmap

    from gam_relocalizer.mapping.report import BuildReport


@dataclass(frozen=True)
class Room:
    """Images of a room with their true poses, camera_from_room."""

    images: Path
    poses: Mapping[str, pycolmap.Rigid3d]


@dataclass(frozen=True)
class BuiltMap:
    """A map and what its build reported."""

    path: Path
    report: BuildReport


@pytest.fixture(scope='session')
def room(tmp_path_factory: pytest.TempPathFactory) -> Room:
    folder = tmp_path_factory.mktemp('room') / 'images'
    return Room(folder, write_room_images(folder, count=8))


@pytest.fixture(scope='session')
def posed_map(room: Room, tmp_path_factory: pytest.TempPathFactory) -> BuiltMap:
    """Built from images, camera and poses."""
    path = tmp_path_factory.mktemp('maps') / 'posed'
    images = ImageSet.of_folder(room.images, CAMERA, room.poses)
    return BuiltMap(path, build_map(images, path, MapBuildOptions(max_keypoints=600)))


@pytest.fixture(scope='session')
def free_map(room: Room, tmp_path_factory: pytest.TempPathFactory) -> BuiltMap:
    """Built from images and camera alone."""
    path = tmp_path_factory.mktemp('maps') / 'free'
    images = ImageSet.of_folder(room.images, CAMERA)
    return BuiltMap(path, build_map(images, path, MapBuildOptions(max_keypoints=600)))
