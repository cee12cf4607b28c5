# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""How a map bundle stores much in little: sets of indices, and vectors in few bits.

Lengths do not matter to any of the vectors, so what is rounded is their direction alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

# A gap is a number to the base 128, its lowest digit first; all digits but the last are marked.
_DIGIT_BITS = 7
_DIGIT = 2**_DIGIT_BITS - 1
_MORE = 2**_DIGIT_BITS
_MOST_DIGITS = 5
# Bytes that are looked at together.
_BLOCK = 2**20

_INT8_STEPS = 127
# Four bits hold -7 to 7, and 8 is added to make them positive.
_NIBBLE_STEPS = 7
_NIBBLE_ZERO = 8
# The largest step gives room to the largest number; a smaller one clips it and is finer. Numbers
# with a normal distribution do best with about 0.7.
_NIBBLE_CLIPS = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4)
_ROWS_AT_ONCE = 64
# Squares of numbers about this small are lost in float32.
_TINY_LENGTH = 1e-15


@dataclass(frozen=True)
class IndexSets:
    """Sets of indices that mostly lie close together, at about a byte for each index.

    Attributes:
        first: [S] int32 the lowest index of each set, -1 for an empty one.
        offsets: [S+1] int64: set i has the bytes gaps[offsets[i]:offsets[i+1]].
        gaps: [B] uint8: from each index to the next, how many are left out between the two.
    """

    first: NDArray[np.int32]
    offsets: NDArray[np.int64]
    gaps: NDArray[np.uint8]

    @classmethod
    def of(cls, sets: Sequence[NDArray[np.integer[Any]]]) -> IndexSets:
        """Packs sets of indices from 0 to 2^31 - 1, in any order."""
        rising = [np.unique(np.asarray(indices, np.int64)) for indices in sets]
        packed = [_packed(indices[1:] - indices[:-1] - 1) for indices in rising]
        return cls(
            first=np.array([indices[0] if len(indices) else -1 for indices in rising], np.int32),
            offsets=np.cumsum([0, *map(len, packed)], dtype=np.int64),
            gaps=np.concatenate([np.empty(0, np.uint8), *packed]),
        )

    def __len__(self) -> int:
        return len(self.first)

    def __getitem__(self, index: int) -> NDArray[np.int32]:
        """The indices of one set, rising."""
        first = int(self.first[index])
        if first < 0:
            return np.empty(0, np.int32)
        begin, end = self.offsets[index : index + 2]
        gaps = np.asarray(self.gaps[begin:end])
        # the sums up to the ends of the numbers, and one more for each index
        ends = np.flatnonzero(gaps < _MORE)
        indices = np.full(len(ends) + 1, first, np.int32)
        indices[1:] += (np.cumsum(_digits(gaps))[ends] + np.arange(1, len(ends) + 1)).astype(
            np.int32
        )
        return indices

    def checked_sizes(self, limit: int) -> NDArray[np.int64]:
        """How many indices each set has [S], after a check of every byte.

        Raises:
            ValueError: These are no sets of indices below the limit.
        """
        check_offsets(self.offsets, len(self.gaps))
        lengths = np.diff(self.offsets)
        if (self.first < -1).any() or lengths[self.first < 0].any():
            msg = 'a set without a first index'
            raise ValueError(msg)
        filled = np.flatnonzero(lengths)
        if (self.gaps[self.offsets[filled + 1] - 1] >= _MORE).any():
            msg = 'a set ends within a number'
            raise ValueError(msg)
        sizes = (self.first >= 0).astype(np.int64)
        last = self.first.astype(np.int64)
        for some in _blocks(self.offsets, filled):
            gaps = self.gaps[self.offsets[some[0]] : self.offsets[some[-1] + 1]]
            starts = self.offsets[some] - self.offsets[some[0]]
            more = np.add.reduceat(gaps < _MORE, starts, dtype=np.int64)
            sizes[some] += more
            last[some] += more + np.add.reduceat(_digits(gaps), starts)
        if (last >= limit).any():
            msg = f'index {last.max()} is not below {limit}'
            raise ValueError(msg)
        return sizes


def int8_directions(rows: NDArray[np.floating[Any]]) -> NDArray[np.int8]:
    """The directions of vectors [N,D], the largest number of each at 127 or -127."""
    largest = np.abs(rows).max(axis=1, keepdims=True, initial=0.0)
    scaled = rows / np.maximum(largest, np.finfo(np.float32).tiny) * _INT8_STEPS
    return np.asarray(np.rint(scaled), np.int8)


def unit_rows(rows: NDArray[np.generic]) -> NDArray[np.float32]:
    """Vectors [K,D] of any kind of number as float32 of length one; zeros stay zeros."""
    vectors = np.asarray(rows, np.float32)
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    units = np.asarray(vectors / np.maximum(lengths, np.finfo(np.float32).tiny), np.float32)
    tiny = lengths[:, 0] < _TINY_LENGTH
    if tiny.any():
        wide = vectors[tiny].astype(np.float64)
        wide_lengths = np.linalg.norm(wide, axis=1, keepdims=True)
        units[tiny] = wide / np.where(wide_lengths > 0.0, wide_lengths, 1.0)
    return units


