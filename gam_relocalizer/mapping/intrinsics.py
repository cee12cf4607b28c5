# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The cameras that took the images of a map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import pycolmap

from gam_relocalizer.cameras import format_camera
from gam_relocalizer.errors import CameraError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from gam_relocalizer.image_set import ImageSet
    from gam_relocalizer.mapping.extraction import MappingImage

_GUESSED_MODEL = 'SIMPLE_RADIAL'
_GUESSED_FOCAL_PER_SIDE = 1.2


@dataclass(frozen=True)
class ImageCameras:
    """Who took what.

    Attributes:
        cameras: With ids 1, 2, ...
        of_image: Index into `cameras` for each image.
        given: Ids of those that were given, not guessed.
    """

    cameras: tuple[pycolmap.Camera, ...]
    of_image: tuple[int, ...]
    given: frozenset[int] = frozenset()

    def of(self, image: int) -> pycolmap.Camera:
        """The camera that took an image."""
        return self.cameras[self.of_image[image]]


def assign_cameras(images: ImageSet, extracted: Sequence[MappingImage]) -> ImageCameras:
    """The given cameras, and else one guessed camera per image size and EXIF focal length.

    Raises:
        CameraError: An image is not of its given camera's size.
    """
    index_of: dict[str, int] = {}
    cameras: list[pycolmap.Camera] = []
    of_image: list[int] = []
    given: set[int] = set()
    for image in extracted:
        known = images.cameras.get(image.name)
        camera = known or image.exif_camera or _guessed_camera(image)
        # a guess that happens to equal a given camera is still another one, to be refined
        key = f'{known is not None} {format_camera(camera)}'
        if key not in index_of:
            index_of[key] = len(cameras)
            cameras.append(_numbered(camera, len(cameras) + 1))
        of_image.append(index_of[key])
        if known is not None:
            _check_size(image, known)
            cameras[index_of[key]].has_prior_focal_length = True
            given.add(cameras[index_of[key]].camera_id)
    return ImageCameras(tuple(cameras), tuple(of_image), frozenset(given))


def _check_size(image: MappingImage, camera: pycolmap.Camera) -> None:
    if (image.width, image.height) != (camera.width, camera.height):
        msg = (
            f'{image.name}: {image.width} x {image.height} pixels, but the camera is '
            f'{camera.width} x {camera.height}; give images of one camera, or no camera'
        )
        raise CameraError(msg)


def _guessed_camera(image: MappingImage) -> pycolmap.Camera:
    """One with a usual angle of view."""
    focal = _GUESSED_FOCAL_PER_SIDE * max(image.width, image.height)
    return pycolmap.Camera.create_from_model_name(
        1, _GUESSED_MODEL, focal, image.width, image.height
    )


def _numbered(camera: pycolmap.Camera, camera_id: int) -> pycolmap.Camera:
    numbered = pycolmap.Camera(camera.todict())
    numbered.camera_id = camera_id
    return numbered
