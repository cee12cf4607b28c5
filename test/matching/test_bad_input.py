# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What no camera and no map should hand to a matcher, and one day will."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gam_relocalizer.errors import MatchingError
from gam_relocalizer.matching.baselines import (
    NearestNeighbourCross,
    NearestNeighbourDistance,
    NearestNeighbourRatio,
)
from gam_relocalizer.matching.bmnet import BMNet, BMNetConfig
from gam_relocalizer.matching.gam import Gam
from gam_relocalizer.matching.gamnet import GamNet, GamNetConfig
from gam_relocalizer.matching.lgcnet import LgcNet, LgcNetConfig
from gam_relocalizer.matching.matcher import Matcher, Matches, MatchInput
from gam_relocalizer.matching.oanet import OaNet, OaNetConfig

torch.manual_seed(0)
MATCHERS = {
    'ratio': NearestNeighbourRatio(),
    'any-ratio': NearestNeighbourRatio(1.0),
    'cross': NearestNeighbourCross(),
    'distance': NearestNeighbourDistance(),
    'bmnet': Gam(BMNet(BMNetConfig(point_blocks=2, edge_blocks=2, point_width=8))),
    'knn-bmnet': Gam(
        BMNet(BMNetConfig(point_blocks=2, edge_blocks=2, point_width=8)), neighbours=8, ratio=0.0
    ),
    'gamnet': Gam(GamNet(GamNetConfig(blocks=2, width=8))),
    'lgcnet': Gam(LgcNet(LgcNetConfig(blocks=2, width=8)), neighbours=1, ratio=1.0),
    'oanet': Gam(
        OaNet(OaNetConfig(blocks=2, filters=1, width=8, clusters=4)), neighbours=1, ratio=1.0
    ),
}
Input = dict[str, Any]

ARRAYS = ('keypoints', 'descriptors', 'points', 'point_descriptors')

every_matcher = pytest.mark.parametrize('matcher', MATCHERS.values(), ids=MATCHERS)


def _input(keypoints: int, points: int, seed: int = 0) -> Input:
    """Keypoints that look like the points of the same index, all distinct."""
    rng = np.random.default_rng(seed)
    looks = rng.normal(size=(max(keypoints, points), 16)).astype(np.float32)
    return {
        'keypoints': rng.normal(size=(keypoints, 2)).astype(np.float32),
        'focal_length': 0.8,
        'descriptors': looks[:keypoints],
        'points': rng.normal(size=(points, 3)),
        'point_descriptors': looks[:points].astype(np.float16),
    }


def _assert_valid(matches: Matches, given_input: Input) -> None:
    assert isinstance(matches, Matches)
    indices = {
        'keypoints': matches.keypoint_indices,
        'points': matches.point_indices,
    }
    for name, index in indices.items():
        assert index.dtype == np.int64
        assert index.shape == (len(matches),)
        assert len(np.unique(index)) == len(index)
        assert np.isin(index, np.arange(len(given_input[name]))).all()
        assert np.isfinite(given_input[name][index]).all()
    assert matches.weights.dtype == np.float32
    assert matches.weights.shape == (len(matches),)
    assert ((matches.weights >= 0) & (matches.weights <= 1)).all()


@every_matcher
@pytest.mark.parametrize(('keypoints', 'points'), [(0, 0), (0, 9), (9, 0)])
def test_nothing_on_a_side_matches_nothing(matcher: Matcher, keypoints: int, points: int) -> None:
    nothing = _input(keypoints, points)

    matches = matcher.match(MatchInput(**nothing))

    assert len(matches) == 0
    _assert_valid(matches, nothing)


@every_matcher
@pytest.mark.parametrize(('keypoints', 'points'), [(1, 1), (1, 2), (2, 1), (9, 2), (2, 9)])
def test_fewer_than_k_of_a_kind_still_match(matcher: Matcher, keypoints: int, points: int) -> None:
    few = _input(keypoints, points)

    matches = matcher.match(MatchInput(**few))

    assert len(matches) > 0
    _assert_valid(matches, few)


