# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gam_relocalizer.matching.bmnet import normalise_points
from gam_relocalizer.matching.candidates import knn_ratio
from gam_relocalizer.training.labelled import (
    TRUE_ERROR,
    CandidateRule,
    labelled_graph,
    meet,
    mirrored,
)

FOCAL = 0.7


@dataclass(frozen=True)
class FlatView:
    """Points before a camera at the origin; every keypoint shows the point of its number."""

    keypoints: np.ndarray
    focal_length: float
    descriptors: np.ndarray
    points: np.ndarray
    point_descriptors: np.ndarray

    def labels(self, edges: np.ndarray) -> np.ndarray:
        return np.asarray(edges[:, 0] == edges[:, 1])


def flat_view(seed: int, keypoints: int = 40, points: int = 60) -> FlatView:
    rng = np.random.default_rng(seed)
    places = rng.uniform([-2, -2, 2], [2, 2, 6], (points, 3)).astype(np.float32)
    looks = rng.normal(size=(points, 8)).astype(np.float32)
    looks /= np.linalg.norm(looks, axis=1, keepdims=True)
    seen = looks[:keypoints] + rng.normal(0, 0.2, (keypoints, 8)).astype(np.float32)
    return FlatView(
        keypoints=FOCAL * places[:keypoints, :2] / places[:keypoints, 2:],
        focal_length=FOCAL,
        descriptors=seen / np.linalg.norm(seen, axis=1, keepdims=True),
        points=places,
        point_descriptors=looks,
    )


def projected(points: np.ndarray) -> np.ndarray:
    return np.asarray(FOCAL * points[:, :2] / points[:, 2:])


@pytest.mark.parametrize(('offset', 'true'), [(0.0, True), (0.99, True), (1.01, False)])
def test_an_edge_is_true_up_to_one_percent_of_the_image(offset: float, true: bool) -> None:  # noqa: FBT001
    keypoints = np.array([[0.1, 0.2]])
    for direction in np.array([[1.0, 0.0], [0.0, -1.0], [0.6, 0.8]]):
        projections = keypoints + offset * TRUE_ERROR * direction

        assert meet(np.array([[0, 0]]), keypoints, projections).tolist() == [true]


def test_a_point_behind_the_camera_meets_nothing() -> None:
    projections = np.full((1, 2), np.nan)

    assert not meet(np.array([[0, 0]]), np.zeros((1, 2)), projections).any()


def test_one_percent_of_the_longer_side_is_one_percent() -> None:
    # keypoints are pixels over 1.2 times the longer side
    assert pytest.approx(6.4) == TRUE_ERROR * 1.2 * 640


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_a_graph_holds_the_candidates_and_what_they_join(seed: int) -> None:
    view = flat_view(seed)
    found = knn_ratio(view.descriptors, view.point_descriptors, 2, 0.5)

    graph = labelled_graph(view, CandidateRule(2, 0.5), np.random.default_rng(0))

    assert np.array_equal(np.unique(graph.edges[:, 0]), np.arange(len(graph.keypoints)))
    assert np.array_equal(np.unique(graph.edges[:, 1]), np.arange(len(graph.points)))
    np.testing.assert_array_equal(
        graph.keypoints[graph.edges[:, 0]], view.keypoints[found.edges[:, 0]]
    )
    used = normalise_points(view.points[np.unique(found.edges[:, 1])])
    np.testing.assert_array_equal(graph.points, used)
    np.testing.assert_array_equal(graph.distances, found.distances)
    np.testing.assert_array_equal(graph.labels, found.edges[:, 0] == found.edges[:, 1])
    assert graph.focal_length == FOCAL


def test_a_view_without_points_is_a_graph_without_edges() -> None:
    graph = labelled_graph(flat_view(0, 0, 5), CandidateRule(), np.random.default_rng(0))

    assert graph.edges.shape == (0, 2)
    assert len(graph.keypoints) == len(graph.points) == len(graph.labels) == 0


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_the_mirror_image_of_a_graph_is_seen_by_one_camera_too(seed: int) -> None:
    graph = labelled_graph(flat_view(seed), CandidateRule(), np.random.default_rng(0))
    # the camera is at the origin, so that the unit of the points changes no projection
    before = meet(graph.edges, graph.keypoints, projected(graph.points))

    mirror = mirrored(graph)

    after = meet(mirror.edges, mirror.keypoints, projected(mirror.points))
    np.testing.assert_array_equal(before, after)
    assert after[mirror.labels].all()
    np.testing.assert_array_equal(mirror.labels, graph.labels)
    np.testing.assert_array_equal(mirror.distances, graph.distances)
    np.testing.assert_array_equal(mirror.keypoints[:, 0], -graph.keypoints[:, 0])
    np.testing.assert_array_equal(mirror.keypoints[:, 1], graph.keypoints[:, 1])


def test_a_mirror_image_twice_is_the_graph() -> None:
    graph = labelled_graph(flat_view(0), CandidateRule(), np.random.default_rng(0))

    twice = mirrored(mirrored(graph))

    assert not np.array_equal(mirrored(graph).points, graph.points)
    np.testing.assert_array_equal(twice.points, graph.points)
    np.testing.assert_array_equal(twice.keypoints, graph.keypoints)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_random_negatives_keep_the_true_edges_and_the_number_of_edges(seed: int) -> None:
    view = flat_view(seed)
    mined = knn_ratio(view.descriptors, view.point_descriptors)
    true = view.labels(mined.edges)

    graph = labelled_graph(view, CandidateRule(mining=False), np.random.default_rng(seed))

    keypoints, points = graph.keypoints[graph.edges[:, 0]], graph.points[graph.edges[:, 1]]
    assert len(graph.edges) == len(mined.edges)
    assert graph.labels[true].all()
    np.testing.assert_array_equal(keypoints[true], view.keypoints[mined.edges[true, 0]])
    np.testing.assert_allclose(graph.distances[true], mined.distances[true], atol=1e-6)
    # a random edge may happen to be true, which its label then says
    np.testing.assert_array_equal(
        graph.labels, np.abs(projected(points) - keypoints).max(axis=1) < 1e-5
    )


def test_random_negatives_look_less_alike_than_mined_ones() -> None:
    view = flat_view(0)

    mined, drawn = (
        labelled_graph(view, CandidateRule(mining=mining), np.random.default_rng(1))
        for mining in (True, False)
    )

    assert drawn.distances[~drawn.labels].mean() > 1.2 * mined.distances[~mined.labels].mean()


def test_random_negatives_are_those_of_the_generator() -> None:
    view, rule = flat_view(0), CandidateRule(mining=False)
    first, same, other = (
        labelled_graph(view, rule, np.random.default_rng(seed)).distances for seed in (1, 1, 2)
    )

    np.testing.assert_array_equal(first, same)
    assert not np.array_equal(first, other)
