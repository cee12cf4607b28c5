# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from gam_relocalizer.matching import Gam, NearestNeighbourRatio
from gam_relocalizer.training.synthetic import SyntheticView, synthetic_view

if TYPE_CHECKING:
    from gam_relocalizer.matching import Matcher, Matches


@pytest.fixture(scope='module')
def gam() -> Gam:
    return Gam.load()


@pytest.fixture(scope='module')
def views() -> list[SyntheticView]:
    return [
        synthetic_view(np.random.default_rng([77, i]), (400, 400), (1500, 1500)) for i in range(12)
    ]


def _match(matcher: Matcher, view: SyntheticView) -> Matches:
    return matcher.match(view.keypoints, view.descriptors, view.points, view.point_descriptors)


def _true(matches: Matches, view: SyntheticView) -> np.ndarray:
    return view.labels(np.stack([matches.keypoint_indices, matches.point_indices], axis=1))


def test_finds_more_true_matches_than_nn_ratio_at_no_lower_precision(
    gam: Gam, views: list[SyntheticView]
) -> None:
    found, baseline = {'true': 0, 'all': 0}, {'true': 0, 'all': 0}
    for view in views:
        nn = _match(NearestNeighbourRatio(0.9), view)
        matches = _match(gam, view)
        confident = matches.weights >= 0.5
        baseline['true'] += int(_true(nn, view).sum())
        baseline['all'] += len(nn)
        found['true'] += int(_true(matches, view)[confident].sum())
        found['all'] += int(confident.sum())

    assert found['true'] > 1.5 * baseline['true']
    assert found['true'] / found['all'] > baseline['true'] / baseline['all']


def test_weights_rank_true_matches_first(gam: Gam, views: list[SyntheticView]) -> None:
    top_true = []
    for view in views:
        matches = _match(gam, view)
        best = np.argsort(-matches.weights)[:30]
        top_true.append(_true(matches, view)[best].mean())

    assert np.mean(top_true) > 0.8


def test_matches_are_one_to_one_with_weights_in_range(gam: Gam, views: list[SyntheticView]) -> None:
    for matcher in (gam, NearestNeighbourRatio(1.0)):
        matches = _match(matcher, views[0])
        assert len(np.unique(matches.keypoint_indices)) == len(matches)
        assert len(np.unique(matches.point_indices)) == len(matches)
        assert matches.weights.min() >= 0
        assert matches.weights.max() <= 1


def test_same_input_same_output(gam: Gam, views: list[SyntheticView]) -> None:
    first, second = _match(gam, views[0]), _match(Gam.load(), views[0])

    np.testing.assert_array_equal(first.keypoint_indices, second.keypoint_indices)
    np.testing.assert_array_equal(first.point_indices, second.point_indices)
    np.testing.assert_array_equal(first.weights, second.weights)


@pytest.mark.parametrize('matcher', [Gam.load(), NearestNeighbourRatio()])
@pytest.mark.parametrize(('keypoints', 'points'), [(0, 0), (0, 9), (9, 0)])
def test_nothing_to_match(matcher: Matcher, keypoints: int, points: int) -> None:
    matches = matcher.match(
        np.zeros((keypoints, 2), np.float32),
        np.ones((keypoints, 64), np.float32),
        np.zeros((points, 3)),
        np.ones((points, 64), np.float16),
    )

    assert len(matches) == 0
    assert matches.keypoint_indices.dtype == matches.point_indices.dtype == np.int64


@pytest.mark.parametrize('matcher', [Gam.load(), NearestNeighbourRatio()])
@pytest.mark.parametrize(('keypoints', 'points'), [(1, 1), (1, 2), (2, 1), (5, 2)])
def test_tiny_input_gives_valid_matches(matcher: Matcher, keypoints: int, points: int) -> None:
    rng = np.random.default_rng(0)

    matches = matcher.match(
        rng.normal(size=(keypoints, 2)),
        rng.normal(size=(keypoints, 64)),
        rng.normal(size=(points, 3)),
        rng.normal(size=(points, 64)),
    )

    assert len(matches) <= min(keypoints, points)
    assert np.isfinite(matches.weights).all()


@pytest.mark.parametrize('matcher', [Gam.load(), NearestNeighbourRatio()])
def test_descriptors_that_are_not_numbers_match_nothing(matcher: Matcher) -> None:
    matches = matcher.match(
        np.zeros((5, 2)), np.full((5, 64), np.nan), np.zeros((5, 3)), np.ones((5, 64))
    )

    assert len(matches) == 0


def test_keypoints_and_points_that_are_not_numbers_match_nothing(
    gam: Gam, views: list[SyntheticView]
) -> None:
    view = views[0]
    keypoints, points = view.keypoints.copy(), view.points.copy()
    keypoints[:50] = np.nan
    points[:50] = np.inf

    matches = gam.match(keypoints, view.descriptors, points, view.point_descriptors)

    assert len(matches) > 0
    assert matches.keypoint_indices.min() >= 50
    assert matches.point_indices.min() >= 50


def test_identical_everything_does_not_fail(gam: Gam) -> None:
    matches = gam.match(np.zeros((30, 2)), np.ones((30, 64)), np.zeros((30, 3)), np.ones((30, 64)))

    assert np.isfinite(matches.weights).all()


def test_nearest_neighbour_ratio_by_hand() -> None:
    point_descriptors = np.eye(3, 8)
    descriptors = np.array([[1, 0.1, 0, 0, 0, 0, 0, 0], [1, 0.95, 0, 0, 0, 0, 0, 0]])

    matches = NearestNeighbourRatio(0.8).match(
        np.zeros((2, 2)), descriptors, np.zeros((3, 3)), point_descriptors
    )

    np.testing.assert_array_equal(matches.keypoint_indices, [0])
    np.testing.assert_array_equal(matches.point_indices, [0])


def test_of_two_points_in_one_place_the_one_that_looks_right_is_matched(
    gam: Gam, views: list[SyntheticView]
) -> None:
    view = views[1]
    others = np.random.default_rng(0).normal(size=view.point_descriptors.shape)
    others /= np.linalg.norm(others, axis=1, keepdims=True)
    count = len(view.points)

    matches = gam.match(
        view.keypoints,
        view.descriptors,
        np.concatenate([view.points, view.points]),
        np.concatenate([view.point_descriptors, view.point_descriptors + 0.5 * others]),
    )

    of_original = matches.point_indices[matches.weights > 0.5] < count
    assert len(of_original) > 30
    assert of_original.mean() > 0.7
