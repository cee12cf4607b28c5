# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from gam_relocalizer.matching import candidates
from gam_relocalizer.matching.candidates import knn_ratio


def _unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def _descriptors(seed: int, count: int, dimension: int = 16) -> np.ndarray:
    rows = np.random.default_rng(seed).normal(size=(count, dimension))
    return _unit(rows).astype(np.float32)


def _edges_by_definition(
    queries: np.ndarray, points: np.ndarray, k: int, ratio: float
) -> list[tuple[int, int]]:
    distances = cdist(queries.astype(np.float64), points.astype(np.float64))
    edges = []
    for keypoint, row in enumerate(distances):
        nearest = np.argsort(row, kind='stable')[:k]
        first = row[nearest[0]]
        edges += [(keypoint, int(j)) for j in nearest if j == nearest[0] or first / row[j] >= ratio]
    return edges


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    keypoints=st.integers(1, 20),
    points=st.integers(1, 150),
    k=st.integers(1, 8),
    ratio=st.one_of(st.sampled_from([0.0, 0.5, 0.7, 0.9, 1.0]), st.floats(0.0, 1.0)),
)
def test_agrees_with_the_definition(
    seed: int, keypoints: int, points: int, k: int, ratio: float
) -> None:
    queries, map_side = _descriptors(seed, keypoints), _descriptors(seed + 1, points)

    found = knn_ratio(queries, map_side, k, ratio)

    assert [tuple(e) for e in found.edges] == _edges_by_definition(queries, map_side, k, ratio)
    exact = np.linalg.norm(queries[found.edges[:, 0]] - map_side[found.edges[:, 1]], axis=1)
    np.testing.assert_allclose(found.distances, exact, atol=1e-5)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), points=st.integers(200, 500), k=st.integers(1, 8))
