# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""From camera to robot: the pose, the covariance carried along, scales and floors."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gam_relocalizer.geometry import (
    covariance_of_map_from_camera,
    rigid3d_from,
    rigid3d_from_rotation,
    rotation_of,
)
from gam_relocalizer.localization.result import PoseEstimate, Support
from gam_relocalizer.localization.robot_pose import (
    CovarianceMode,
    CovarianceOptions,
    robot_pose,
)

EXACT = CovarianceOptions(
    position_scale=1.0, orientation_scale=1.0, position_floor=0.0, orientation_floor=0.0
)
# optical frame (z forward) half a metre ahead of and 1.2 m above the base, tilted down
MOUNT = rigid3d_from([0.4, -0.6, 0.55, -0.42], [0.5, -0.1, 1.2])


def make_estimate(camera_from_map: pycolmap.Rigid3d, covariance: np.ndarray) -> PoseEstimate:
    return PoseEstimate(
        camera_from_map=camera_from_map,
        covariance=covariance,
        inlier_keypoints=np.zeros((0, 2), np.float32),
        inlier_features=np.zeros(0, np.int64),
        inlier_points=np.zeros(0, np.int64),
        inlier_ratio=1.0,
        coverage=1.0,
        reprojection_error=1.0,
        support=Support(in_view=500, unmatched=0.1),
        belief=0.99,
    )


def random_covariance(rng: np.random.Generator) -> np.ndarray:
    factor = rng.normal(size=(6, 6))
    return 1e-6 * (factor @ factor.T + 0.1 * np.eye(6))


def test_covariance_matches_samples_from_the_camera_to_the_base() -> None:
    rng = np.random.default_rng(0)
    camera_from_map = rigid3d_from(rng.normal(size=4), [3.0, -2.0, 5.0])
    covariance = random_covariance(rng)
    estimate = make_estimate(
        camera_from_map, covariance_of_map_from_camera(camera_from_map, covariance)
    )
    pose = robot_pose(estimate, MOUNT, EXACT)
    moves, turns = [], []
    for delta in rng.multivariate_normal(np.zeros(6), covariance, 20_000):
        movement = rigid3d_from_rotation(Rotation.from_rotvec(delta[:3]), delta[3:])
        map_from_base = (MOUNT * movement * camera_from_map).inverse()
        moves.append(map_from_base.translation - pose.map_from_base.translation)
        turns.append(rotation_of(map_from_base))
    turned = Rotation.concatenate(turns) * rotation_of(pose.map_from_base).inv()
    sampled = np.cov(np.hstack([moves, turned.as_rotvec()]).T)
    deviations = np.sqrt(np.diag(pose.covariance))
    np.testing.assert_allclose(
        sampled / np.outer(deviations, deviations),
        pose.covariance / np.outer(deviations, deviations),
        atol=0.04,
    )


def test_base_lies_where_the_mount_says() -> None:
    map_from_base = rigid3d_from([0.9, 0.1, -0.2, 0.3], [4.0, 5.0, 0.0])
    camera_from_map = (map_from_base * MOUNT).inverse()
    pose = robot_pose(make_estimate(camera_from_map, np.eye(6)), MOUNT)
    np.testing.assert_allclose(pose.map_from_base.matrix(), map_from_base.matrix(), atol=1e-12)


@given(
    q=st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1),
    t=st.tuples(*[st.floats(-1e4, 1e4)] * 3),
    seed=st.integers(0, 1000),
    mode=st.sampled_from(CovarianceMode),
)
def test_result_is_always_well_formed(q: tuple, t: tuple, seed: int, mode: CovarianceMode) -> None:
    covariance = random_covariance(np.random.default_rng(seed))
    pose = robot_pose(
        make_estimate(rigid3d_from(q, t), covariance), MOUNT, CovarianceOptions(mode=mode)
    )
    assert np.linalg.norm(pose.map_from_base.rotation.quat) == pytest.approx(1.0, abs=1e-9)
    assert (pose.covariance == pose.covariance.T).all()
    np.linalg.cholesky(pose.covariance)


def test_diagonal_mode_keeps_variances_and_drops_correlations() -> None:
    estimate = make_estimate(
        rigid3d_from([1, 2, 3, 4], [1, 2, 3]), random_covariance(np.random.default_rng(1))
    )
    full = robot_pose(estimate, MOUNT).covariance
    diagonal = robot_pose(
        estimate, MOUNT, CovarianceOptions(mode=CovarianceMode.DIAGONAL)
    ).covariance
    np.testing.assert_array_equal(diagonal, np.diag(np.diag(full)))
    assert (diagonal >= 0).all()


def test_scales_multiply_and_floors_add() -> None:
    covariance = random_covariance(np.random.default_rng(2))
    estimate = make_estimate(rigid3d_from([1, 0, 0, 0], [0, 0, 0]), covariance)
    at_the_camera = pycolmap.Rigid3d()
    options = CovarianceOptions(
        position_scale=2.0, orientation_scale=3.0, position_floor=0.1, orientation_floor=0.01
    )
    scaled = robot_pose(estimate, at_the_camera, options).covariance
    np.testing.assert_allclose(scaled[0, 0], 4.0 * covariance[0, 0] + 0.1**2)
    np.testing.assert_allclose(scaled[5, 5], 9.0 * covariance[5, 5] + 0.01**2)
    np.testing.assert_allclose(scaled[0, 5], 6.0 * covariance[0, 5])


def test_orientation_floor_moves_a_base_far_from_its_camera() -> None:
    estimate = make_estimate(rigid3d_from([1, 0, 0, 0], [0, 0, 0]), 1e-12 * np.eye(6))
    mount = rigid3d_from([1, 0, 0, 0], [10.0, 0.0, 0.0])
    options = CovarianceOptions(position_floor=0.0, orientation_floor=0.01)
    covariance = robot_pose(estimate, mount, options).covariance
    assert np.sqrt(covariance[1, 1]) == pytest.approx(0.1, rel=1e-3)
    assert np.sqrt(covariance[0, 0]) < 1e-5
