# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from gam_relocalizer.map_encoding import (
    IndexSets,
    PackedVectors,
    check_offsets,
    int8_directions,
    unit_rows,
)

MOST = 2**31 - 1
sets_of_indices = st.lists(
    st.lists(st.one_of(st.integers(0, 300), st.integers(0, MOST)), max_size=40), max_size=6
)
numbers = st.floats(-10.0, 10.0, width=32, allow_subnormal=False)
vectors = st.tuples(st.integers(1, 4), st.integers(1, 9)).flatmap(
    lambda shape: arrays.arrays(np.float32, shape, elements=numbers)
)


@given(sets_of_indices)
def test_sets_come_back_rising(sets: list[list[int]]) -> None:
    packed = IndexSets.of([np.array(indices, np.int64) for indices in sets])

    assert len(packed) == len(sets)
    for index, indices in enumerate(sets):
        assert packed[index].tolist() == sorted(set(indices))
    limit = max((max(indices) for indices in sets if indices), default=0) + 1
    assert packed.checked_sizes(limit).tolist() == [len(set(indices)) for indices in sets]


@given(sets_of_indices.filter(any))
def test_an_index_at_the_limit_is_refused(sets: list[list[int]]) -> None:
    packed = IndexSets.of([np.array(indices, np.int64) for indices in sets])
    highest = max(max(indices) for indices in sets if indices)

    with pytest.raises(ValueError, match='not below'):
        packed.checked_sizes(highest)


@settings(max_examples=200)
@given(
    gaps=st.binary(max_size=30),
    cuts=st.lists(st.integers(0, 30), max_size=4),
    first=st.lists(st.integers(-3, 1000), min_size=5, max_size=5),
)
def test_any_bytes_are_refused_or_sets_below_the_limit(
    gaps: bytes, cuts: list[int], first: list[int]
) -> None:
    offsets = np.array([0, *sorted(cut for cut in cuts if cut <= len(gaps)), len(gaps)], np.int64)
    data = np.frombuffer(gaps, np.uint8)
    packed = IndexSets(np.array(first[: len(offsets) - 1], np.int32), offsets, data)
    try:
        sizes = packed.checked_sizes(1000)
    except ValueError:
        return

    for index, size in enumerate(sizes):
        indices = packed[index]
        assert len(indices) == size
        assert (np.diff(indices) > 0).all()
        assert not len(indices) or (indices[0] >= 0 and indices[-1] < 1000)


def test_sets_are_checked_block_by_block() -> None:
    """More bytes than are looked at together."""
    sets = [np.arange(start, start + 300_000) for start in (0, 5, 1_000_000, 7)]
    packed = IndexSets.of([*sets, np.empty(0, int), *sets])

    sizes = packed.checked_sizes(1_300_000)

    assert sizes.tolist() == [300_000] * 4 + [0] + [300_000] * 4
    with pytest.raises(ValueError, match='not below'):
        packed.checked_sizes(1_299_999)


def test_neighbours_take_a_byte_each() -> None:
    packed = IndexSets.of([np.arange(1000, 2000), np.arange(0, 10_000, 128)])

    assert len(packed.gaps) == 999 + 78


@pytest.mark.parametrize('offsets', [[0, 3, 2, 4], [1, 2, 4], [0, 2], [0, 2, 5]])
def test_parts_that_do_not_follow_each_other_are_refused(offsets: list[int]) -> None:
    with pytest.raises(ValueError, match='rise'):
        check_offsets(np.array(offsets), 4)


@given(vectors)
def test_eight_bits_keep_each_number_to_half_a_step_of_the_largest(rows: np.ndarray) -> None:
    steps = int8_directions(rows)

    largest = np.abs(rows).max(axis=1, keepdims=True)
    back = steps.astype(np.float64) * largest / 127
    assert (np.abs(back - rows) <= largest / 254 * (1 + 1e-5)).all()
    np.testing.assert_array_equal(int8_directions(unit_rows(steps)), steps)


@given(vectors)
@example(np.array([[3.4505274e-38]], np.float32))
def test_rows_get_length_one_and_zeros_stay(rows: np.ndarray) -> None:
    lengths = np.linalg.norm(unit_rows(rows), axis=1)

    np.testing.assert_allclose(lengths, rows.any(axis=1), atol=1e-6)
    assert not unit_rows(np.zeros((2, 3), np.int8)).any()


@given(vectors)
def test_four_bits_keep_a_vector_and_keep_it_again(rows: np.ndarray) -> None:
    packed = PackedVectors.of(rows)

    back = np.array([packed[index] for index in range(len(rows))])
    again = PackedVectors.of(back)

    assert packed.nibbles.shape == (len(rows), (rows.shape[1] + 1) // 2)
    np.testing.assert_array_equal(again.nibbles, packed.nibbles)
    np.testing.assert_allclose(again.scales, packed.scales, rtol=1e-5)
    # the product with the vector itself is kept
    squares = np.einsum('ij,ij->i', rows.astype(float), rows)
    np.testing.assert_allclose(
        np.einsum('ij,ij->i', rows.astype(float), back), squares, rtol=1e-4, atol=1e-30
    )


@given(vectors, st.integers(0, 2**32 - 1))
def test_products_are_those_of_the_unpacked_vectors(rows: np.ndarray, seed: int) -> None:
    packed = PackedVectors.of(rows)
    vector = np.random.default_rng(seed).normal(size=rows.shape[1]).astype(np.float32)

    expected = [packed[index].astype(float) @ vector for index in range(len(rows))]

    scale = np.abs(rows).max(initial=0.0) * rows.shape[1]
    np.testing.assert_allclose(packed.products(vector), expected, atol=1e-5 * scale + 1e-30)


def test_cosines_of_long_vectors_are_off_by_two_thousandths() -> None:
    """Lengths of the shipped global descriptors, seen with what looks like them or not."""
    rng = np.random.default_rng(0)
    rows = unit_rows(rng.normal(size=(300, 4096)))
    vector = unit_rows(rows[:1] + rng.normal(0.0, 0.01, (1, 4096)))[0]

    errors = PackedVectors.of(rows).products(vector) - rows @ vector

    assert 0.001 < np.std(errors) < 0.0025
    assert abs(errors[0]) < 0.006
