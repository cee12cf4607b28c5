# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from PIL import Image

from gam_relocalizer.cameras import format_camera, parse_camera
from gam_relocalizer.errors import CameraError
from gam_relocalizer.features import create_extractor
from gam_relocalizer.features.local import LocalFeatures
from gam_relocalizer.image_set import ImageSet
from gam_relocalizer.mapping.extraction import MappingImage, extract_images
from gam_relocalizer.mapping.intrinsics import assign_cameras
from gam_relocalizer.mapping.progress import ignore_progress

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


EXIF_SUB_DIRECTORY, ORIENTATION, FOCAL_LENGTH, FOCAL_LENGTH_35MM = 0x8769, 0x0112, 0x920A, 0xA405
SIDEWAYS = 6


def write_photo(file: Path, orientation: int, *, focal_length_35mm: int = 28) -> None:
    """A textured JPEG of 640 x 480 stored pixels, with the EXIF data that phones write."""
    pixels = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    photo = Image.fromarray(np.kron(pixels, np.ones((10, 10, 1), np.uint8)))
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    exif.get_ifd(EXIF_SUB_DIRECTORY).update(
        {FOCAL_LENGTH: 4.0, FOCAL_LENGTH_35MM: focal_length_35mm}
    )
    photo.save(file, exif=exif)


def extracted_from(folder: Path) -> list[MappingImage]:
    names = sorted(file.name for file in folder.iterdir())
    extractor = create_extractor('sift', 100)
    return list(extract_images(folder, names, extractor, None, ignore_progress).images)


def test_focal_length_comes_from_exif(tmp_path: Path) -> None:
    write_photo(tmp_path / '0.jpg', 1)
    write_photo(tmp_path / '1.jpg', 1, focal_length_35mm=50)
    images = extracted_from(tmp_path)

    assigned = assign_cameras(taken_by(None, images, tmp_path), images)

    # the film is 36 mm wide, its diagonal 43.3 mm: programs differ in which of them they go by
    assert assigned.of_image == (0, 1)
    assert assigned.cameras[0].mean_focal_length() == pytest.approx(28 / 36 * 640, rel=0.05)
    assert assigned.cameras[1].mean_focal_length() == pytest.approx(50 / 36 * 640, rel=0.05)
    assert assigned.given == frozenset()


def test_a_rotation_in_exif_changes_neither_pixels_nor_camera(tmp_path: Path) -> None:
    write_photo(tmp_path / 'sideways.jpg', SIDEWAYS)
    write_photo(tmp_path / 'upright.jpg', 1)
    images = sideways, upright = extracted_from(tmp_path)

    assigned = assign_cameras(taken_by(None, images, tmp_path), images)

    assert (sideways.width, sideways.height) == (upright.width, upright.height) == (640, 480)
    np.testing.assert_array_equal(sideways.features.keypoints, upright.features.keypoints)
    assert assigned.of_image == (0, 0)
    assert (assigned.cameras[0].width, assigned.cameras[0].height) == (640, 480)
    assert assigned.cameras[0].mean_focal_length() == pytest.approx(28 / 36 * 640, rel=0.05)
