# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from gam_relocalizer.cameras import format_camera, parse_camera
from gam_relocalizer.errors import CameraError
from gam_relocalizer.features.local import LocalFeatures
from gam_relocalizer.image_set import ImageSet
from gam_relocalizer.mapping.extraction import MappingImage
from gam_relocalizer.mapping.intrinsics import assign_cameras

if TYPE_CHECKING:
    from pathlib import Path

    import pycolmap

NOTHING = LocalFeatures(
    np.zeros((0, 2), np.float32), np.zeros((0, 64), np.float32), np.zeros(0, np.float32)
)


def image_files(folder: Path, sizes: list[tuple[int, int]]) -> list[MappingImage]:
    images = []
    for index, (width, height) in enumerate(sizes):
        name = f'{index}.png'
        cv2.imwrite(str(folder / name), np.zeros((height, width), np.uint8))
        images.append(MappingImage(name, width, height, NOTHING))
    return images


def taken_by(camera: pycolmap.Camera | None, images: list[MappingImage], folder: Path) -> ImageSet:
    names = tuple(image.name for image in images)
    return ImageSet(folder, names, {} if camera is None else dict.fromkeys(names, camera))


def test_given_camera_takes_all_images(tmp_path: Path) -> None:
    camera = parse_camera('PINHOLE 64 48 50 51 32 24')
    images = image_files(tmp_path, [(64, 48)] * 3)

    assigned = assign_cameras(taken_by(camera, images, tmp_path), images)

    assert [format_camera(one) for one in assigned.cameras] == [format_camera(camera)]
    assert assigned.of_image == (0, 0, 0)
    assert assigned.given == {1}


def test_each_given_camera_takes_its_own_images_and_the_rest_is_guessed(tmp_path: Path) -> None:
    left = parse_camera('PINHOLE 64 48 50 51 32 24')
    right = parse_camera('PINHOLE 64 48 52 53 31 25')
    images = image_files(tmp_path, [(64, 48)] * 4)
    cameras = {'0.png': left, '1.png': right, '2.png': left}

    assigned = assign_cameras(ImageSet(tmp_path, ('0.png',), cameras), images)

    assert assigned.of_image == (0, 1, 0, 2)
    assert [format_camera(one) for one in assigned.cameras[:2]] == [
        format_camera(left),
        format_camera(right),
    ]
    assert assigned.given == {1, 2}


def test_given_camera_of_another_size_is_refused(tmp_path: Path) -> None:
    camera = parse_camera('PINHOLE 64 48 50 51 32 24')
    images = image_files(tmp_path, [(64, 48), (48, 64)])

    with pytest.raises(CameraError, match=r'1\.png'):
        assign_cameras(taken_by(camera, images, tmp_path), images)


def test_guesses_one_camera_per_size(tmp_path: Path) -> None:
    images = image_files(tmp_path, [(64, 48), (48, 64), (64, 48)])

    assigned = assign_cameras(taken_by(None, images, tmp_path), images)

    assert assigned.of_image == (0, 1, 0)
    assert [camera.camera_id for camera in assigned.cameras] == [1, 2]
    assert [camera.mean_focal_length() for camera in assigned.cameras] == [1.2 * 64] * 2


def test_guesses_a_camera_for_a_file_that_colmap_cannot_read(tmp_path: Path) -> None:
    image = MappingImage('gone.png', 64, 48, NOTHING)

    (camera,) = assign_cameras(taken_by(None, [image], tmp_path), [image]).cameras

    assert (camera.width, camera.height) == (64, 48)
    assert camera.mean_focal_length() == pytest.approx(1.2 * 64)
