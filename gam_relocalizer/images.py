# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Images from files and from messages; every image in this project is RGB or grey, uint8."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from gam_relocalizer import MAX_IMAGE_PIXELS
from gam_relocalizer.errors import ImageError, UsageError

if TYPE_CHECKING:
    from array import array
    from collections.abc import Callable
    from pathlib import Path
    from typing import TypeAlias

    from numpy.typing import NDArray

    ImageData: TypeAlias = bytes | bytearray | memoryview | array[int] | NDArray[np.uint8]

IMAGE_SUFFIXES = frozenset({'.jpg', '.jpeg', '.png', '.bmp', '.tif', '.tiff', '.webp', '.ppm'})
MIN_BAYER_SIDE = 3
# More than the largest image takes without any compression, with 16 bits in four channels.
MAX_IMAGE_BYTES = 8 * MAX_IMAGE_PIXELS


@dataclass(frozen=True)
class _Encoding:
    """How the pixels of one sensor_msgs/Image encoding lie in its rows.

    Attributes:
        channels: Numbers per pixel, as stored.
        convert: From the stored [H,W] or [H,W,C] uint8 to RGB or grey.
        bytes_per_channel: 1, or 2 for encodings that hold 16 bits.
        min_side: Smallest width and height that `convert` can work on.
        width_multiple: The width must be a multiple of it.
    """

    channels: int
    convert: Callable[[NDArray[np.uint8]], NDArray[np.uint8]]
    bytes_per_channel: int = 1
    min_side: int = 1
    width_multiple: int = 1


def _as_stored(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.ascontiguousarray(pixels)


def _by_opencv(code: int) -> Callable[[NDArray[np.uint8]], NDArray[np.uint8]]:
    def convert(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), code), dtype=np.uint8)

    return convert


def _bayer_encodings() -> dict[str, _Encoding]:
    """ROS names a Bayer pattern by its first four pixels, row by row.

    OpenCV's short names (COLOR_BayerBG2RGB) start at the second pixel of the second row, so they
    name the opposite pattern: its BG is ROS's rggb. Its long names, used here, agree with ROS.
    """
    codes = {
        'rggb': cv2.COLOR_BayerRGGB2RGB,
        'bggr': cv2.COLOR_BayerBGGR2RGB,
        'gbrg': cv2.COLOR_BayerGBRG2RGB,
        'grbg': cv2.COLOR_BayerGRBG2RGB,
    }
    return {
        f'bayer_{pattern}{8 * size}': _Encoding(1, _by_opencv(code), size, MIN_BAYER_SIDE)
        for pattern, code in codes.items()
        for size in (1, 2)
    }


_UYVY = _Encoding(2, _by_opencv(cv2.COLOR_YUV2RGB_UYVY), width_multiple=2)
_YUYV = _Encoding(2, _by_opencv(cv2.COLOR_YUV2RGB_YUYV), width_multiple=2)

