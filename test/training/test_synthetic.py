# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import poselib
import pytest

from gam_relocalizer.matching.candidates import knn_ratio
from gam_relocalizer.training.labelled import (
    TRUE_ERROR,
    CandidateRule,
    LabelledGraph,
    labelled_graph,
)
from gam_relocalizer.training.sources import MIN_TRUE_EDGES, GraphSource
from gam_relocalizer.training.synthetic import synthetic_view

SIZE = (150, 400), (400, 1500)


def _rng(seed: int) -> np.random.Generator:
    return np.random.default_rng([1, seed])


def _graph(seed: int) -> LabelledGraph:
    rng = _rng(seed)
    return labelled_graph(synthetic_view(rng, *SIZE), CandidateRule(), rng)


def test_same_seed_same_graph() -> None:
    first, second = (_graph(0) for _ in range(2))

    for name in ('keypoints', 'points', 'edges', 'distances', 'labels'):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_seeds_differ() -> None:
    assert not np.array_equal(_graph(0).edges, _graph(1).edges)


@pytest.mark.parametrize('seed', range(10))
def test_true_edges_obey_one_camera_pose(seed: int) -> None:
    view = synthetic_view(_rng(seed), *SIZE)
    edges = knn_ratio(view.descriptors, view.point_descriptors).edges
    true = edges[view.labels(edges)]
    if len(true) < MIN_TRUE_EDGES:
        true = np.argwhere(
            np.linalg.norm(view.keypoints[:, None] - view.projections[None], axis=2) < TRUE_ERROR
        )
    focal = view.focal_length
    camera = {'model': 'SIMPLE_PINHOLE', 'width': 2, 'height': 2, 'params': [focal, 0, 0]}

    _, info = poselib.estimate_absolute_pose(
        view.keypoints[true[:, 0]].astype(float),
        view.points[true[:, 1]].astype(float),
        camera,
        {'max_reproj_error': 2 * TRUE_ERROR},
        {},
    )

    assert info['inlier_ratio'] > 0.9


def test_graphs_are_complete_and_of_all_difficulties() -> None:
    shares, degrees = [], []
    for graph in GraphSource(CandidateRule(), *SIZE).validation(30):
        assert np.array_equal(np.unique(graph.edges[:, 0]), np.arange(len(graph.keypoints)))
        assert np.array_equal(np.unique(graph.edges[:, 1]), np.arange(len(graph.points)))
        assert np.isfinite(graph.keypoints).all()
        assert np.isfinite(graph.points).all()
        assert graph.labels.sum() >= MIN_TRUE_EDGES
        shares.append(graph.labels.mean())
        degrees.append(len(graph.edges) / len(graph.keypoints))

    assert min(shares) < 0.08
    assert max(shares) > 0.3
    assert 2.0 < np.mean(degrees) <= 3.0


def test_nearest_neighbours_are_often_wrong() -> None:
    right = []
    for seed in range(10):
        view = synthetic_view(_rng(seed), *SIZE)
        nearest = knn_ratio(view.descriptors, view.point_descriptors, k=1).edges
        right.append(view.labels(nearest).mean())

    assert 0.1 < np.mean(right) < 0.6


def test_points_behind_the_camera_are_in_the_map_and_never_true() -> None:
    behind = 0
    for seed in range(10):
        view = synthetic_view(_rng(seed), *SIZE)
        hidden = np.flatnonzero(np.isnan(view.projections).any(axis=1))
        behind += len(hidden)
        edges = np.stack([np.zeros_like(hidden), hidden], axis=1)
        assert not view.labels(edges).any()

    assert behind > 0
