# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The verdict: wrong matches are never accepted, right ones are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gam_relocalizer.geometry import rigid3d_from
from gam_relocalizer.localization.pose import estimate_pose
from gam_relocalizer.localization.result import PoseEstimate, Status, Support
from gam_relocalizer.localization.verdict import (
    VerdictOptions,
    coverage_of,
    judge,
    judge_rival,
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
    inlier_points=np.arange(100),
    inlier_ratio=0.3,
    coverage=0.5,
    reprojection_error=1.2,
    support=Support(in_view=500, unmatched=0.1),
    belief=0.95,
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
        GOOD, inlier_keypoints=GOOD.inlier_keypoints[:few], inlier_points=np.arange(few)
    )
    assert judge(estimate, POINTS[:few], 1.0, OPTIONS).status is Status.TOO_FEW_INLIERS


def rival(position: float, turn_deg: float, inliers: int) -> PoseEstimate:
    half = np.radians(turn_deg) / 2.0
    return replace(
        GOOD,
        camera_from_map=rigid3d_from([np.cos(half), 0.0, np.sin(half), 0.0], [position, 0, 0]),
        inlier_points=np.arange(inliers),
    )


@pytest.mark.parametrize(
    ('other', 'status'),
    [
        (rival(3.0, 0.0, 85), Status.AMBIGUOUS),
        (rival(0.0, 90.0, 85), Status.AMBIGUOUS),
        (rival(3.0, 0.0, 75), None),
        (rival(0.2, 3.0, 100), None),
    ],
    ids=['elsewhere', 'turned', 'elsewhere with few inliers', 'the same pose again'],
)
def test_refuses_a_pose_that_another_scene_contradicts(
    other: PoseEstimate, status: Status | None
) -> None:
    verdict = judge_rival(GOOD, other, POINTS, OPTIONS)
    assert (verdict and verdict.status) is status


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
            inlier_points=np.flatnonzero(pose.inliers),
            inlier_ratio=float(np.mean(pose.inliers)),
            coverage=coverage_of(keypoints[pose.inliers], CAMERA),
            reprojection_error=1.0,
            support=Support(in_view=500, unmatched=0.1),
            belief=0.95,
        )
        assert judge(estimate, points[pose.inliers], 1.0, OPTIONS).status is not Status.ACCEPTED
