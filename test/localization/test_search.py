# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The order of the scenes, and which of them are tried."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from synthetic_place import NUM_IMAGES, Place, features_of, query_pose, ring_pose, save_place

from gam_relocalizer.features.vlad import Vlad
from gam_relocalizer.localization.localizer import LocalizerOptions
from gam_relocalizer.localization.prior import PositionHint
from gam_relocalizer.localization.result import LocalizationResult, PoseEstimate, Status, Support
from gam_relocalizer.localization.scenes import Coarse, Scene
from gam_relocalizer.localization.search import Candidate, candidates, search

if TYPE_CHECKING:
    from collections.abc import Sequence

    from gam_relocalizer.scene_map import SceneMap

ENOUGH = 200
PLACE = Place()
NOWHERE = np.array([1e3, -1e3, 1e3])


@pytest.fixture(scope='module')
def scene_map(tmp_path_factory: pytest.TempPathFactory) -> SceneMap:
    return save_place(tmp_path_factory.mktemp('maps') / 'place', PLACE)


def describe(scene_map: SceneMap, view: int) -> np.ndarray:
    features = features_of(PLACE, query_pose(view), seed=view)
    return Vlad(scene_map.codebook).aggregate(features.descriptors)


def result_with(inliers: int) -> LocalizationResult:
    estimate = PoseEstimate(
        camera_from_map=pycolmap.Rigid3d(),
        covariance=np.eye(6),
        inlier_keypoints=np.zeros((inliers, 2), np.float32),
        inlier_features=np.arange(inliers),
        inlier_points=np.arange(inliers),
        inlier_ratio=1.0,
        coverage=1.0,
        reprojection_error=1.0,
        support=Support(in_view=500, unmatched=0.1),
        belief=0.99,
    )
    return LocalizationResult(Status.ACCEPTED if inliers else Status.NO_POSE, estimate=estimate)


def tried(ordered: Sequence[tuple[int, float]], inliers: dict[int, int]) -> list[int]:
    """Images whose scenes are tried, of (image, score); where no inliers are given is no pose."""
    images: list[int] = []

    def localize_in(scene: Scene) -> LocalizationResult:
        images.append(scene.image)
        return result_with(inliers.get(scene.image, 0))

    scenes = [
        Candidate(Scene(image, np.array([image]), np.array([image])), score)
        for image, score in ordered
    ]
    results = search(scenes, localize_in, ENOUGH)
    assert [result.inliers for result in results] == [inliers.get(image, 0) for image in images]
    return images


def shown(found: Sequence[Candidate]) -> list[tuple[list[int], float]]:
    return [(candidate.scene.images.tolist(), candidate.score) for candidate in found]


def test_all_scenes_are_tried_until_a_pose_is_found() -> None:
    ordered = [(0, 0.9), (1, 0.8), (2, 0.7), (3, 0.6)]
    assert tried(ordered, {}) == [0, 1, 2, 3]
    assert tried(ordered, {1: ENOUGH - 1}) == [0, 1, 2, 3]
    assert tried(ordered, {1: ENOUGH}) == [0, 1]


def test_scene_that_comes_twice_is_tried_once() -> None:
    assert tried([(1, 0.8), (0, 0.9), (1, 0.8), (2, 0.7)], {}) == [1, 0, 2]


def test_scenes_as_alike_as_the_one_found_are_tried() -> None:
    assert tried([(0, 0.9), (1, 0.88), (2, 0.8)], {0: ENOUGH}) == [0, 1]
    assert tried([(0, 0.9), (1, 0.7), (2, 0.68), (3, 0.6)], {1: ENOUGH}) == [0, 1, 2]
    assert tried([(0, -0.5), (1, -0.52), (2, -0.5)], {0: ENOUGH}) == [0, 2]


def test_scene_more_alike_than_the_one_found_is_tried_in_any_order() -> None:
    assert tried([(3, 0.5), (0, 0.9), (1, 0.6), (2, 0.4)], {3: ENOUGH}) == [3, 0, 1]


@given(
    scores=st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=8),
    inliers=st.dictionaries(st.integers(0, 7), st.sampled_from([50, ENOUGH]), max_size=8),
    retrieved=st.integers(1, 8),
    first=st.lists(st.integers(0, 7), max_size=4),
)
def test_scenes_put_first_keep_no_other_scene_from_being_tried(
    scores: list[float], inliers: dict[int, int], retrieved: int, first: list[int]
) -> None:
    """Some of the less alike scenes are not retrieved; a hint may put any before the others."""
    by_score = sorted(enumerate(scores), key=lambda scored: -scored[1])
    without = by_score[:retrieved]
    hinted = [(image, scores[image]) for image in first if image < len(scores)]
    assert set(tried(without, inliers)) <= set(tried([*hinted, *without], inliers))


@pytest.mark.parametrize('coarse', list(Coarse))
@given(
    view=st.integers(0, 20),
    position=st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    radius=st.sampled_from([0.0, 0.3, 1.0, np.inf]),
    retrieved_images=st.integers(1, 12),
    max_scenes=st.integers(1, 4),
)
@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_all_that_comes_without_a_hint_comes_with_it(
    scene_map: SceneMap,
    coarse: Coarse,
    view: int,
    position: tuple[float, float, float],
    radius: float,
    retrieved_images: int,
    max_scenes: int,
) -> None:
    options = LocalizerOptions(
        coarse=coarse, retrieved_images=retrieved_images, max_scenes=max_scenes, scene_images=4
    )
    described = describe(scene_map, view)
    without = list(candidates(described, scene_map, options))
    hint = PositionHint(np.array(position), radius)
    hinted = list(candidates(described, scene_map, options, hint))
    first, after = hinted[: -len(without)], hinted[-len(without) :]
    assert 1 <= len(first) <= max_scenes
    assert shown(after) == shown(without)
    if coarse is not Coarse.EXPANDED:
        # what lies together stays together, lest a look-alike is out of the matcher's view
        everything = list(
            candidates(
                described,
                scene_map,
                LocalizerOptions(
                    coarse=coarse, retrieved_images=retrieved_images, max_scenes=NUM_IMAGES
                ),
            )
        )
        for one in first:
            for other in everything:
                apart = set(one.scene.images).isdisjoint(other.scene.images)
                assert apart or set(one.scene.images) >= set(other.scene.images)


def test_hint_finds_images_that_were_not_retrieved(scene_map: SceneMap) -> None:
    described = describe(scene_map, 0)
    options = LocalizerOptions(retrieved_images=1)
    (without,) = candidates(described, scene_map, options)
    opposite = (without.scene.image + NUM_IMAGES // 2) % NUM_IMAGES
    hint = PositionHint(ring_pose(opposite).tgt_origin_in_src(), 0.0)
    first, second = candidates(described, scene_map, options, hint)
    assert first.scene.image == opposite
    assert second.scene.image == without.scene.image
    assert first.score < second.score


def test_hint_from_far_outside_starts_at_the_edge_of_the_map(scene_map: SceneMap) -> None:
    hint = PositionHint(NOWHERE, 0.0)
    first, *_ = candidates(describe(scene_map, 0), scene_map, LocalizerOptions(), hint)
    centres = [pose.tgt_origin_in_src() for pose in scene_map.camera_from_map]
    nearest = int(np.argmin([np.linalg.norm(centre - NOWHERE) for centre in centres]))
    assert first.scene.image == nearest
