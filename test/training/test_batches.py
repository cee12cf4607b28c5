# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gam_relocalizer.training.batches import STRIDE, GraphBatch, side_by_side, stacked
from gam_relocalizer.training.labelled import LabelledGraph

FIELDS = ('keypoints', 'points', 'edges', 'distances', 'labels')


def _graph(seed: int, keypoints: int = 100, points: int = 180, edges: int = 250) -> LabelledGraph:
    rng = np.random.default_rng(seed)
    return LabelledGraph(
        keypoints=rng.normal(size=(keypoints, 2)).astype(np.float32),
        points=rng.normal(size=(points, 3)).astype(np.float32),
        edges=rng.integers([keypoints, points], size=(edges, 2)),
        distances=rng.random(edges).astype(np.float32),
        labels=rng.random(edges) < 0.3,
        focal_length=0.5 + 0.1 * seed,
    )


def _alone(batch: GraphBatch, index: int) -> LabelledGraph:
    arrays = {name: getattr(batch, name)[:, index] for name in FIELDS}
    return LabelledGraph(**arrays, focal_length=float(batch.focal_lengths[index]))


def _content(graph: LabelledGraph) -> set[tuple[float, ...]]:
    """Coordinates at both ends of every edge, what is known about it, and its label."""
    ends = [graph.keypoints[graph.edges[:, 0]], graph.points[graph.edges[:, 1]]]
    return {tuple(row) for row in np.column_stack([*ends, graph.distances, graph.labels]).tolist()}


def test_graphs_side_by_side_are_what_they_were() -> None:
    graphs = [_graph(0), _graph(1), _graph(2)]

    batch = side_by_side(graphs)

    for i, graph in enumerate(graphs):
        for name in FIELDS:
            np.testing.assert_array_equal(getattr(_alone(batch, i), name), getattr(graph, name))
    np.testing.assert_allclose(batch.focal_lengths, [0.5, 0.6, 0.7], rtol=1e-6)


def test_graphs_of_other_sizes_do_not_fit_side_by_side() -> None:
    with pytest.raises(ValueError, match='shape'):
        side_by_side([_graph(0), _graph(1, edges=251)])


@settings(max_examples=30, deadline=None)
@given(
    sizes=st.lists(
        st.tuples(st.integers(1, 150), st.integers(1, 200), st.integers(1, 400)),
        min_size=1,
        max_size=4,
    )
)
def test_sizes_are_round_and_edges_stay_what_they_were(sizes: list[tuple[int, int, int]]) -> None:
    graphs = [_graph(i, *size) for i, size in enumerate(sizes)]

    batch = stacked(graphs, np.random.default_rng(0))

    assert all(len(a) % STRIDE == 0 for a in (batch.keypoints, batch.points, batch.edges))
    for i, graph in enumerate(graphs):
        part = _content(_alone(batch, i))
        assert part <= _content(graph)
        assert len(part) == min(len(graph.edges), len(batch.edges))
        assert batch.focal_lengths[i] == np.float32(graph.focal_length)


def test_keypoints_and_points_are_kept_when_edges_are_left_out() -> None:
    graphs = [_graph(0, edges=300), _graph(1, edges=60)]

    batch = stacked(graphs, np.random.default_rng(0))

    assert len(batch.edges) == 192
    for i, graph in enumerate(graphs):
        np.testing.assert_array_equal(batch.keypoints[:100, i], graph.keypoints)
        np.testing.assert_array_equal(batch.points[:180, i], graph.points)


def test_same_generator_same_batch() -> None:
    graphs = [_graph(0, edges=300), _graph(1, edges=60)]
    first, same, other = (stacked(graphs, np.random.default_rng(seed)) for seed in (1, 1, 2))

    np.testing.assert_array_equal(first.edges, same.edges)
    assert not np.array_equal(first.edges, other.edges)


def test_a_network_sees_all_but_the_labels() -> None:
    batch = side_by_side([_graph(0), _graph(1)])

    graphs = batch.graphs()

    for name in ('keypoints', 'points', 'edges', 'distances', 'focal_lengths'):
        tensor = getattr(graphs, name)
        assert tensor.dtype == (torch.int64 if name == 'edges' else torch.float32)
        np.testing.assert_array_equal(tensor.numpy(), getattr(batch, name))
