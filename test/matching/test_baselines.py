# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from gam_relocalizer.matching.baselines import (
    NearestNeighbourCross,
    NearestNeighbourDistance,
    NearestNeighbourRatio,
)
from gam_relocalizer.matching.matcher import MatchInput

if TYPE_CHECKING:
    from pathlib import Path

    from gam_relocalizer.matching.matcher import Matcher, Matches


def _match(matcher: Matcher, descriptors: np.ndarray, point_descriptors: np.ndarray) -> Matches:
    return matcher.match(
        MatchInput(
            keypoints=np.zeros((len(descriptors), 2)),
            focal_length=1.0,
            descriptors=descriptors,
            points=np.zeros((len(point_descriptors), 3)),
            point_descriptors=point_descriptors,
        )
    )


def _pairs(matches: Matches) -> list[tuple[int, int]]:
    return list(zip(matches.keypoint_indices.tolist(), matches.point_indices.tolist(), strict=True))


def _at(*degrees: float) -> np.ndarray:
    """Unit descriptors in one plane, by their angle."""
    angles = np.radians(degrees)
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _distance(degrees: float) -> float:
    return float(2 * np.sin(np.radians(degrees) / 2))


def _random(seed: int, count: int) -> np.ndarray:
    rows = np.random.default_rng(seed).normal(size=(count, 8))
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def test_ratio_keeps_what_is_clearly_nearer_than_the_second() -> None:
    keypoints, points = _at(10, 44, 100), _at(0, 90, 180)

    matches = _match(NearestNeighbourRatio(0.8), keypoints, points)

    assert _pairs(matches) == [(0, 0), (2, 1)]
    np.testing.assert_allclose(
        matches.weights,
        [1 - _distance(10) / _distance(80), 1 - _distance(10) / _distance(80)],
        rtol=1e-5,
    )


def test_ratio_without_a_second_point_keeps_the_only_one() -> None:
    assert _pairs(_match(NearestNeighbourRatio(0.5), _at(10), _at(0))) == [(0, 0)]


def test_ratio_rejects_what_looks_the_same_as_another() -> None:
    assert _pairs(_match(NearestNeighbourRatio(0.9), _at(0), _at(0, 0))) == []


def test_cross_keeps_what_is_nearest_from_both_sides() -> None:
    # 20 looks to 30, which looks back to 28; 28 and 30, 100 and 110 choose each other
    keypoints, points = _at(20, 28, 100), _at(30, 110, 250)

    matches = _match(NearestNeighbourCross(), keypoints, points)

    assert _pairs(matches) == [(1, 0), (2, 1)]
    np.testing.assert_allclose(
        matches.weights, [1 - _distance(2) / 2, 1 - _distance(10) / 2], rtol=1e-5
    )


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 10_000), keypoints=st.integers(1, 60), points=st.integers(1, 60))
def test_cross_agrees_with_the_definition(seed: int, keypoints: int, points: int) -> None:
    queries, map_side = _random(seed, keypoints), _random(seed + 1, points)
    distances = cdist(queries, map_side)
    forth, back = distances.argmin(axis=1), distances.argmin(axis=0)

    matches = _match(NearestNeighbourCross(), queries, map_side)

    assert _pairs(matches) == [(i, j) for i, j in enumerate(forth.tolist()) if back[j] == i]


def test_distance_keeps_what_is_near_enough() -> None:
    keypoints, points = _at(10, 60, 130), _at(0, 90)

    matches = _match(NearestNeighbourDistance(_distance(31)), keypoints, points)

    assert _pairs(matches) == [(0, 0), (1, 1)]
    np.testing.assert_allclose(
        matches.weights, [1 - _distance(10) / 2, 1 - _distance(30) / 2], rtol=1e-5
    )


@pytest.mark.parametrize('matcher', [NearestNeighbourRatio(1.0), NearestNeighbourDistance(2.0)])
def test_a_point_keeps_its_closest_keypoint(matcher: Matcher) -> None:
    assert _pairs(_match(matcher, _at(10, 5, 20), _at(0, 180))) == [(1, 0)]


@pytest.mark.parametrize('matcher', [NearestNeighbourRatio(1.0), NearestNeighbourDistance(2.0)])
def test_of_equally_close_keypoints_a_point_keeps_the_first(matcher: Matcher) -> None:
    assert _pairs(_match(matcher, _at(10, 10, 10), _at(0, 180))) == [(0, 0)]


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), looser=st.floats(0.0, 1.0), tighter=st.floats(0.0, 1.0))
def test_a_tighter_threshold_only_takes_matches_away(
    seed: int, looser: float, tighter: float
) -> None:
    queries, map_side = _random(seed, 30), _random(seed + 1, 30)
    tighter, looser = sorted((tighter, looser))

    for matcher, scale in ((NearestNeighbourRatio, 1.0), (NearestNeighbourDistance, 2.0)):
        few = _pairs(_match(matcher(scale * tighter), queries, map_side))
        many = _pairs(_match(matcher(scale * looser), queries, map_side))
        assert set(few) <= set(many)


@pytest.mark.parametrize(
    'matcher', [NearestNeighbourRatio(), NearestNeighbourCross(), NearestNeighbourDistance()]
)
def test_finds_the_points_again_in_a_large_memory_mapped_map(
    matcher: Matcher, tmp_path: Path
) -> None:
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(6000, 32))
    np.save(tmp_path / 'map.npy', rows.astype(np.float16))
    mapped = np.load(tmp_path / 'map.npy', mmap_mode='r')
    seen = rng.permutation(6000)[:200]

    matches = _match(matcher, rows[seen] + 0.1 * rng.normal(size=(200, 32)), mapped)

    assert len(matches) == 200
    np.testing.assert_array_equal(matches.point_indices, seen[matches.keypoint_indices])
    assert matches.weights.min() > 0.5