@every_matcher
@pytest.mark.parametrize('value', [np.nan, np.inf, -np.inf, 0.0])
@pytest.mark.parametrize('name', ['descriptors', 'point_descriptors'])
def test_only_descriptors_without_direction_match_nothing(
    matcher: Matcher, name: str, value: float
) -> None:
    bad = _input(9, 9)
    bad[name] = np.full_like(bad[name], value)

    matches = matcher.match(MatchInput(**bad))

    assert len(matches) == 0
    _assert_valid(matches, bad)


@every_matcher
@pytest.mark.parametrize('value', [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize('name', ARRAYS)
def test_rows_that_are_not_finite_match_nothing_and_the_others_do(
    matcher: Matcher, name: str, value: float
) -> None:
    bad = _input(40, 40)
    bad[name][:20, 0] = value

    matches = matcher.match(MatchInput(**bad))

    assert len(matches) > 0
    _assert_valid(matches, bad)
    by_name = {
        'keypoints': matches.keypoint_indices,
        'descriptors': matches.keypoint_indices,
        'points': matches.point_indices,
        'point_descriptors': matches.point_indices,
    }
    assert by_name[name].min() >= 20


@every_matcher
def test_all_alike_gives_valid_matches(matcher: Matcher) -> None:
    alike = _input(30, 20)
    alike |= {name: np.ones_like(alike[name]) for name in ARRAYS}

    _assert_valid(matcher.match(MatchInput(**alike)), alike)


@every_matcher
def test_points_and_keypoints_at_absurd_places_give_valid_matches(matcher: Matcher) -> None:
    wild = _input(30, 30)
    wild['points'][:10] *= 1e100
    wild['points'][10:20] *= -1e-100
    wild['keypoints'][:15] *= 1e30

    _assert_valid(matcher.match(MatchInput(**wild)), wild)


@every_matcher
@pytest.mark.parametrize('name', ARRAYS)
@pytest.mark.parametrize('change', ['a row less', 'a column less', 'flat'])
def test_rejects_arrays_that_do_not_belong_together(
    matcher: Matcher, name: str, change: str
) -> None:
    wrong = _input(9, 12)
    whole = wrong[name]
    changed = {'a row less': whole[:-1], 'a column less': whole[:, :-1], 'flat': whole.ravel()}
    wrong[name] = changed[change]

    with pytest.raises(MatchingError):
        matcher.match(MatchInput(**wrong))


@every_matcher
def test_rejects_descriptors_of_another_extractor_even_where_there_is_nothing_to_match(
    matcher: Matcher,
) -> None:
    nothing = _input(0, 9)
    nothing['descriptors'] = np.empty((0, 128), np.float32)

    with pytest.raises(MatchingError, match='extractor'):
        matcher.match(MatchInput(**nothing))


NUMBERS = np.array([0.0, -0.0, 1.0, -1.0, 1e-45, 1e-20, 1e20, 3e38, np.nan, np.inf, -np.inf])


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    keypoints=st.integers(0, 40),
    points=st.integers(0, 80),
    width=st.integers(1, 8),
    odd=st.sampled_from([0.0, 0.05, 0.5, 1.0]),
)
def test_garbage_gives_valid_matches(
    seed: int, keypoints: int, points: int, width: int, odd: float
) -> None:
    rng = np.random.default_rng(seed)

    def garbage(rows: int, columns: int) -> np.ndarray:
        usual = rng.integers(-2, 3, size=(rows, columns)).astype(np.float32)
        return np.where(rng.random(usual.shape) < odd, rng.choice(NUMBERS, usual.shape), usual)

    given_input = {
        'keypoints': garbage(keypoints, 2),
        'focal_length': 0.8,
        'descriptors': garbage(keypoints, width),
        'points': garbage(points, 3),
        'point_descriptors': garbage(points, width),
    }

    for matcher in MATCHERS.values():
        matches = matcher.match(MatchInput(**given_input))
        _assert_valid(matches, given_input)
        again = matcher.match(MatchInput(**given_input))
        np.testing.assert_array_equal(again.keypoint_indices, matches.keypoint_indices)
        np.testing.assert_array_equal(again.weights, matches.weights)