def test_many_blocks_and_tiles_agree_with_the_definition(seed: int, points: int, k: int) -> None:
    queries, map_side = _descriptors(seed, 20), _descriptors(seed + 1, points)
    gone = np.random.default_rng(seed).choice(points, size=points // 3, replace=False)
    map_side[gone] = np.nan
    present = np.setdiff1d(np.arange(points), gone)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(candidates, 'BLOCK', 64)
        patch.setattr(candidates, 'TILE', 6)
        edges = knn_ratio(queries, map_side, k, 0.7).edges

    by_definition = _edges_by_definition(queries, map_side[present], k, 0.7)
    assert [tuple(e) for e in edges] == [(i, present[j]) for i, j in by_definition]


def test_blocks_do_not_change_the_result(monkeypatch: pytest.MonkeyPatch) -> None:
    queries, map_side = _descriptors(0, 40), _descriptors(1, 1000)
    whole = knn_ratio(queries, map_side)

    monkeypatch.setattr(candidates, 'BLOCK', 96)
    in_blocks = knn_ratio(queries, map_side)

    np.testing.assert_array_equal(in_blocks.edges, whole.edges)
    np.testing.assert_array_equal(in_blocks.distances, whole.distances)


class _Watched(np.ndarray):
    """An array that knows the most rows that were read of it at once."""

    most = 0

    def __getitem__(self, key: object) -> np.ndarray:
        rows = np.asarray(self)[key]
        _Watched.most = max(_Watched.most, len(rows))
        return rows


def test_never_reads_more_than_a_block_of_a_large_map() -> None:
    queries, large = _descriptors(0, 5), _descriptors(1, 5 * candidates.BLOCK)

    knn_ratio(queries, large.view(_Watched))

    assert 0 < _Watched.most <= candidates.BLOCK


def test_a_block_without_anything_usable_is_no_neighbour(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(candidates, 'BLOCK', 64)
    queries, map_side = _descriptors(0, 5), np.zeros((640, 16), np.float32)
    map_side[130] = queries[0]
    map_side[500] = queries[1]

    edges = knn_ratio(queries, map_side, k=8, ratio=0.0).edges

    assert sorted(map(tuple, edges)) == [(i, j) for i in range(5) for j in (130, 500)]


def test_ratio_one_is_the_nearest_neighbour_and_zero_all_k() -> None:
    queries, map_side = _descriptors(0, 40), _descriptors(1, 100)

    for k in range(1, 9):
        nearest = knn_ratio(queries, map_side, k, ratio=1.0).edges
        np.testing.assert_array_equal(nearest, knn_ratio(queries, map_side, k=1).edges)
        assert len(knn_ratio(queries, map_side, k, ratio=0.0).edges) == k * 40


@pytest.mark.parametrize('k', [1, 2, 5, 8])
def test_a_greater_ratio_only_takes_candidates_away(k: int) -> None:
    queries, map_side = _descriptors(0, 40), _descriptors(1, 100)
    of_ratio = [
        {tuple(edge) for edge in knn_ratio(queries, map_side, k, ratio).edges}
        for ratio in np.linspace(0, 1, 11)
    ]

    for fewer, more in pairwise(reversed(of_ratio)):
        assert fewer <= more


def test_a_float16_map_gives_the_edges_of_its_float32_copy(tmp_path) -> None:  # noqa: ANN001
    queries, half = _descriptors(0, 40), _descriptors(1, 300).astype(np.float16)
    np.save(tmp_path / 'map.npy', half)
    mapped = np.load(tmp_path / 'map.npy', mmap_mode='r')

    from_map = knn_ratio(queries, mapped)

    np.testing.assert_array_equal(from_map.edges, knn_ratio(queries, half.astype(np.float32)).edges)


def test_length_of_descriptors_does_not_matter() -> None:
    queries, map_side = _descriptors(0, 40), _descriptors(1, 300)
    scale = np.linspace(0.1, 10, 300, dtype=np.float32)[:, None]

    np.testing.assert_array_equal(
        knn_ratio(3 * queries, scale * map_side).edges, knn_ratio(queries, map_side).edges
    )


def test_equal_distances_go_by_lower_index() -> None:
    queries = _descriptors(0, 1)
    map_side = np.repeat(queries, 200, axis=0)

    found = knn_ratio(queries, map_side)

    np.testing.assert_array_equal(found.edges, [[0, 0], [0, 1], [0, 2]])
    np.testing.assert_array_equal(found.distances, [0, 0, 0])


def test_an_exact_match_leaves_no_room_for_others() -> None:
    queries, map_side = _descriptors(0, 1), _descriptors(1, 50)
    map_side[7] = queries[0]

    np.testing.assert_array_equal(knn_ratio(queries, map_side).edges, [[0, 7]])


@pytest.mark.parametrize('value', [np.nan, np.inf, -np.inf, 0.0])
def test_unusable_rows_take_no_part(value: float) -> None:
    queries, map_side = _descriptors(0, 10), _descriptors(1, 20)
    queries[3] = value
    map_side[[0, 5]] = value

    edges = knn_ratio(queries, map_side, k=20, ratio=0.0).edges

    assert len(edges) == 9 * 18
    assert 3 not in edges[:, 0]
    assert not {0, 5} & set(edges[:, 1].tolist())


def test_only_unusable_rows_on_a_side_give_nothing() -> None:
    useless = np.zeros((40, 16), np.float16)

    assert len(knn_ratio(_descriptors(0, 5), useless).edges) == 0
    assert len(knn_ratio(useless, _descriptors(0, 5)).edges) == 0


@pytest.mark.parametrize(('keypoints', 'points'), [(0, 5), (5, 0), (0, 0)])
def test_nothing_on_one_side_gives_nothing(keypoints: int, points: int) -> None:
    found = knn_ratio(np.empty((keypoints, 16), np.float32), np.empty((points, 16), np.float16))

    assert found.edges.shape == (0, 2)
    assert found.distances.shape == (0,)


def test_fewer_points_than_neighbours() -> None:
    found = knn_ratio(_descriptors(0, 5), _descriptors(1, 2), k=3, ratio=0.0)

    assert len(found.edges) == 10
