# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import array
import struct
import subprocess
import sys
import zlib
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gam_relocalizer.errors import ImageError, UsageError
from gam_relocalizer.images import (
    ENCODINGS,
    decode_compressed,
    decode_image,
    list_images,
    read_image,
)

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

BAYER_COLOURS = {'r': 0, 'g': 1, 'b': 2}
BAYER_PATTERNS = ('rggb', 'bggr', 'gbrg', 'grbg')

sizes = st.tuples(st.integers(1, 9), st.integers(1, 9))
paddings = st.integers(0, 7)


def decode(
    encoding: str,
    stored: NDArray[np.uint8],
    *,
    width: int,
    step: int | None = None,
    is_bigendian: bool = False,
) -> NDArray[np.uint8]:
    """Decodes rows of bytes [H,row]."""
    return decode_image(
        encoding,
        width,
        len(stored),
        stored.shape[1] if step is None else step,
        is_bigendian=is_bigendian,
        data=stored.tobytes(),
        source='/camera/image',
    )


def random_image(size: tuple[int, int], channels: int, seed: int = 0) -> NDArray[np.uint8]:
    shape = (*size, channels) if channels > 1 else size
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def padded_rows(pixels: NDArray[np.uint8], padding: int) -> NDArray[np.uint8]:
    rows = pixels.reshape(len(pixels), -1)
    return np.pad(rows, ((0, 0), (0, padding)), constant_values=170)


@given(sizes, paddings)
@pytest.mark.parametrize(
    ('encoding', 'order'),
    [
        ('rgb8', [0, 1, 2]),
        ('bgr8', [2, 1, 0]),
        ('8UC3', [2, 1, 0]),
        ('rgba8', [0, 1, 2, 3]),
        ('bgra8', [2, 1, 0, 3]),
    ],
)
def test_colour_encodings_come_back_as_rgb(
    encoding: str, order: list[int], size: tuple[int, int], padding: int
) -> None:
    truth = random_image(size, len(order))
    rows = padded_rows(truth[..., order], padding)
    image = decode(encoding, rows, width=size[1])
    np.testing.assert_array_equal(image, truth[..., :3])
    assert image.flags.c_contiguous


@given(sizes, paddings)
@pytest.mark.parametrize('encoding', ['mono8', '8UC1'])
def test_grey_encodings_come_back_unchanged(
    encoding: str, size: tuple[int, int], padding: int
) -> None:
    truth = random_image(size, 1)
    image = decode(encoding, padded_rows(truth, padding), width=size[1])
    np.testing.assert_array_equal(image, truth)
    assert image.flags.c_contiguous


@given(sizes, paddings, st.sampled_from('<>'))
def test_mono16_keeps_the_upper_byte_in_both_byte_orders(
    size: tuple[int, int], padding: int, byte_order: str
) -> None:
    values = np.random.default_rng(1).integers(0, 65536, size, dtype=np.uint16)
    stored = values.astype(f'{byte_order}u2').view(np.uint8)
    image = decode(
        'mono16', padded_rows(stored, padding), width=size[1], is_bigendian=byte_order == '>'
    )
    np.testing.assert_array_equal(image, values >> 8)


