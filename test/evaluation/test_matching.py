# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Matches against the tracks of a map."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from map_content import changed_map

from gam_relocalizer.errors import MapError
from gam_relocalizer.evaluation.matching import (
    EvaluationOptions,
    ImageScore,
    MapEvaluation,
    MapScore,
    Query,
    Score,
    evaluate_map,
    mean_over_maps,
    query_of,
    score_matches,
    summarise,
)
from gam_relocalizer.geometry import rigid3d_from
from gam_relocalizer.mapping.colmap_model import NO_POINT
from gam_relocalizer.mapping.leave_one_out import ReferenceImage, ReferenceImages, leave_out
from gam_relocalizer.matching.baselines import NearestNeighbourCross
from gam_relocalizer.matching.matcher import Matches, MatchInput
from gam_relocalizer.scene_map import (
    ExtractorIdentity,
    Manifest,
    MapContent,
    MapFrame,
    map_in_memory,
)

CAMERA = pycolmap.Camera(
    camera_id=1, model='PINHOLE', width=640, height=480, params=[500.0, 500.0, 320.0, 240.0]
)
NUM_POINTS = 40
NUM_CLUTTER = 10


def query(scale: float = 1.0, seed: int = 0) -> Query:
    """Keypoint i observes point i exactly, and the last ones observe nothing."""
    rng = np.random.default_rng(seed)
    camera_from_map = rigid3d_from([1.0, 0.1, -0.2, 0.05], scale * np.array([0.3, -0.2, 0.5]))
    in_camera = scale * rng.uniform([-1.0, -1.0, 3.0], [1.0, 1.0, 8.0], (NUM_POINTS, 3))
    points = camera_from_map.inverse() * in_camera
    clutter = rng.uniform([0.0, 0.0], [640.0, 480.0], (NUM_CLUTTER, 2))
    return Query(
        camera=CAMERA,
        camera_from_map=camera_from_map,
        keypoints=np.concatenate([CAMERA.img_from_cam(in_camera), clutter]).astype(np.float32),
        descriptors=np.zeros((NUM_POINTS + NUM_CLUTTER, 1), np.float32),
        points=points,
        points_in_reference=points,
        point_descriptors=np.zeros((NUM_POINTS, 1), np.float32),
        true_rows=np.array([*range(NUM_POINTS), *[NO_POINT] * NUM_CLUTTER]),
    )


def matches_of(pairs: list[tuple[int, int]], weights: list[float] | None = None) -> Matches:
    keypoints, points = np.array(pairs, np.int64).reshape(-1, 2).T
    given_weights = np.ones(len(pairs)) if weights is None else np.array(weights)
    nearest = np.ones(len(keypoints), np.bool_)
    return Matches(keypoints, points, given_weights.astype(np.float32), nearest)


def all_true(count: int = NUM_POINTS) -> list[tuple[int, int]]:
    return [(index, index) for index in range(count)]


def test_precision_and_recall_count_the_correspondences_of_the_tracks() -> None:
    false = [(7, 6), (45, 3), (46, 4), (8, 9)]
    score = score_matches(query(), matches_of([*all_true(6), *false]))
    assert score.matches == 10
    assert score.precision == pytest.approx(6 / 10)
    assert score.recall == pytest.approx(6 / NUM_POINTS)


def test_several_matches_of_a_keypoint_count_in_precision_but_once_in_recall() -> None:
    score = score_matches(query(), matches_of([(0, 0), (0, 1), (0, 2), (1, 2), (2, 2)]))
    assert score.precision == pytest.approx(2 / 5)
    assert score.recall == pytest.approx(2 / NUM_POINTS)


def test_true_matches_lead_to_the_true_pose() -> None:
    score = score_matches(query(), matches_of(all_true()))
    assert score.precision == score.recall == score.geometric_precision == 1.0
    assert score.geometric_recall == 1.0
    assert score.position < 1e-4
    assert score.rotation_deg < 1e-3


