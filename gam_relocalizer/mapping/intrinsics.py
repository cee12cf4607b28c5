# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The cameras that took the images of a map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import pycolmap

from gam_relocalizer.errors import CameraError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from gam_relocalizer.mapping.extraction import MappingImage

_GUESSED_MODEL = 'SIMPLE_RADIAL'
_GUESSED_FOCAL_PER_SIDE = 1.2


@dataclass(frozen=True)
class ImageCameras:
    """Who took what.

    Attributes:
        cameras: With ids 1, 2, ...
        of_image: Index into `cameras` for each image.
    """

    cameras: tuple[pycolmap.Camera, ...]
    of_image: tuple[int, ...]

    def of(self, image: int) -> pycolmap.Camera:
        """The camera that took an image."""
        return self.cameras[self.of_image[image]]


def assign_cameras(
    folder: Path, images: Sequence[MappingImage], camera: pycolmap.Camera | None
) -> ImageCameras:
    """The given camera for all, or one guessed camera per image size and EXIF focal length.

    Raises:
        CameraError: An image is not of the given camera's size.
    """
    if camera is not None:
        _check_sizes(images, camera)
        known = _numbered(camera, 1)
        known.has_prior_focal_length = True
        return ImageCameras((known,), (0,) * len(images))
    index_of: dict[tuple[float, ...], int] = {}
    cameras: list[pycolmap.Camera] = []
    of_image: list[int] = []
    for image in images:
        guess = _guessed_camera(folder / image.name, image)
        key = (guess.width, guess.height, *guess.params)
        if key not in index_of:
            index_of[key] = len(cameras)
            cameras.append(_numbered(guess, len(cameras) + 1))
        of_image.append(index_of[key])
    return ImageCameras(tuple(cameras), tuple(of_image))


def _check_sizes(images: Sequence[MappingImage], camera: pycolmap.Camera) -> None:
    for image in images:
        if (image.width, image.height) != (camera.width, camera.height):
            msg = (
                f'{image.name}: {image.width} x {image.height} pixels, but the camera is '
                f'{camera.width} x {camera.height}; give images of one camera, or no camera'
            )
            raise CameraError(msg)


def _guessed_camera(path: Path, image: MappingImage) -> pycolmap.Camera:
    """The camera of the EXIF data, else one with a usual angle of view."""
    try:
        camera = pycolmap.infer_camera_from_image(path)
    except (ValueError, RuntimeError):  # a format that OpenCV reads and COLMAP does not
        camera = None
    if camera is not None and (camera.width, camera.height) == (image.width, image.height):
        return camera
    focal = _GUESSED_FOCAL_PER_SIDE * max(image.width, image.height)
    return pycolmap.Camera.create_from_model_name(
        1, _GUESSED_MODEL, focal, image.width, image.height
    )


def _numbered(camera: pycolmap.Camera, camera_id: int) -> pycolmap.Camera:
    numbered = pycolmap.Camera(camera.todict())
    numbered.camera_id = camera_id
    return numbered