ENCODINGS = {
    'mono8': _Encoding(1, _as_stored),
    'mono16': _Encoding(1, _as_stored, bytes_per_channel=2),
    'rgb8': _Encoding(3, _as_stored),
    'bgr8': _Encoding(3, _by_opencv(cv2.COLOR_BGR2RGB)),
    'rgba8': _Encoding(4, _by_opencv(cv2.COLOR_RGBA2RGB)),
    'bgra8': _Encoding(4, _by_opencv(cv2.COLOR_BGRA2RGB)),
    '8UC1': _Encoding(1, _as_stored),
    '8UC3': _Encoding(3, _by_opencv(cv2.COLOR_BGR2RGB)),  # an OpenCV matrix: BGR by its custom
    **_bayer_encodings(),
    'yuv422': _UYVY,
    'uyvy': _UYVY,
    'yuv422_yuy2': _YUYV,
    'yuyv': _YUYV,
}


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
        ImageError: The file is missing, is no image, or is larger than `MAX_IMAGE_PIXELS`.
    """
    return decode_compressed(read_encoded(path), str(path))


def read_encoded(path: Path) -> NDArray[np.uint8]:
    """Reads the bytes of an image file, for `decode_compressed`.

    Raises:
        ImageError: The file is missing, or larger than any image may be.
    """
    try:
        size = path.stat().st_size
        if size > MAX_IMAGE_BYTES:
            msg = f'{path}: {size} bytes are more than {MAX_IMAGE_BYTES}; this is no image'
            raise ImageError(msg)
        return np.fromfile(path, dtype=np.uint8)
    except OSError as err:
        msg = f'{path}: cannot be read: {err.strerror}'
        raise ImageError(msg) from err


def decode_compressed(encoded: NDArray[np.uint8], source: str) -> NDArray[np.uint8]:
    """Decodes JPEG, PNG and the like to RGB [H,W,3].

    Args:
        encoded: The bytes of the file or message.
        source: File or topic, for the error.

    Raises:
        ImageError: Not an image, damaged, or larger than `MAX_IMAGE_PIXELS`.
    """
    flags = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(encoded, flags) if encoded.size else None
    except cv2.error as err:
        msg = (
            f'{source}: cannot be decoded as an image of at most {MAX_IMAGE_PIXELS} pixels: '
            f'{err.err}'
        )
        raise ImageError(msg) from err
    if image is None:
        msg = f'{source}: cannot be decoded as an image; it is damaged or of an unknown format'
        raise ImageError(msg)
    if image.shape[0] * image.shape[1] > MAX_IMAGE_PIXELS:
        msg = (
            f'{source}: {image.shape[1]} x {image.shape[0]} pixels are more than {MAX_IMAGE_PIXELS}'
        )
        raise ImageError(msg)
    return np.asarray(image, dtype=np.uint8)


def decode_image(
    encoding: str,
    width: int,
    height: int,
    step: int,
    *,
    is_bigendian: bool,
    data: ImageData,
    source: str,
) -> NDArray[np.uint8]:
    """Decodes the numbers of a sensor_msgs/Image to RGB [H,W,3] or grey [H,W].

    16 bit become 8 by their upper byte: the full range is all that the encoding promises, and a
    stretch to the values present would change the picture of one and the same place from frame to
    frame.

    Args:
        encoding: One of `ENCODINGS` (names of sensor_msgs/image_encodings.hpp).
        width: Pixels per row.
        height: Rows.
        step: Bytes from the start of one row to that of the next; padding is skipped.
        is_bigendian: Byte order of 16 bit encodings.
        data: The rows; the padding of the last may be missing.
        source: Topic, for the error.

    Returns:
        A contiguous array; a read-only view of `data` where nothing had to be converted.

    Raises:
        ImageError: Unknown encoding, impossible size or step, or too few bytes.
    """
    layout = ENCODINGS.get(encoding)
    if layout is None:
        msg = f'{source}: unknown image encoding `{encoding}`; known are {", ".join(ENCODINGS)}'
        raise ImageError(msg)
    _check_size(layout, encoding, width, height, source)
    row = width * layout.channels * layout.bytes_per_channel
    if step < row:
        msg = f'{source}: step is {step} bytes; {width} pixels of {encoding} take {row}'
        raise ImageError(msg)
    stored = np.frombuffer(data, dtype=np.uint8)
    expected = (height - 1) * step + row
    if len(stored) < expected:
        msg = (
            f'{source}: truncated image: {width} x {height} {encoding} with step {step} takes '
            f'{expected} bytes, found {len(stored)}'
        )
        raise ImageError(msg)
    return layout.convert(_pixels(stored, layout, (height, width), step, is_bigendian=is_bigendian))


def _check_size(layout: _Encoding, encoding: str, width: int, height: int, source: str) -> None:
    if min(width, height) < layout.min_side or width * height > MAX_IMAGE_PIXELS:
        msg = (
            f'{source}: {width} x {height} pixels; {encoding} needs at least {layout.min_side} in '
            f'width and height, and at most {MAX_IMAGE_PIXELS} in all'
        )
        raise ImageError(msg)
    if width % layout.width_multiple:
        msg = f'{source}: width {width} is odd; {encoding} stores pixels in pairs'
        raise ImageError(msg)


def _pixels(
    stored: NDArray[np.uint8],
    layout: _Encoding,
    shape: tuple[int, int],
    step: int,
    *,
    is_bigendian: bool,
) -> NDArray[np.uint8]:
    """A view without padding, of the upper byte of each channel: [H,W] or [H,W,C]."""
    size = layout.bytes_per_channel
    pixels = np.lib.stride_tricks.as_strided(
        stored,
        shape=(*shape, layout.channels, size),
        strides=(step, layout.channels * size, size, 1),
        writeable=False,
    )[..., 0 if is_bigendian else size - 1]
    return pixels[..., 0] if layout.channels == 1 else pixels
