# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np

from gam_relocalizer.training.batches import STRIDE, mirrored, random_batch, stacked
from gam_relocalizer.training.synthetic import LabelledGraph, labelled_graph


def _graph(seed: int) -> LabelledGraph:
    return labelled_graph(np.random.default_rng([2, seed]), (100, 128), (300, 600))


def _content(graph: LabelledGraph) -> set[tuple[float, ...]]:
    """Coordinates at both ends of every edge, and its label."""
    ends = [graph.keypoints[graph.edges[:, 0]], graph.points[graph.edges[:, 1]]]
    return {tuple(row) for row in np.column_stack([*ends, graph.labels]).tolist()}


def test_sizes_are_round_and_edges_stay_what_they_were() -> None:
    graphs = [_graph(0), _graph(1), _graph(2)]

    batch = stacked(graphs, 128, np.random.default_rng(0))

    assert all(len(a) % STRIDE == 0 for a in (batch.keypoints, batch.points, batch.edges))
    for i, graph in enumerate(graphs):
        part = LabelledGraph(
            batch.keypoints[:, i], batch.points[:, i], batch.edges[:, i], batch.labels[:, i]
        )
        assert _content(part) <= _content(graph)
        assert len(_content(part)) >= 0.85 * min(len(_content(graph)), len(batch.edges))


def test_a_mirror_image_twice_is_the_graph() -> None:
    graph = _graph(0)

    twice = mirrored(mirrored(graph))

    assert not np.array_equal(mirrored(graph).points, graph.points)
    np.testing.assert_array_equal(twice.points, graph.points)
    np.testing.assert_array_equal(twice.keypoints, graph.keypoints)


def test_same_seed_same_batch_of_the_wanted_size() -> None:
    first, second = (
        random_batch(np.random.default_rng(3), 3, (100, 200), (300, 600)) for _ in range(2)
    )

    assert first.labels.shape[1] == 3
    np.testing.assert_array_equal(first.points, second.points)
    np.testing.assert_array_equal(first.edges, second.edges)
