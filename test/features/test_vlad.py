# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gam_relocalizer.errors import MapBuildError
from gam_relocalizer.features.vlad import Vlad


def unit_vectors(count: int, dimension: int = 8, seed: int = 0) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, dimension)).astype(np.float32)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


VLAD = Vlad.train(unit_vectors(2000), words=16)


@given(count=st.integers(1, 200), seed=st.integers(0, 1000))
def test_length_is_one(count: int, seed: int) -> None:
    described = VLAD.aggregate(unit_vectors(count, seed=seed))

    assert described.shape == (VLAD.dimension,) == (16 * 8,)
    assert np.linalg.norm(described) == pytest.approx(1.0, abs=1e-5)


@given(seed=st.integers(0, 1000))
def test_order_and_repetition_do_not_matter(seed: int) -> None:
    descriptors = unit_vectors(50, seed=seed)
    shuffled = np.random.default_rng(seed).permutation(descriptors)

    expected = VLAD.aggregate(descriptors)

    np.testing.assert_allclose(VLAD.aggregate(shuffled), expected, atol=1e-5)
    np.testing.assert_allclose(VLAD.aggregate(np.repeat(descriptors, 3, 0)), expected, atol=1e-5)


def test_no_descriptors_give_zero() -> None:
    np.testing.assert_array_equal(VLAD.aggregate(unit_vectors(0)), np.zeros(VLAD.dimension))


def test_same_place_is_nearer_than_another() -> None:
    place, other = unit_vectors(300, seed=1), unit_vectors(300, seed=2)
    again = place[:200] + 0.05 * unit_vectors(200, seed=3)

    similarity = VLAD.aggregate(again) @ np.stack([VLAD.aggregate(place), VLAD.aggregate(other)]).T

    assert similarity[0] > similarity[1] + 0.2


def test_training_is_repeatable() -> None:
    descriptors = unit_vectors(30_000)

    first, second = Vlad.train(descriptors, words=4), Vlad.train(descriptors, words=4)

    np.testing.assert_array_equal(first.codebook, second.codebook)


def test_finds_the_clusters() -> None:
    centres = unit_vectors(4, seed=7)
    spread = np.random.default_rng(0).normal(scale=0.01, size=(4, 100, 8))

    codebook = Vlad.train((centres[:, None] + spread).reshape(-1, 8), words=4).codebook

    distances = np.linalg.norm(codebook[:, None] - centres[None], axis=-1)
    assert sorted(distances.argmin(axis=1)) == [0, 1, 2, 3]
    assert distances.min(axis=1).max() < 0.01


def test_has_no_more_words_than_descriptors() -> None:
    assert Vlad.train(unit_vectors(5), words=64).codebook.shape == (5, 8)


def test_cannot_be_trained_on_nothing() -> None:
    with pytest.raises(MapBuildError):
        Vlad.train(unit_vectors(0))
