# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import poselib
import pytest

from gam_relocalizer.matching.candidates import knn_ratio
from gam_relocalizer.training.synthetic import (
    MIN_TRUE_EDGES,
    TRUE_ERROR,
    labelled_graph,
    synthetic_view,
)

SIZE = {'keypoints': (150, 400), 'points': (400, 1500)}


def _rng(seed: int) -> np.random.Generator:
    return np.random.default_rng([1, seed])


def test_same_seed_same_graph() -> None:
    first, second = (labelled_graph(_rng(0), **SIZE) for _ in range(2))

    for name in ('keypoints', 'points', 'edges', 'labels'):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_seeds_differ() -> None:
    assert not np.array_equal(
        labelled_graph(_rng(0), **SIZE).edges, labelled_graph(_rng(1), **SIZE).edges
    )


@pytest.mark.parametrize('seed', range(10))
def test_true_edges_obey_one_camera_pose(seed: int) -> None:
    view = synthetic_view(_rng(seed), **SIZE)
    edges = knn_ratio(view.descriptors, view.point_descriptors).edges
    true = edges[view.labels(edges)]
    if len(true) < MIN_TRUE_EDGES:
        true = np.argwhere(
            np.linalg.norm(view.keypoints[:, None] - view.projections[None], axis=2) < TRUE_ERROR
        )
    errors = []
    for focal in np.geomspace(0.25, 1.3, 12):
        camera = {'model': 'SIMPLE_PINHOLE', 'width': 2, 'height': 2, 'params': [focal, 0, 0]}
        _, info = poselib.estimate_absolute_pose(
            view.keypoints[true[:, 0]].astype(float),
            view.points[true[:, 1]].astype(float),
            camera,
            {'max_reproj_error': 2 * TRUE_ERROR},
            {},
        )
        errors.append(info['inlier_ratio'])

    assert max(errors) > 0.9


def test_graphs_are_complete_and_of_all_difficulties() -> None:
    shares, degrees = [], []
    for seed in range(30):
        graph = labelled_graph(_rng(seed), **SIZE)
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
        view = synthetic_view(_rng(seed), **SIZE)
        nearest = knn_ratio(view.descriptors, view.point_descriptors, k=1).edges
        right.append(view.labels(nearest).mean())

    assert 0.1 < np.mean(right) < 0.6


def test_points_behind_the_camera_are_in_the_map_and_never_true() -> None:
    behind = 0
    for seed in range(10):
        view = synthetic_view(_rng(seed), **SIZE)
        hidden = np.flatnonzero(np.isnan(view.projections).any(axis=1))
        behind += len(hidden)
        edges = np.stack([np.zeros_like(hidden), hidden], axis=1)
        assert not view.labels(edges).any()

    assert behind > 0
