# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""A matcher need not be one-to-one: what it says twice must not count twice."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pytest
from synthetic_place import (
    CAMERA,
    Place,
    ViewExtractor,
    features_of,
    image_of,
    query_pose,
    save_place,
)

from gam_relocalizer.localization.localizer import Localizer
from gam_relocalizer.matching.baselines import NearestNeighbourRatio
from gam_relocalizer.matching.matcher import Matches

if TYPE_CHECKING:
    from gam_relocalizer.localization.result import LocalizationResult
    from gam_relocalizer.matching.matcher import MatchInput
    from gam_relocalizer.scene_map import SceneMap

PLACE = Place()


@dataclass(frozen=True)
class RepeatingMatcher:
    """Says some of the matches of another matcher, evenly chosen, several times."""

    distinct: int
    times: int

    def match(self, given: MatchInput) -> Matches:
        matches = NearestNeighbourRatio().match(given)
        chosen = np.linspace(0, len(matches) - 1, min(self.distinct, len(matches))).astype(int)
        rows = np.tile(chosen, self.times)
        return Matches(
            matches.keypoint_indices[rows],
            matches.point_indices[rows],
            matches.weights[rows],
            matches.nearest[rows],
        )


@pytest.fixture(scope='module')
def scene_map(tmp_path_factory: pytest.TempPathFactory) -> SceneMap:
    return save_place(tmp_path_factory.mktemp('maps') / 'place', PLACE)


def localized(scene_map: SceneMap, view: int, matcher: RepeatingMatcher) -> LocalizationResult:
    features = features_of(PLACE, query_pose(view), seed=view)
    return Localizer(scene_map, ViewExtractor({0: features}), matcher).localize(image_of(0), CAMERA)


@pytest.mark.parametrize('view', range(3))
def test_a_result_is_the_same_however_often_a_match_is_said(scene_map: SceneMap, view: int) -> None:
    once = localized(scene_map, view, RepeatingMatcher(distinct=200, times=1))
    often = localized(scene_map, view, RepeatingMatcher(distinct=200, times=5))

    assert once.accepted
    assert (often.status, often.matches, often.inliers) == (
        once.status, once.matches, once.inliers,
    )  # fmt: skip
    assert often.estimate.inlier_ratio == pytest.approx(once.estimate.inlier_ratio)
    np.testing.assert_allclose(often.estimate.covariance, once.estimate.covariance, rtol=1e-3)


@pytest.mark.parametrize('distinct', [1, 4, 12])
def test_few_matches_said_often_are_few(scene_map: SceneMap, distinct: int) -> None:
    result = localized(scene_map, 0, RepeatingMatcher(distinct, times=50))

    assert not result.accepted
    assert result.inliers <= distinct
