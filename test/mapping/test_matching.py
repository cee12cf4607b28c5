# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gam_relocalizer.mapping.matching import mutual_nearest_neighbours


def unit_vectors(count: int, seed: int) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, 8)).astype(np.float32)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@given(
    st.integers(0, 40),
    st.integers(0, 40),
    st.integers(0, 99),
    st.sampled_from([-1.0, 0.5]),
    st.sampled_from([0.8, 1.0]),
)
def test_agrees_with_the_definition(
    first_count: int, second_count: int, seed: int, min_similarity: float, max_ratio: float
) -> None:
    first, second = unit_vectors(first_count, seed), unit_vectors(second_count, seed + 100)
    similarity = first @ second.T

    def distinctive(row: np.ndarray) -> bool:
        distances = np.sqrt(2 - 2 * np.sort(row)[::-1])
        return len(row) < 2 or distances[0] <= max_ratio * distances[1]

    found = mutual_nearest_neighbours(first, second, min_similarity, max_ratio)

    expected = [
        (i, j)
        for i in range(first_count)
        for j in range(second_count)
        if similarity[i, j] == similarity[i].max() == similarity[:, j].max()
        and similarity[i, j] >= min_similarity
        and distinctive(similarity[i])
        and distinctive(similarity[:, j])
    ]
    assert [tuple(pair) for pair in found.tolist()] == expected


def test_finds_a_permutation_across_blocks() -> None:
    first = unit_vectors(9000, seed=0)
    order = np.random.default_rng(1).permutation(9000)

    found = mutual_nearest_neighbours(first, first[order], 0.9, 0.95)

    np.testing.assert_array_equal(order[found[:, 1]], found[:, 0])
    assert len(found) == 9000


def test_a_repeated_element_is_not_matched() -> None:
    window, door = unit_vectors(2, seed=0)

    found = mutual_nearest_neighbours(
        np.stack([window, door]), np.stack([window, door, window]), 0.9, 0.95
    )

    assert found.tolist() == [[1, 1]]
