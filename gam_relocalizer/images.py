# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Reading images from files; every image in this project is RGB or grey, uint8."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from gam_relocalizer.errors import ImageError, UsageError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

IMAGE_SUFFIXES = frozenset({'.jpg', '.jpeg', '.png', '.bmp', '.tif', '.tiff', '.webp', '.ppm'})
MAX_PIXELS = 200_000_000


def list_images(folder: Path) -> list[str]:
    """Names of the images below a folder, sorted, relative to it with forward slashes.

    Raises:
        UsageError: No such folder, or no image in it.
    """
    if not folder.is_dir():
        msg = f'{folder}: no such folder of images'
        raise UsageError(msg)
    names = sorted(
        path.relative_to(folder).as_posix()
        for path in folder.rglob('*')
        if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file()
    )
    if not names:
        suffixes = ', '.join(sorted(IMAGE_SUFFIXES))
        msg = f'{folder}: no images in it (looked for {suffixes})'
        raise UsageError(msg)
    return names


def read_image(path: Path) -> NDArray[np.uint8]:
    """Reads an image as RGB [H,W,3]; a rotation noted in EXIF is not applied.

    Calibrations and SfM speak of the pixels as stored, so that is what everyone gets.

    Raises:
        ImageError: The file is missing, is no image, or is larger than `MAX_PIXELS`.
    """
    try:
        encoded = np.fromfile(path, dtype=np.uint8)
    except OSError as err:
        msg = f'{path}: cannot be read: {err.strerror}'
        raise ImageError(msg) from err
    return decode_compressed(encoded, str(path))


def decode_compressed(encoded: NDArray[np.uint8], source: str) -> NDArray[np.uint8]:
    """Decodes JPEG, PNG and the like to RGB [H,W,3].

    Args:
        encoded: The bytes of the file or message.
        source: File or topic, for the error.

    Raises:
        ImageError: Not an image, damaged, or larger than `MAX_PIXELS`.
    """
    flags = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(encoded, flags) if encoded.size else None
    except cv2.error as err:
        msg = f'{source}: cannot be decoded as an image: {err.err}'
        raise ImageError(msg) from err
    if image is None:
        msg = f'{source}: cannot be decoded as an image; it is damaged or of an unknown format'
        raise ImageError(msg)
    if image.shape[0] * image.shape[1] > MAX_PIXELS:
        msg = f'{source}: {image.shape[1]} x {image.shape[0]} pixels are more than {MAX_PIXELS}'
        raise ImageError(msg)
    return np.asarray(image, dtype=np.uint8)
