# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from gam_relocalizer.matching.pooling import hungarian_pool, hungarian_pooling


def _random_graph(seed: int, rows: int, columns: int, density: float) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    edges = np.argwhere(rng.random((rows, columns)) < density).astype(np.int64)
    weights = rng.choice([0.0, 0.25, 0.5, 1.0, 2.0], size=len(edges))
    weights = np.where(rng.random(len(edges)) < 0.5, rng.random(len(edges)), weights)
    shuffled = rng.permutation(len(edges))
    return edges[shuffled], weights[shuffled]


@settings(max_examples=100, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    rows=st.integers(1, 15),
    columns=st.integers(1, 15),
    density=st.floats(0.05, 1.0),
)
def test_is_one_to_one_and_as_heavy_as_the_dense_optimum(
    seed: int, rows: int, columns: int, density: float
) -> None:
    edges, weights = _random_graph(seed, rows, columns, density)

    chosen = hungarian_pooling(edges, weights)

    for side in (0, 1):
        picked = edges[chosen, side]
        assert len(np.unique(picked)) == len(picked)
    dense = np.zeros((rows, columns))
    dense[edges[:, 0], edges[:, 1]] = weights
    best = dense[linear_sum_assignment(dense, maximize=True)].sum()
    np.testing.assert_allclose(weights[chosen].sum(), best, atol=1e-9)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), density=st.floats(0.05, 1.0))
def test_neither_the_order_of_edges_nor_another_component_matters(
    seed: int, density: float
) -> None:
    edges, _ = _random_graph(seed, 12, 9, density)
    rng = np.random.default_rng(seed)
    weights = rng.random(len(edges)).astype(np.float32)
    others, weights_of_others = _random_graph(seed + 1, 7, 8, density)
    order = rng.permutation(len(edges) + len(others))

    together = hungarian_pooling(
        np.concatenate([edges, others + 1000])[order],
        np.concatenate([weights, weights_of_others])[order],
    )

    of_first = together[np.argsort(order)][: len(edges)]
    np.testing.assert_array_equal(of_first, hungarian_pooling(edges, weights))


def test_indices_may_be_large_and_sparse() -> None:
    edges = np.array([[10**9, 7], [10**9, 2 * 10**9], [5, 7]])

    np.testing.assert_array_equal(
        hungarian_pooling(edges, np.array([0.9, 0.8, 0.7])), [False, True, True]
    )


def test_a_repeated_edge_is_chosen_once_with_its_greatest_weight() -> None:
    edges = np.array([[0, 0], [0, 0], [0, 0]])

    np.testing.assert_array_equal(
        hungarian_pooling(edges, np.array([0.2, 0.6, 0.4])), [False, True, False]
    )


def test_no_edges() -> None:
    assert hungarian_pooling(np.empty((0, 2), np.int64), np.empty(0)).shape == (0,)


def test_layer_passes_weights_and_gradients_of_chosen_edges_only() -> None:
    edges = np.array([[0, 0], [0, 1], [1, 0]])
    weights = torch.tensor([0.5, 0.4, 0.3], requires_grad=True)

    pooled = hungarian_pool(weights, edges)
    (pooled * torch.tensor([1.0, 2.0, 3.0])).sum().backward()

    torch.testing.assert_close(pooled, torch.tensor([0.0, 0.4, 0.3]))
    torch.testing.assert_close(weights.grad, torch.tensor([0.0, 2.0, 3.0]))
