# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import io
import struct
import zlib
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from gam_relocalizer.features.matlab import read_matlab_variable

if TYPE_CHECKING:
    from pathlib import Path

MAX_BYTES = 100_000
HEADER_BYTES = 128
NUMBERS = np.arange(24.0).reshape(2, 3, 4)
CONTENT = {
    'numbers': NUMBERS,
    'many': {'inner': {'whole': np.int32([[7]])}, 'word': 'text'},
    'cells': np.array([[1.5, 'text'], [np.float32([[1, 2]]), 2.5]], dtype=object),
    'structs': np.array([(1.0, 2.0), (3.0, 4.0)], dtype=[('first', 'f8'), ('second', 'f8')]),
    'imaginary': np.complex128([[1j]]),
}


def file_of(content: dict[str, Any], *, compressed: bool = False) -> bytes:
    stream = io.BytesIO()
    savemat(stream, content, do_compression=compressed)
    return stream.getvalue()


PLAIN = file_of(CONTENT)


@pytest.fixture(scope='module')
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp('matlab') / 'file.mat'


def read(file: Path, content: bytes, name: str, max_bytes: int = MAX_BYTES) -> Any:  # noqa: ANN401
    file.write_bytes(content)
    return read_matlab_variable(file, name, max_bytes)


def compressed_like_matlab(plain: bytes) -> bytes:
    """The variables of a file in one compressed element each, whatever they say of themselves."""
    packed = zlib.compress(plain[HEADER_BYTES:])
    return plain[:HEADER_BYTES] + struct.pack('<2I', 15, len(packed)) + packed


@pytest.mark.parametrize('compressed', [False, True])
def test_values_are_those_that_were_written(file: Path, *, compressed: bool) -> None:
    content = file_of(CONTENT, compressed=compressed)

    np.testing.assert_array_equal(read(file, content, 'numbers'), NUMBERS)
    many = read(file, content, 'many')
    np.testing.assert_array_equal(many['inner']['whole'], [[7]])
    first, second, third, _ = read(file, content, 'cells')
    np.testing.assert_array_equal(first, [[1.5]])
    np.testing.assert_array_equal(second, [[1, 2]])
    one, other = read(file, content, 'structs')
    assert [one['first'].item(), one['second'].item()] == [1, 2]
    assert [other['first'].item(), other['second'].item()] == [3, 4]
    # what is neither a real number nor a container
    assert many['word'] is None
    assert third is None
    assert read(file, content, 'imaginary') is None


def test_a_variable_that_is_not_there_is_named(file: Path) -> None:
    with pytest.raises(ValueError, match='`weights`'):
        read(file, PLAIN, 'weights')


@pytest.mark.parametrize(
    'content', [b'', b'short', b'MATLAB 7.3 MAT-file'.ljust(600, b'\x00'), b'\x80\x04K\x01.' * 50]
)
def test_other_formats_are_refused(file: Path, content: bytes) -> None:
    with pytest.raises(ValueError, match='format 5'):
        read(file, content, 'net')


@settings(deadline=None)
@given(cut=st.integers(0, len(PLAIN) - 1))
def test_a_file_that_is_cut_short_is_refused(file: Path, cut: int) -> None:
    with pytest.raises(ValueError, match=r'format 5|damaged|no variable'):
        read(file, PLAIN[:cut], 'imaginary')


@settings(deadline=None)
@given(
    changes=st.dictionaries(st.integers(HEADER_BYTES, len(PLAIN) - 1), st.integers(0, 255)),
    compressed=st.booleans(),
)
def test_damage_is_refused_or_changes_a_value_and_does_nothing_else(
    file: Path, changes: dict[int, int], *, compressed: bool
) -> None:
    content = bytearray(PLAIN)
    for place, value in changes.items():
        content[place] = value
    damaged = compressed_like_matlab(bytes(content)) if compressed else bytes(content)
    for name in CONTENT:
        with suppress(ValueError):
            read(file, damaged, name)


def test_a_variable_that_is_too_large_is_refused_before_it_is_unpacked(file: Path) -> None:
    zeros = np.zeros(10 * MAX_BYTES, np.uint8)
    for compressed in (False, True):
        content = file_of({'zeros': zeros}, compressed=compressed)
        with pytest.raises(ValueError, match=str(MAX_BYTES)):
            read(file, content, 'zeros')
        assert len(read(file, content, 'zeros', 11 * MAX_BYTES).ravel()) == len(zeros)


def matrix(kind: int, axes: tuple[int, ...], content: bytes, name: bytes = b'') -> bytes:
    """An array in MATLAB's format 5."""
    padded = name + bytes(-len(name) % 8)
    shape = struct.pack(f'<{len(axes)}i', *axes) + bytes(-4 * len(axes) % 8)
    header = struct.pack('<4I', 6, 8, kind, 0) + struct.pack('<2I', 5, 4 * len(axes)) + shape
    body = header + struct.pack('<2I', 1, len(name)) + padded + content
    return struct.pack('<2I', 14, len(body)) + body


def nested(depth: int) -> bytes:
    inside = b''
    for _ in range(depth):
        inside = matrix(1, (1, 1), inside or matrix(6, (0, 0), struct.pack('<2I', 9, 0)))
    return inside


@pytest.mark.parametrize(
    'content',
    [
        pytest.param(nested(1000), id='nested deeply'),
        pytest.param(matrix(1, (2**31 - 1, 2**31 - 1), b''), id='more cells than bytes'),
        pytest.param(matrix(6, (-1, -1), struct.pack('<2Id', 9, 8, 1.0)), id='negative axes'),
        pytest.param(matrix(6, (2**31 - 1, 4), struct.pack('<2I', 9, 2**32 - 1)), id='no numbers'),
        pytest.param(matrix(6, (1, 1) * 20, struct.pack('<2Id', 9, 8, 1.0)), id='many axes'),
        pytest.param(
            matrix(2, (9, 9), struct.pack('<8I', 5, 4, 0, 0, 1, 8, 65, 65)), id='no field length'
        ),
    ],
)
def test_sizes_that_lie_are_refused(file: Path, content: bytes) -> None:
    named = matrix(1, (1, 1), content, b'net')
    with pytest.raises(ValueError, match=r'damaged|more than'):
        read(file, PLAIN[:HEADER_BYTES] + named, 'net')
    assert read(file, PLAIN[:HEADER_BYTES] + matrix(1, (1, 1), nested(3), b'net'), 'net')
