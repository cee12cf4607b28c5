# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The verdict: wrong matches are never accepted, right ones are."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from gam_relocalizer.geometry import rigid3d_from
from gam_relocalizer.localization.focal_length import FocalLength
from gam_relocalizer.localization.look_alikes import LookAlike
from gam_relocalizer.localization.pose import estimate_pose
from gam_relocalizer.localization.result import PoseEstimate, Status, Support
from gam_relocalizer.localization.verdict import (
    FOCAL_LENGTH_SIGMAS,
    FOCAL_LENGTH_TOLERANCE,
    MAX_LOOK_ALIKE_SHARE,
    MAX_LOOK_ALIKES_BY_CHANCE,
    MIRROR_MARGIN,
    VerdictOptions,
    coverage_of,
    judge,
    judge_focal_length,
    judge_look_alike,
    judge_mirrored,
    judge_rival,
    judge_tilt,
    worst_deviations,
)

CAMERA = pycolmap.Camera(
    camera_id=1, model='PINHOLE', width=640, height=480, params=[520, 520, 320, 240]
)
OPTIONS = VerdictOptions()
RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-1.0, 1.0, (100, 3)) + np.array([0.0, 0.0, 5.0])
GOOD = PoseEstimate(
    camera_from_map=rigid3d_from([1, 0, 0, 0], [0, 0, 0]),
    covariance=np.diag([1e-4] * 3 + [1e-6] * 3),
    inlier_keypoints=RNG.uniform([0, 0], [640, 480], (100, 2)).astype(np.float32),
    inlier_features=np.arange(100),
    inlier_points=np.arange(100),
    inlier_ratio=0.3,
    coverage=0.5,
    reprojection_error=1.2,
    support=Support(in_view=500, unmatched=0.1),
    belief=0.99,
)


def test_accepts_a_good_estimate() -> None:
    assert judge(GOOD, POINTS, 1.0, OPTIONS).status is Status.ACCEPTED


@pytest.mark.parametrize(
    ('changes', 'status'),
    [
        ({'inlier_ratio': OPTIONS.min_inlier_ratio / 2}, Status.LOW_INLIER_RATIO),
        ({'coverage': OPTIONS.min_coverage / 2}, Status.POOR_COVERAGE),
        ({'covariance': np.diag([1.0, 1e-4, 1e-4, 1e-6, 1e-6, 1e-6])}, Status.UNCERTAIN),
        ({'covariance': np.diag([1e-4, 1e-4, 1e-4, 1e-6, 1e-6, 0.01])}, Status.UNCERTAIN),
        ({'belief': OPTIONS.min_belief - 0.01}, Status.CONTRADICTED),
    ],
)
def test_names_what_is_wrong(changes: dict[str, object], status: Status) -> None:
    verdict = judge(replace(GOOD, **changes), POINTS, 1.0, OPTIONS)
    assert verdict.status is status
    assert verdict.reason


def test_refuses_a_mirrored_view() -> None:
    share = OPTIONS.min_orientation_kept
    assert judge(GOOD, POINTS, share + 0.01, OPTIONS).status is Status.ACCEPTED
    assert judge(GOOD, POINTS, share - 0.01, OPTIONS).status is Status.IMPLAUSIBLE


def test_refuses_few_inliers() -> None:
    few = OPTIONS.min_inliers - 1
    estimate = replace(
        GOOD,
        inlier_keypoints=GOOD.inlier_keypoints[:few],
        inlier_features=np.arange(few),
        inlier_points=np.arange(few),
    )
    assert judge(estimate, POINTS[:few], 1.0, OPTIONS).status is Status.TOO_FEW_INLIERS


def rival(position: float, turn_deg: float, belief: float = GOOD.belief) -> PoseEstimate:
    half = np.radians(turn_deg) / 2.0
    return replace(
        GOOD,
        camera_from_map=rigid3d_from([np.cos(half), 0.0, np.sin(half), 0.0], [position, 0, 0]),
        belief=belief,
    )