@dataclass(frozen=True)
class PackedVectors:
    """Vectors in four bits for each number.

    Attributes:
        nibbles: [I,ceil(G/2)] uint8: the lower four bits belong to the first half of the vector.
        scales: [I] float32: what the numbers of a vector are to be multiplied with.
        dimension: G.
    """

    nibbles: NDArray[np.uint8]
    scales: NDArray[np.float32]
    dimension: int

    @classmethod
    def of(cls, vectors: NDArray[np.floating[Any]]) -> PackedVectors:
        """Packs vectors [I,G]; a vector that was packed before comes out the same."""
        count, dimension = vectors.shape
        half = -(-dimension // 2)
        nibbles = np.full((count, half), _NIBBLE_ZERO << 4, np.uint8)
        scales = np.zeros(count, np.float32)
        for row, vector in enumerate(vectors):
            steps, scales[row] = _nibbles_of(vector.astype(np.float64))
            nibbles[row] |= steps[:half]
            nibbles[row, : dimension - half] &= 0x0F
            nibbles[row, : dimension - half] |= steps[half:] << 4
        return cls(nibbles, scales, dimension)

    def __getitem__(self, index: int) -> NDArray[np.float32]:
        """One vector [G]."""
        row = self.nibbles[index]
        numbers = np.concatenate([row & 0x0F, row >> 4])[: self.dimension].astype(np.float32)
        return np.asarray((numbers - _NIBBLE_ZERO) * self.scales[index], np.float32)

    def products(self, vector: NDArray[np.float32]) -> NDArray[np.float32]:
        """[I] scalar products with a vector [G]."""
        half = self.nibbles.shape[1]
        first = vector[:half].astype(np.float32)
        second = np.zeros(half, np.float32)
        second[: self.dimension - half] = vector[half:]
        sums = np.empty(len(self.nibbles), np.float32)
        for begin in range(0, len(sums), _ROWS_AT_ONCE):
            some = np.asarray(self.nibbles[begin : begin + _ROWS_AT_ONCE])
            lower, upper = (some & 0x0F).astype(np.float32), (some >> 4).astype(np.float32)
            sums[begin : begin + _ROWS_AT_ONCE] = lower @ first + upper @ second
        zero = np.float32(_NIBBLE_ZERO * np.sum(vector, dtype=np.float64))
        return np.asarray(self.scales * (sums - zero), np.float32)


def check_offsets(offsets: NDArray[np.integer[Any]], total: int) -> None:
    """Checks where parts of a whole of so many things begin and end.

    Raises:
        ValueError: The parts do not follow each other.
    """
    if offsets[0] != 0 or offsets[-1] != total or (offsets[1:] < offsets[:-1]).any():
        msg = f'offsets must rise from 0 to {total}, found {offsets[0]} to {offsets[-1]}'
        raise ValueError(msg)


def _packed(numbers: NDArray[np.int64]) -> NDArray[np.uint8]:
    lengths = np.ones(len(numbers), np.int64)
    for digit in range(1, _MOST_DIGITS):
        lengths += numbers >> _DIGIT_BITS * digit > 0
    starts = np.cumsum(lengths) - lengths
    packed = np.empty(int(lengths.sum()), np.uint8)
    for digit in range(_MOST_DIGITS):
        has = lengths > digit
        marked = np.where(lengths[has] > digit + 1, _MORE, 0)
        packed[starts[has] + digit] = (numbers[has] >> _DIGIT_BITS * digit & _DIGIT) | marked
    return packed


def _digits(packed: NDArray[np.uint8]) -> NDArray[np.int64]:
    """What each byte adds to its number.

    Raises:
        ValueError: A number is longer than any index.
    """
    digits: NDArray[np.int64] = (packed & _DIGIT).astype(np.int64)
    following = np.flatnonzero(packed >= _MORE) + 1
    for _ in range(_MOST_DIGITS):
        if not len(following):
            return digits
        digits[following] <<= _DIGIT_BITS
        following = following[packed[following] >= _MORE] + 1
    msg = f'a number of more than {_MOST_DIGITS} digits'
    raise ValueError(msg)


def _blocks(offsets: NDArray[np.int64], filled: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    """Neighbouring sets that together have about so many bytes as are looked at together."""
    block_of = offsets[filled] // _BLOCK
    return iter(np.split(filled, np.flatnonzero(np.diff(block_of)) + 1) if len(filled) else [])


def _nibbles_of(vector: NDArray[np.float64]) -> tuple[NDArray[np.uint8], float]:
    """Steps [G], with what makes their zero added, and their scale: the nearest of some."""
    largest = float(np.abs(vector).max(initial=0.0))
    if largest == 0.0:
        return np.full(len(vector), _NIBBLE_ZERO, np.uint8), 0.0
    best, least = np.zeros_like(vector), np.inf
    for clip in _NIBBLE_CLIPS:
        step = clip * largest / _NIBBLE_STEPS
        steps = np.clip(np.rint(vector / step), -_NIBBLE_STEPS, _NIBBLE_STEPS)
        error = float(np.sum(np.square(vector - step * steps)))
        if error < least:
            best, least = steps, error
    # so that the product with the vector itself is right, and with others on average
    scale = float(vector @ vector / (vector @ best))
    return (best + _NIBBLE_ZERO).astype(np.uint8), scale
