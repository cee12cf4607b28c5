# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from gam_relocalizer.mapping.pairs import (
    EXHAUSTIVE_UP_TO,
    RETRIEVED_NEIGHBOURS,
    SEQUENTIAL_NEIGHBOURS,
    choose_pairs,
    choose_pairs_between,
)


def loop_descriptors(count: int) -> np.ndarray:
    """Two rounds of the same circle: image i looks like image i + count / 2."""
    angle = np.arange(count) * 4 * np.pi / count
    harmonics = [f(k * angle) for k in (1, 2, 3) for f in (np.cos, np.sin)]
    return np.stack(harmonics, axis=1).astype(np.float32) / np.sqrt(3)


@pytest.mark.parametrize('count', [0, 1, 2, EXHAUSTIVE_UP_TO])
def test_small_sets_are_matched_exhaustively(count: int) -> None:
    assert len(choose_pairs(loop_descriptors(max(count, 1))[:count])) == count * (count - 1) // 2


def test_neighbours_in_sequence_are_matched() -> None:
    pairs = set(choose_pairs(loop_descriptors(200)))

    for first in range(200):
        for second in range(first + 1, min(first + SEQUENTIAL_NEIGHBOURS + 1, 200)):
            assert (first, second) in pairs


def test_second_round_is_matched_with_the_first() -> None:
    pairs = set(choose_pairs(loop_descriptors(200)))

    assert all((image, image + 100) in pairs for image in range(100))


def test_pairs_are_sorted_unique_and_grow_linearly() -> None:
    pairs = choose_pairs(loop_descriptors(400))

    assert pairs == sorted(set(pairs))
    assert all(first < second for first, second in pairs)
    assert len(pairs) <= 400 * (SEQUENTIAL_NEIGHBOURS + RETRIEVED_NEIGHBOURS)


def test_one_image_more_than_exhaustive_is_still_complete_near_by() -> None:
    pairs = set(choose_pairs(loop_descriptors(EXHAUSTIVE_UP_TO + 1)))

    assert all((image, image + 1) in pairs for image in range(EXHAUSTIVE_UP_TO))


def test_two_small_sets_are_compared_completely() -> None:
    pairs = choose_pairs_between(np.zeros((2, 3), np.float32))

    assert pairs == [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2)]


def test_of_two_large_sets_the_most_alike_are_compared() -> None:
    likeness = np.random.default_rng(0).random((30, 50), dtype=np.float32)

    pairs = choose_pairs_between(likeness)

    assert len(pairs) == 30 * RETRIEVED_NEIGHBOURS
    for image, row in enumerate(likeness):
        chosen = [other for one, other in pairs if one == image]
        assert row[chosen].min() >= np.delete(row, chosen).max()