def test_many_matches_of_every_keypoint_still_lead_to_the_true_pose() -> None:
    false = [(index, (index + 1) % NUM_POINTS) for index in range(NUM_POINTS)]
    score = score_matches(query(), matches_of([*false, *all_true()]))
    assert score.precision == pytest.approx(0.5)
    assert score.position < 1e-4


@pytest.mark.parametrize('pairs', [[], all_true(3)])
def test_without_a_pose_the_errors_are_infinite(pairs: list[tuple[int, int]]) -> None:
    score = score_matches(query(), matches_of(pairs))
    assert math.isinf(score.position)
    assert math.isinf(score.position_permille)
    assert math.isinf(score.rotation_deg)


def test_no_matches_are_of_no_precision() -> None:
    score = score_matches(query(), Matches.none())
    assert (score.matches, score.precision, score.recall, score.geometric_precision) == (0, 0, 0, 0)


def test_geometric_precision_admits_8_pixels_at_a_width_of_640() -> None:
    exact = query()
    shifts = np.zeros_like(exact.keypoints)
    shifts[:4, 0] = [0.0, 7.9, -7.9, 8.1]
    shifts[4:6, 1] = [7.9, 8.1]
    shifted = replace(exact, keypoints=exact.keypoints + shifts)
    score = score_matches(shifted, matches_of(all_true(6)))
    assert score.geometric_precision == pytest.approx(4 / 6)
    assert score.precision == 1.0


def test_geometric_recall_counts_a_double_of_the_point_and_only_keypoints_with_a_truth() -> None:
    exact = query()
    doubled = replace(
        exact,
        points=np.concatenate([exact.points, exact.points]),
        true_rows=np.where(np.arange(len(exact.true_rows)) < 20, exact.true_rows, NO_POINT),
    )
    doubles = [(index, NUM_POINTS + index) for index in range(10)]
    score = score_matches(doubled, matches_of([*doubles, (20, 20), (21, 21)]))
    assert score.recall == 0.0
    assert score.geometric_recall == pytest.approx(10 / 20)


def test_points_behind_the_camera_are_not_near() -> None:
    exact = query()
    mirrored = exact.camera_from_map.inverse() * -(exact.camera_from_map * exact.points)
    score = score_matches(replace(exact, points=mirrored), matches_of(all_true(5)))
    assert score.geometric_precision == 0.0


def test_depth_is_the_median_of_the_points_in_the_image() -> None:
    exact = query()
    depths = (exact.camera_from_map * exact.points)[:, 2]
    half = np.where(np.arange(len(exact.true_rows)) < 20, exact.true_rows, NO_POINT)
    assert exact.depth == pytest.approx(np.median(depths))
    assert replace(exact, true_rows=half).depth == pytest.approx(np.median(depths[:20]))


@given(st.floats(0.01, 1000.0))
@settings(max_examples=20, deadline=None)
def test_relative_position_error_does_not_depend_on_the_unit(scale: float) -> None:
    rng = np.random.default_rng(0)
    noise = np.zeros((NUM_POINTS + NUM_CLUTTER, 2), np.float32)
    noise[:NUM_POINTS] = rng.normal(0.0, 1.0, (NUM_POINTS, 2))
    one, other = (
        score_matches(replace(made, keypoints=made.keypoints + noise), matches_of(all_true()))
        for made in (query(), query(scale))
    )
    assert other.position == pytest.approx(scale * one.position, rel=0.02)
    assert other.position_permille == pytest.approx(one.position_permille, rel=0.02)
    assert other.rotation_deg == pytest.approx(one.rotation_deg, rel=0.02)


pairs_of_matches = st.lists(
    st.tuples(st.integers(0, NUM_POINTS + NUM_CLUTTER - 1), st.integers(0, NUM_POINTS - 1)),
    unique=True,
    max_size=30,
)