def mosaic(pattern: str, truth: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """What a sensor behind a colour filter array of that pattern measures."""
    measured = np.empty(truth.shape[:2], dtype=np.uint8)
    for position, colour in enumerate(pattern):
        row, column = divmod(position, 2)
        measured[row::2, column::2] = truth[row::2, column::2, BAYER_COLOURS[colour]]
    return measured


@given(st.tuples(st.integers(3, 9), st.integers(3, 9)), paddings)
@pytest.mark.parametrize('pattern', BAYER_PATTERNS)
def test_bayer_patterns_are_named_by_their_first_pixels(
    pattern: str, size: tuple[int, int], padding: int
) -> None:
    truth = np.full((*size, 3), (200, 90, 30), dtype=np.uint8)
    rows = padded_rows(mosaic(pattern, truth), padding)
    np.testing.assert_array_equal(decode(f'bayer_{pattern}8', rows, width=size[1]), truth)


@pytest.mark.parametrize('pattern', BAYER_PATTERNS)
@pytest.mark.parametrize('byte_order', ['<', '>'])
def test_bayer_of_16_bit_keeps_the_upper_byte(pattern: str, byte_order: str) -> None:
    truth = np.full((6, 8, 3), (200, 90, 30), dtype=np.uint8)
    values = (mosaic(pattern, truth).astype(np.uint16) << 8) + 77
    stored = values.astype(f'{byte_order}u2').view(np.uint8)
    image = decode(f'bayer_{pattern}16', stored, width=8, is_bigendian=byte_order == '>')
    np.testing.assert_array_equal(image, truth)


@given(st.tuples(st.integers(1, 9), st.integers(1, 5)), paddings, st.integers(16, 235))
@pytest.mark.parametrize(
    ('encoding', 'pair'),
    [('yuv422', 'cycy'), ('uyvy', 'cycy'), ('yuv422_yuy2', 'ycyc'), ('yuyv', 'ycyc')],
)
def test_yuv422_without_colour_is_grey(
    encoding: str, pair: str, size: tuple[int, int], padding: int, luma: int
) -> None:
    height, pairs = size
    values = [luma if part == 'y' else 128 for part in pair]
    stored = np.tile(np.array(values, dtype=np.uint8), (height, pairs))
    image = decode(encoding, padded_rows(stored, padding), width=2 * pairs)
    expected = (luma - 16) * 255 / 219
    np.testing.assert_allclose(image, np.full((height, 2 * pairs, 3), expected), atol=1.0)


@pytest.mark.parametrize(
    ('encoding', 'stored'),
    [('yuv422', [90, 82, 240, 82]), ('yuv422_yuy2', [82, 90, 82, 240])],
)
def test_yuv422_red_is_red(encoding: str, stored: list[int]) -> None:
    rows = np.tile(np.array(stored, dtype=np.uint8), (4, 4))  # BT.601 video levels of pure red
    image = decode(encoding, rows, width=8)
    np.testing.assert_allclose(image, np.full((4, 8, 3), (255, 0, 0)), atol=2.0)


def test_known_encodings_are_all_tested_here() -> None:
    bayer = {f'bayer_{pattern}{bits}' for pattern in BAYER_PATTERNS for bits in (8, 16)}
    colour = {'rgb8', 'bgr8', 'rgba8', 'bgra8', '8UC3', 'mono8', 'mono16', '8UC1'}
    assert set(ENCODINGS) == bayer | colour | {'yuv422', 'uyvy', 'yuv422_yuy2', 'yuyv'}


def test_rgb8_without_padding_is_not_copied() -> None:
    stored = np.arange(36, dtype=np.uint8)
    image = decode_image('rgb8', 4, 3, 12, is_bigendian=False, data=stored, source='/camera/image')
    assert np.shares_memory(image, stored)


def test_reads_the_array_type_of_rclpy() -> None:
    data = array.array('B', range(12))
    image = decode_image('rgb8', 2, 2, 6, is_bigendian=False, data=data, source='/camera/image')
    np.testing.assert_array_equal(image.ravel(), np.arange(12))


def test_last_row_may_lack_its_padding() -> None:
    data = bytes([1, 2, 0, 0, 3, 4])
    image = decode_image('mono8', 2, 2, 4, is_bigendian=False, data=data, source='/camera/image')
    np.testing.assert_array_equal(image, [[1, 2], [3, 4]])


@given(sizes, paddings, st.data())
@pytest.mark.parametrize('encoding', ['mono8', 'rgb8', 'mono16'])
def test_truncated_image_names_topic_and_bytes(
    encoding: str, size: tuple[int, int], padding: int, choice: st.DataObject
) -> None:
    height, width = size
    layout = ENCODINGS[encoding]
    row = width * layout.channels * layout.bytes_per_channel
    step = row + padding
    needed = (height - 1) * step + row
    found = choice.draw(st.integers(0, needed - 1))
    with pytest.raises(ImageError, match=rf'/camera/image.* {needed} bytes, found {found}$'):
        decode_image(
            encoding,
            width,
            height,
            step,
            is_bigendian=False,
            data=bytes(found),
            source='/camera/image',
        )


@pytest.mark.parametrize(
    ('encoding', 'width', 'height', 'step'),
    [
        ('rgb8', 0, 4, 0),
        ('rgb8', 4, 0, 12),
        ('mono8', 2**31, 2**31, 2**31),
        ('rgb8', 4, 4, 11),
        ('rgb8', 4, 4, 0),
        ('bayer_rggb8', 2, 4, 2),
        ('bayer_rggb8', 4, 2, 4),
        ('yuv422', 3, 4, 6),
    ],
)
def test_refuses_impossible_sizes(encoding: str, width: int, height: int, step: int) -> None:
    with pytest.raises(ImageError):
        decode_image(
            encoding,
            width,
            height,
            step,
            is_bigendian=False,
            data=bytes(64),
            source='/camera/image',
        )


@pytest.mark.parametrize('encoding', ['32FC1', 'RGB8', '', 'nv12'])
def test_unknown_encoding_lists_the_known_ones(encoding: str) -> None:
    with pytest.raises(ImageError) as caught:
        decode(encoding, np.zeros((2, 12), dtype=np.uint8), width=2)
    assert all(name in str(caught.value) for name in ENCODINGS)


def test_png_comes_back_exactly_as_rgb() -> None:
    truth = random_image((7, 5), 3)
    encoded = cv2.imencode('.png', truth[..., ::-1])[1]
    np.testing.assert_array_equal(decode_compressed(encoded, 'photo.png'), truth)


@pytest.mark.parametrize('size', [0, 10, 60])
def test_refuses_damaged_compressed_image(size: int) -> None:
    encoded = cv2.imencode('.jpg', random_image((32, 32), 3))[1][:size]
    with pytest.raises(ImageError, match='/camera/image/compressed'):
        decode_compressed(encoded, '/camera/image/compressed')


def png_of_one_grey(width: int, height: int) -> bytes:
    packed = zlib.compressobj(9)
    rows = b''.join(packed.compress(bytes(width + 1)) for _ in range(height)) + packed.flush()
    size = struct.pack('>IIBBBBB', width, height, 8, 0, 0, 0, 0)
    chunks = [(b'IHDR', size), (b'IDAT', rows), (b'IEND', b'')]
    return b'\x89PNG\r\n\x1a\n' + b''.join(
        struct.pack('>I', len(data)) + kind + data + struct.pack('>I', zlib.crc32(kind + data))
        for kind, data in chunks
    )


REFUSE_IN_LITTLE_MEMORY = """
import resource, sys
from pathlib import Path
from gam_relocalizer.errors import ImageError
from gam_relocalizer.images import read_image

used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    read_image(Path(sys.argv[1]))
except ImageError:
    more_kilobytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - used
    sys.exit(more_kilobytes > 100_000)
sys.exit(2)
"""


def test_refuses_a_small_file_of_a_huge_image_before_taking_memory_for_it(tmp_path: Path) -> None:
    bomb = tmp_path / 'bomb.png'
    bomb.write_bytes(png_of_one_grey(15_000, 15_000))
    assert bomb.stat().st_size < 1_000_000
    command = [sys.executable, '-c', REFUSE_IN_LITTLE_MEMORY, str(bomb)]
    assert subprocess.run(command, check=False).returncode == 0


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ImageError, match=r'nowhere\.jpg'):
        read_image(tmp_path / 'nowhere.jpg')


def test_lists_images_sorted_and_relative(tmp_path: Path) -> None:
    for name in ('b.png', 'a/2.JPG', 'a/1.jpg', 'notes.txt'):
        file = tmp_path / name
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(b'')
    assert list_images(tmp_path) == ['a/1.jpg', 'a/2.JPG', 'b.png']


@pytest.mark.parametrize('name', ['missing', ''])
def test_refuses_missing_or_empty_folder(tmp_path: Path, name: str) -> None:
    with pytest.raises(UsageError):
        list_images(tmp_path / name)
