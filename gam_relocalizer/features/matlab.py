# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Reads variables of MATLAB files of format 5 (written by the versions 5 to 7).

SciPy reads them too, but a damaged or malicious file makes it crash the process or fill the
memory. Here every size is compared with what is left of the file before it is believed.
"""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from pathlib import Path
    from typing import BinaryIO

    from numpy.typing import NDArray

Value: TypeAlias = 'NDArray[Any] | list[Any] | dict[str, Any] | None'

_HEADER_BYTES = 128
# Version 1.0 of the format and little-endian bytes, at the end of the header.
_FORMAT_5 = b'\x00\x01IM'
_TAG = struct.Struct('<2I')
_CHUNK = 2**20
_MAX_VALUES = 100_000
_MAX_DEPTH = 16
_MAX_AXES = 8

# Types of elements, those of numbers with the type of NumPy.
_INT8, _INT32, _UINT32, _MATRIX, _COMPRESSED = 1, 5, 6, 14, 15
_NUMBERS = {
    1: 'i1',
    2: 'u1',
    3: '<i2',
    4: '<u2',
    5: '<i4',
    6: '<u4',
    7: '<f4',
    9: '<f8',
    12: '<i8',
    13: '<u8',
}
# Classes of arrays.
_CELL, _STRUCT, _NUMERIC, _OPAQUE = 1, 2, range(6, 16), 17
_COMPLEX = 0x0800


def read_matlab_variable(path: Path, name: str, max_bytes: int) -> Value:
    """Reads one variable; others are skipped.

    Args:
        path: The file.
        name: Of the variable.
        max_bytes: Greatest size of a variable when it is unpacked.

    Returns:
        Real numbers as an array with MATLAB's axes and the stored type (MATLAB stores whole numbers
        as integers), a cell array as a list with the first axis running fastest, a struct as a
        dictionary, an array of structs as a list of them, None for anything else.

    Raises:
        ValueError: The file is of another format, damaged, or has no such variable; says which.
        OSError: The file cannot be read.
    """
    with path.open('rb') as file:
        if file.read(_HEADER_BYTES)[-len(_FORMAT_5) :] != _FORMAT_5:
            msg = 'it is no MATLAB file of format 5 (versions 5 to 7)'
            raise ValueError(msg)
        while tag := file.read(_TAG.size):
            array = _read_array(file, tag, max_bytes)
            if array is not None and array.name == name:
                return _Parser().value(array, depth=0)
    msg = f'it has no variable `{name}`'
    raise ValueError(msg)


def _read_array(file: BinaryIO, tag: bytes, max_bytes: int) -> _Array | None:
    """The array after a tag of the file, not looked into; None for what is no array."""
    if len(tag) < _TAG.size:
        raise _damaged()
    kind, size = _TAG.unpack(tag)
    if kind == _COMPRESSED:
        kind, content = _Elements(memoryview(_inflate(file, size, max_bytes))).take()
        return _open(content) if kind == _MATRIX else None
    if size > max_bytes:
        raise _too_large(max_bytes)
    stored = bytearray(file.read(size))
    if len(stored) < size:
        raise _damaged()
    return _open(memoryview(stored)) if kind == _MATRIX else None


def _inflate(file: BinaryIO, size: int, max_bytes: int) -> bytearray:
    inflated = bytearray()
    decompressor = zlib.decompressobj()
    try:
        while size and (chunk := file.read(min(size, _CHUNK))):
            size -= len(chunk)
            inflated += decompressor.decompress(chunk, max_bytes + 1 - len(inflated))
            if len(inflated) > max_bytes:
                raise _too_large(max_bytes)
    except zlib.error as err:
        raise _damaged() from err
    if size or not decompressor.eof:
        raise _damaged()
    return inflated


class _Elements:
    """Elements, one after the other: a tag of type and size, then so many bytes, then padding."""

    def __init__(self, data: memoryview) -> None:
        self._data = data

    def __len__(self) -> int:
        """Bytes that are left."""
        return len(self._data)

    def take(self) -> tuple[int, memoryview]:
        """Type and content of the next element."""
        if len(self._data) < _TAG.size:
            raise _damaged()
        kind, size = _TAG.unpack_from(self._data)
        begin, end = _TAG.size, _TAG.size + size + -size % 8
        if kind >> 16:  # a small element: content in its tag
            kind, size = kind & 0xFFFF, kind >> 16
            begin, end = 4, _TAG.size
        if begin + size > min(end, len(self._data)):
            raise _damaged()
        content = self._data[begin : begin + size]
        self._data = self._data[end:]
        return kind, content

    def take_only(self, wanted: int) -> memoryview:
        """Content of the next element, which is of that type."""
        kind, content = self.take()
        if kind != wanted:
            raise _damaged()
        return content

    def take_numbers(self, count: int) -> NDArray[Any]:
        """Content of the next element, which is so many numbers of any type."""
        kind, content = self.take()
        if kind not in _NUMBERS or len(content) != count * np.dtype(_NUMBERS[kind]).itemsize:
            raise _damaged()
        return np.frombuffer(content, _NUMBERS[kind], count)


@dataclass(frozen=True)
class _Array:
    """An array as its header describes it.

    Attributes:
        name: Empty within cells and structs.
        kind: Its class; 0 for one without content.
        axes: Its shape.
        content: What comes after the header.
    """

    name: str
    kind: int
    axes: tuple[int, ...]
    content: _Elements

    @property
    def size(self) -> int:
        return math.prod(self.axes)


def _open(content: memoryview) -> _Array:
    elements = _Elements(content)
    if not len(elements):
        return _Array('', 0, (), elements)
    flags = elements.take_only(_UINT32)
    if len(flags) != 8:
        raise _damaged()
    if flags[0] == _OPAQUE:  # an object, whose header is another one
        return _Array('', 0, (), elements)
    axes = elements.take_only(_INT32)
    if len(axes) % 4 or len(axes) > 4 * _MAX_AXES:
        raise _damaged()
    shape = struct.unpack(f'<{len(axes) // 4}i', axes)
    if min(shape, default=-1) < 0:
        raise _damaged()
    name = bytes(elements.take_only(_INT8)).decode('latin-1')
    is_complex = int.from_bytes(flags[:4], 'little') & _COMPLEX
    return _Array(name, 0 if is_complex else flags[0], shape, elements)


class _Parser:
    """Turns arrays into values, not too many and not too deeply nested."""

    def __init__(self) -> None:
        self._left = _MAX_VALUES

    def value(self, array: _Array, depth: int) -> Value:
        if array.kind in _NUMERIC:
            return array.content.take_numbers(array.size).reshape(array.axes, order='F')
        if array.kind == _CELL:
            return self._values(array.content, array.size, depth)
        if array.kind == _STRUCT:
            return self._structs(array, depth)
        return None

    def _values(self, content: _Elements, count: int, depth: int) -> list[Value]:
        self._left -= count
        if self._left < 0 or depth > _MAX_DEPTH:
            msg = f'it has more than {_MAX_VALUES} values, or nests them deeper than {_MAX_DEPTH}'
            raise ValueError(msg)
        matrices = (content.take_only(_MATRIX) for _ in range(count))
        return [self.value(_open(matrix), depth + 1) for matrix in matrices]

    def _structs(self, array: _Array, depth: int) -> Value:
        length = int.from_bytes(array.content.take_only(_INT32), 'little')
        packed = bytes(array.content.take_only(_INT8))
        if not packed:
            return None
        if not length or len(packed) % length:
            raise _damaged()
        names = [
            packed[begin : begin + length].split(b'\0')[0].decode('latin-1')
            for begin in range(0, len(packed), length)
        ]
        values = iter(self._values(array.content, array.size * len(names), depth))
        structs: list[Value] = [{name: next(values) for name in names} for _ in range(array.size)]
        return structs[0] if len(structs) == 1 else structs


def _damaged() -> ValueError:
    return ValueError('it is damaged or cut short')


def _too_large(max_bytes: int) -> ValueError:
    return ValueError(f'it holds a variable of more than {max_bytes} bytes')
