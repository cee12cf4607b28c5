# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from gam_relocalizer.matching.baselines import NearestNeighbourRatio
from gam_relocalizer.matching.candidates import knn_ratio
from gam_relocalizer.matching.gam import Gam
from gam_relocalizer.matching.matcher import MatchInput
from gam_relocalizer.matching.registry import LEARNED_MATCHERS, create_matcher
from gam_relocalizer.matching.weights import load_weights
from gam_relocalizer.training.synthetic import SyntheticView, synthetic_view

if TYPE_CHECKING:
    from gam_relocalizer.matching.matcher import Matcher, Matches


@pytest.fixture(scope='module')
def gam() -> Matcher:
    return create_matcher()


@pytest.fixture(scope='module')
def views() -> list[SyntheticView]:
    return [
        synthetic_view(np.random.default_rng([77, i]), (400, 400), (1500, 1500)) for i in range(12)
    ]


def _match(matcher: Matcher, view: SyntheticView) -> Matches:
    return matcher.match(_input(view))


def _input(view: SyntheticView) -> MatchInput:
    return MatchInput(
        keypoints=view.keypoints,
        focal_length=view.focal_length,
        descriptors=view.descriptors,
        points=view.points,
        point_descriptors=view.point_descriptors,
    )


def _true(matches: Matches, view: SyntheticView) -> np.ndarray:
    return view.labels(np.stack([matches.keypoint_indices, matches.point_indices], axis=1))


def test_finds_more_true_matches_than_nn_ratio_at_no_lower_precision(
    gam: Matcher, views: list[SyntheticView]
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


def test_weights_rank_true_matches_first(gam: Matcher, views: list[SyntheticView]) -> None:
    top_true = []
    for view in views:
        matches = _match(gam, view)
        best = np.argsort(-matches.weights)[:30]
        top_true.append(_true(matches, view)[best].mean())

    assert np.mean(top_true) > 0.8


def test_matches_are_one_to_one_with_weights_in_range(
    gam: Matcher, views: list[SyntheticView]
) -> None:
    for matcher in (gam, NearestNeighbourRatio(1.0)):
        matches = _match(matcher, views[0])
        assert len(np.unique(matches.keypoint_indices)) == len(matches)
        assert len(np.unique(matches.point_indices)) == len(matches)
        assert matches.weights.min() >= 0
        assert matches.weights.max() <= 1


def test_same_input_same_output(gam: Matcher, views: list[SyntheticView]) -> None:
    first, second = _match(gam, views[0]), _match(create_matcher(), views[0])

    np.testing.assert_array_equal(first.keypoint_indices, second.keypoint_indices)
    np.testing.assert_array_equal(first.point_indices, second.point_indices)
    np.testing.assert_array_equal(first.weights, second.weights)


def test_absurd_places_do_not_spoil_the_others(gam: Matcher, views: list[SyntheticView]) -> None:
    view = views[0]
    keypoints, points = view.keypoints.copy(), view.points.copy()
    keypoints[:50] = np.nan
    points[:50] = np.inf

    matches = gam.match(replace(_input(view), keypoints=keypoints, points=points))

    assert len(matches) > 0
    assert matches.keypoint_indices.min() >= 50
    assert matches.point_indices.min() >= 50


def test_matches_below_the_least_weight_are_left_out(views: list[SyntheticView]) -> None:
    network, _ = load_weights(LEARNED_MATCHERS['gam'].shipped)

    every = _match(Gam(network), views[0])
    likely = _match(Gam(network, least_weight=0.5), views[0])

    expected = every.weights >= 0.5
    np.testing.assert_array_equal(likely.keypoint_indices, every.keypoint_indices[expected])
    np.testing.assert_array_equal(likely.point_indices, every.point_indices[expected])


def test_nearest_is_what_a_keypoint_looks_most_like(views: list[SyntheticView]) -> None:
    network, _ = load_weights(LEARNED_MATCHERS['gam'].shipped)
    view = views[0]
    candidates = knn_ratio(view.descriptors, view.point_descriptors)
    _, first = np.unique(candidates.edges[:, 0], return_index=True)

    matches = _match(Gam(network, pooling=False), view)

    np.testing.assert_array_equal(np.flatnonzero(matches.nearest), first)


def test_without_pooling_every_likely_candidate_is_a_match(views: list[SyntheticView]) -> None:
    network, _ = load_weights(LEARNED_MATCHERS['gam'].shipped)
    view = views[0]
    candidates = knn_ratio(view.descriptors, view.point_descriptors)

    matches = _match(Gam(network, pooling=False), view)

    np.testing.assert_array_equal(matches.keypoint_indices, candidates.edges[:, 0])
    np.testing.assert_array_equal(matches.point_indices, candidates.edges[:, 1])


def test_of_two_points_in_one_place_the_one_that_looks_right_is_matched(
    gam: Matcher, views: list[SyntheticView]
) -> None:
    view = views[1]
    others = np.random.default_rng(0).normal(size=view.point_descriptors.shape)
    others /= np.linalg.norm(others, axis=1, keepdims=True)
    count = len(view.points)

    matches = gam.match(
        replace(
            _input(view),
            points=np.concatenate([view.points, view.points]),
            point_descriptors=np.concatenate(
                [view.point_descriptors, view.point_descriptors + 0.5 * others]
            ),
        )
    )

    of_original = matches.point_indices[matches.weights > 0.5] < count
    assert len(of_original) > 30
    assert of_original.mean() > 0.7