@pytest.mark.parametrize(
    ('other', 'status'),
    [
        (rival(3.0, 0.0), Status.AMBIGUOUS),
        (rival(0.0, 90.0), Status.AMBIGUOUS),
        (rival(3.0, 0.0, belief=1.0), Status.AMBIGUOUS),
        (rival(3.0, 0.0, belief=0.3), None),
        (rival(0.2, 3.0), None),
    ],
    ids=['elsewhere', 'turned', 'more probable', 'hardly probable', 'the same pose again'],
)
def test_refuses_a_pose_that_another_scene_contradicts(
    other: PoseEstimate, status: Status | None
) -> None:
    verdict = judge_rival(GOOD, other, POINTS, OPTIONS)
    assert (verdict and verdict.status) is status


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_no_rival_makes_a_pose_ambiguous_that_a_more_probable_one_leaves(
    first: float, second: float
) -> None:
    weak, strong = (rival(3.0, 0.0, belief) for belief in sorted((first, second)))
    if judge_rival(GOOD, strong, POINTS, OPTIONS) is None:
        assert judge_rival(GOOD, weak, POINTS, OPTIONS) is None


def test_of_two_equally_probable_poses_none_is_sure() -> None:
    lenient = replace(OPTIONS, min_odds_against_rival=1.01)
    for belief in (0.5, 0.99, 1.0):
        best, other = replace(GOOD, belief=belief), rival(3.0, 0.0, belief)
        assert judge_rival(best, other, POINTS, lenient).status is Status.AMBIGUOUS


@pytest.mark.parametrize(
    ('ratio', 'log_sigma', 'status'),
    [
        (1.0, 0.001, None),
        (1.0 + FOCAL_LENGTH_TOLERANCE / 2, 0.001, None),
        (1.2, 0.01, Status.MISCALIBRATED),
        (1.0 / 1.2, 0.01, Status.MISCALIBRATED),
        (1.2, 0.1, None),
        (5.0, math.inf, None),
    ],
    ids=['right', 'nearly right', 'too short', 'too long', 'vague', 'a flat wall'],
)
def test_refuses_a_focal_length_that_the_image_speaks_against(
    ratio: float, log_sigma: float, status: Status | None
) -> None:
    verdict = judge_focal_length(FocalLength(ratio, log_sigma))
    assert (verdict and verdict.status) is status


@given(st.floats(0.2, 5.0), st.floats(1e-4, 0.2))
def test_too_long_is_as_wrong_as_too_short(ratio: float, log_sigma: float) -> None:
    off = abs(math.log(ratio)) - max(FOCAL_LENGTH_TOLERANCE, FOCAL_LENGTH_SIGMAS * log_sigma)
    assume(abs(off) > 1e-9)
    too_long, too_short = (
        judge_focal_length(FocalLength(each, log_sigma)) for each in (ratio, 1.0 / ratio)
    )
    assert (too_long is None) == (too_short is None)


def test_refuses_a_pose_that_leans_further_than_it_may() -> None:
    assert judge_tilt(14.9, 15.0) is None
    assert judge_tilt(15.1, 15.0).status is Status.IMPLAUSIBLE
    assert judge_tilt(180.0, 180.0) is None


def test_refuses_an_image_that_is_more_like_the_map_when_mirrored() -> None:
    assert judge_mirrored(0.6, 0.3) is None
    assert judge_mirrored(0.6, 0.6) is None
    assert judge_mirrored(0.3, 0.3 + MIRROR_MARGIN + 0.01).status is Status.IMPLAUSIBLE


def test_refuses_a_pose_whose_inliers_look_like_another_place() -> None:
    elsewhere, here = rival(3.0, 0.0).camera_from_map, rival(0.2, 3.0).camera_from_map
    few, by_chance = int(100 * MAX_LOOK_ALIKE_SHARE), MAX_LOOK_ALIKES_BY_CHANCE
    verdict = judge_look_alike(GOOD, LookAlike(elsewhere, few + 1, 100), POINTS)
    assert verdict.status is Status.AMBIGUOUS
    assert judge_look_alike(GOOD, LookAlike(elsewhere, few, 100), POINTS) is None
    assert judge_look_alike(GOOD, LookAlike(elsewhere, by_chance, by_chance), POINTS) is None
    assert judge_look_alike(GOOD, LookAlike(here, 100, 100), POINTS) is None