@given(pairs_of_matches, st.randoms(use_true_random=False))
@settings(max_examples=50, deadline=None)
def test_order_of_matches_does_not_matter(
    pairs: list[tuple[int, int]], random: np.random.Generator
) -> None:
    everything = [*all_true(), *(pair for pair in pairs if pair[0] != pair[1])]
    weights = list(np.linspace(1.0, 0.1, len(everything)))
    order = list(range(len(everything)))
    random.shuffle(order)
    one = score_matches(query(), matches_of(everything, weights))
    other = score_matches(
        query(), matches_of([everything[i] for i in order], [weights[i] for i in order])
    )
    for field in fields(ImageScore):
        value = getattr(one, field.name)
        assert getattr(other, field.name) == pytest.approx(value, rel=1e-6, abs=1e-3)


@given(pairs_of_matches, pairs_of_matches)
@settings(max_examples=50, deadline=None)
def test_shares_are_shares_and_more_matches_never_lower_recall(
    some: list[tuple[int, int]], more: list[tuple[int, int]]
) -> None:
    few = score_matches(query(), matches_of(some))
    many = score_matches(query(), matches_of([*some, *more]))
    for score in (few, many):
        for share in (score.precision, score.recall, score.geometric_precision):
            assert 0.0 <= share <= 1.0
    assert many.recall >= few.recall


def image_score(precision: float, position: float) -> ImageScore:
    return ImageScore(10, precision, 0.5, 0.75, 0.8, position, 100.0 * position, 2.0 * position)


def test_summary_is_means_of_shares_and_medians_of_errors() -> None:
    scores = [image_score(0.2, 3.0), image_score(0.6, 1.0), image_score(0.7, math.inf)]
    assert summarise(scores) == MapScore(
        precision=pytest.approx(0.5),
        recall=0.5,
        geometric_precision=0.75,
        geometric_recall=pytest.approx(0.8),
        matches=10.0,
        poses=pytest.approx(2 / 3),
        position=3.0,
        position_permille=300.0,
        rotation_deg=6.0,
    )


def test_median_is_infinite_when_most_have_no_pose() -> None:
    summary = summarise([image_score(0.5, 1.0), *[image_score(0.5, math.inf)] * 2])
    assert math.isinf(summary.position)
    assert math.isinf(summary.rotation_deg)
    assert summary.poses == pytest.approx(1 / 3)


def map_score(value: float) -> MapScore:
    return MapScore(*[value] * len(fields(MapScore)))


def test_every_map_counts_the_same_in_the_mean() -> None:
    evaluations = [
        MapEvaluation(
            name=f'map of {images} images',
            map_id='',
            metric=False,
            images=images,
            images_without_truth=0,
            scores={'matcher': map_score(value)},
        )
        for images, value in ((1000, 0.2), (3, 0.6))
    ]
    mean = mean_over_maps(evaluations)['matcher']
    assert mean == Score(*[pytest.approx(0.4)] * len(fields(Score)))


def walk_past_points(alone: int = 0) -> ReferenceImages:
    """Four images with exact, unmistakable features, and some more that see nothing together."""
    rng = np.random.default_rng(1)
    num_images = 4 + alone
    sees = np.zeros((num_images, 60), dtype=bool)
    for image in range(4):
        sees[image, 10 * image : 10 * image + 20] = True
    for image in range(4, num_images):
        sees[image, 50 + image - 4] = True
    points = rng.uniform([-1.0, -1.0, 4.0], [1.0, 1.0, 8.0], (60, 3))
    looks = np.linalg.qr(rng.normal(size=(60, 60)))[0].astype(np.float32)
    poses = tuple(rigid3d_from([1, 0, 0.02 * i, 0], [0.1 * i, 0, 0]) for i in range(num_images))
    images = []
    for pose, row in zip(poses, sees, strict=True):
        observed = rng.permutation(np.flatnonzero(row))
        keypoints = np.asarray(CAMERA.img_from_cam(pose * points[observed]), np.float32)
        images.append(ReferenceImage(CAMERA, keypoints, looks[observed], observed))
    seen = [np.flatnonzero(row) for row in sees]
    scene_map = map_in_memory(
        Path('somewhere/walk'),
        MapContent(
            image_names=tuple(map(str, range(num_images))),
            camera_from_sfm=poses,
            points=points,
            descriptors=looks.astype(np.float16),
            observation_offsets=np.cumsum([0, *map(len, seen)], dtype=np.int64),
            observation_points=np.concatenate(seen).astype(np.int32),
            global_descriptors=rng.normal(size=(num_images, 8)).astype(np.float32),
            codebook=np.zeros((1, 60), np.float32),
        ),
        Manifest(ExtractorIdentity('exact', 60, ''), 'vlad', MapFrame(metric=True), {}),
    )
    sums = sees.sum(axis=0)[:, None] * looks
    return ReferenceImages(scene_map, tuple(images), sums.astype(np.float32))


class FindsNothing:
    """Remembers what it was given, and matches nothing of it."""

    def __init__(self) -> None:
        self.keypoints: list[np.ndarray] = []
        self.points: list[np.ndarray] = []

    def match(self, given: MatchInput) -> Matches:
        self.keypoints.append(given.keypoints)
        self.points.append(given.points)
        return Matches.none()


def test_map_of_unmistakable_points_is_matched_entirely() -> None:
    found = evaluate_map(
        walk_past_points(), {'cross': NearestNeighbourCross(), 'nothing': FindsNothing()}
    )
    assert (found.name, found.metric) == ('walk', True)
    assert (found.images, found.images_without_truth) == (4, 0)
    cross, nothing = found.scores['cross'], found.scores['nothing']
    assert cross.recall == cross.poses == 1.0
    # the first and the last ten points are seen once: their keypoints have no true match
    assert cross.precision > 0.7
    assert cross.position < 1e-3
    assert (nothing.precision, nothing.recall, nothing.matches, nothing.poses) == (0, 0, 0, 0)
    assert math.isinf(nothing.position_permille)


def test_images_without_truth_are_counted_and_left_out() -> None:
    with_some = evaluate_map(walk_past_points(alone=3), {'cross': NearestNeighbourCross()})
    without = evaluate_map(walk_past_points(), {'cross': NearestNeighbourCross()})
    assert (with_some.images, with_some.images_without_truth) == (4, 3)
    assert with_some.scores['cross'].recall == without.scores['cross'].recall


def test_a_map_whose_images_share_nothing_cannot_be_evaluated() -> None:
    references = walk_past_points(alone=2)
    alone = changed_map(
        references.scene_map,
        lambda content: replace(
            content,
            observation_offsets=np.array([0, 0, 0, 0, 0, 1, 2]),
            observation_points=np.array([50, 51], np.int32),
        ),
    )
    with pytest.raises(MapError, match='walk'):
        evaluate_map(replace(references, scene_map=alone), {'cross': NearestNeighbourCross()})


def test_points_are_given_in_the_frame_of_the_retrieved_image() -> None:
    references = walk_past_points()
    matcher = FindsNothing()
    evaluate_map(references, {'nothing': matcher})
    for image, points in enumerate(matcher.points):
        view = leave_out(references, image)
        pose = references.scene_map.camera_from_map[view.reference]
        np.testing.assert_allclose(points, pose * references.scene_map.points[view.points])


def test_best_keypoints_and_every_other_image() -> None:
    references = walk_past_points()
    matcher = FindsNothing()
    told: list[tuple[str, int, int]] = []
    found = evaluate_map(
        references,
        {'nothing': matcher},
        EvaluationOptions(keypoints=7, every=2),
        lambda *one: told.append(one),
    )
    assert found.images == 2
    assert [len(keypoints) for keypoints in matcher.keypoints] == [7, 7]
    assert told == [('match', 1, 2), ('match', 2, 2)]


def test_best_keypoints_are_the_first() -> None:
    references = walk_past_points()
    whole, best = query_of(references, 1), query_of(references, 1, keypoints=5)
    np.testing.assert_array_equal(best.keypoints, whole.keypoints[:5])
    np.testing.assert_array_equal(best.true_rows, whole.true_rows[:5])
    np.testing.assert_array_equal(best.point_descriptors, whole.point_descriptors)


def test_same_input_gives_the_same_output() -> None:
    once, again = (
        evaluate_map(walk_past_points(), {'cross': NearestNeighbourCross()}) for _ in range(2)
    )
    assert once == again