@given(st.floats(1e-3, 1e3))
def test_position_uncertainty_is_judged_relative_to_the_scene(scale: float) -> None:
    spread = np.repeat([scale, 1.0], 3)
    for deviation, status in ((0.02, Status.ACCEPTED), (0.1, Status.UNCERTAIN)):
        covariance = np.diag([(5.0 * deviation) ** 2] * 3 + [1e-6] * 3)
        estimate = replace(GOOD, covariance=covariance * np.outer(spread, spread))
        assert judge(estimate, POINTS * scale, 1.0, OPTIONS).status is status


def test_coverage_counts_cells_of_the_image() -> None:
    one_cell = np.array([[1.0, 1.0], [79.0, 59.0]])
    two_cells = np.array([[1.0, 1.0], [81.0, 1.0]])
    columns, rows = np.meshgrid(np.arange(8) * 80 + 40, np.arange(8) * 60 + 30)
    everywhere = np.stack([columns.ravel(), rows.ravel()], axis=1)
    beyond = np.array([[640.0, 480.0], [-0.5, -0.5]])
    assert coverage_of(np.empty((0, 2)), CAMERA) == 0.0
    assert coverage_of(one_cell, CAMERA) == 1 / 64
    assert coverage_of(two_cells, CAMERA) == 2 / 64
    assert coverage_of(everywhere, CAMERA) == 1.0
    assert coverage_of(beyond, CAMERA) == 2 / 64


def test_worst_deviation_is_along_any_direction() -> None:
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = 0.5 * np.array([[4.0, 4.0, 0.0], [4.0, 4.0, 0.0], [0.0, 0.0, 1.0]])
    covariance[3:, 3:] = np.diag([0.0, 0.01, 0.0])
    position, rotation_deg = worst_deviations(covariance)
    assert position == pytest.approx(2.0)
    assert rotation_deg == pytest.approx(np.rad2deg(0.1))


def random_points(rng: np.random.Generator, count: int, kind: int) -> np.ndarray:
    """A cloud, the walls of a room, or clusters."""
    if kind == 0:
        return rng.uniform(-1.0, 1.0, (count, 3)) * [4.0, 3.0, 4.0]
    if kind == 1:
        walls = rng.uniform(-1.0, 1.0, (count, 3)) * [6.0, 3.0, 6.0]
        walls[np.arange(count), rng.integers(3, size=count)] = rng.choice([-6.0, 6.0], count)
        return walls
    centres = rng.normal(0.0, 4.0, (10, 3))
    return centres[rng.integers(10, size=count)] + rng.normal(0.0, 0.4, (count, 3))


def random_keypoints(rng: np.random.Generator, count: int, kind: int) -> np.ndarray:
    """All over the image, or in clusters as on a few textured objects."""
    size = np.array([CAMERA.width, CAMERA.height])
    if kind == 0:
        return rng.uniform([0, 0], size, (count, 2))
    centres = rng.uniform([0, 0], size, (8, 2))
    near = centres[rng.integers(8, size=count)] + rng.normal(0.0, 40.0, (count, 2))
    return np.clip(near, 0, size)


@pytest.mark.parametrize('count', [30, 100, 300, 1000, 2000])
def test_random_matches_are_never_accepted(count: int) -> None:
    rng = np.random.default_rng(count)
    for trial in range(max(12, 12_000 // count // 2)):
        keypoints = random_keypoints(rng, count, trial % 2)
        points = random_points(rng, count, trial % 3)
        pose = estimate_pose(keypoints, points, rng.uniform(0.0, 1.0, count), CAMERA)
        if pose is None:
            continue
        estimate = PoseEstimate(
            camera_from_map=pose.camera_from_map,
            covariance=pose.covariance,
            inlier_keypoints=keypoints[pose.inliers].astype(np.float32),
            inlier_features=np.flatnonzero(pose.inliers),
            inlier_points=np.flatnonzero(pose.inliers),
            inlier_ratio=float(np.mean(pose.inliers)),
            coverage=coverage_of(keypoints[pose.inliers], CAMERA),
            reprojection_error=1.0,
            support=Support(in_view=500, unmatched=0.1),
            belief=0.99,
        )
        assert judge(estimate, points[pose.inliers], 1.0, OPTIONS).status is not Status.ACCEPTED
