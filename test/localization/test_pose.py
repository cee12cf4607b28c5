# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Poses from synthetic matches with known truth: accuracy, honest covariance, hopeless input."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import eigh, sqrtm
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from gam_relocalizer.cameras import CAMERA_MODELS, undistort
from gam_relocalizer.evaluation.calibration import normalised_error_squared
from gam_relocalizer.geometry import pose_error, rigid3d_from_rotation
from gam_relocalizer.localization.covariance import (
    SHARED_DISTANCE,
    SHARED_VARIANCE,
    projection_jacobians,
)
from gam_relocalizer.localization.pose import AbsolutePose, PoseOptions, estimate_pose

PINHOLE = pycolmap.Camera(
    camera_id=1, model='PINHOLE', width=1024, height=768, params=[800, 810, 520, 380]
)
FISHEYE = pycolmap.Camera(
    camera_id=1,
    model='OPENCV_FISHEYE',
    width=1024,
    height=768,
    params=[380, 380, 512, 384, 0.02, -0.01, 0.002, 0.0],
)


@dataclass(frozen=True)
class Trial:
    """Matches and the pose they came from."""

    keypoints: np.ndarray
    points: np.ndarray
    weights: np.ndarray
    camera_from_map: pycolmap.Rigid3d


def make_trial(
    camera: pycolmap.Camera,
    seed: int,
    matches: int = 150,
    outliers: int = 50,
    noise: float = 1.0,
    unit: float = 1.0,
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Trial:
    rng = np.random.default_rng(seed)
    pixels = rng.uniform([20, 20], [camera.width - 20, camera.height - 20], (3 * matches, 2))
    rays = undistort(pixels, camera)
    known = np.flatnonzero(np.isfinite(rays).all(axis=1))[:matches]
    depth = rng.uniform(3.0, 9.0, (len(known), 1)) * unit
    in_camera = np.hstack([rays[known], np.ones_like(depth)]) * depth
    rotation = Rotation.random(rng=rng)
    position = rng.normal(0.0, unit, 3) + centre
    camera_from_map = rigid3d_from_rotation(rotation, -rotation.apply(position))
    points = camera_from_map.inverse() * in_camera
    keypoints = pixels[known] + rng.normal(0.0, noise, (len(known), 2))
    weights = rng.uniform(0.3, 1.0, len(known))
    keypoints[:outliers] = rng.uniform([0, 0], [camera.width, camera.height], (outliers, 2))
    weights[:outliers] = rng.uniform(0.0, 0.8, outliers)
    return Trial(keypoints, points, weights, camera_from_map)


def estimate(trial: Trial, camera: pycolmap.Camera) -> AbsolutePose:
    pose = estimate_pose(trial.keypoints, trial.points, trial.weights, camera)
    assert pose is not None
    return pose


def drawn_from_the_noise_model(camera: pycolmap.Camera, seed: int) -> tuple[Trial, np.ndarray]:
    """A trial whose keypoints and points err as `pose_covariance` says, and C of the points.

    Keypoints have noise of their own, points are off by what lines of sight with the same noise
    allow, and both share a part with their neighbours.
    """
    noise = 0.9
    own, common = noise * np.sqrt([1.0 - SHARED_VARIANCE, SHARED_VARIANCE])
    trial = make_trial(camera, seed, outliers=0, noise=0.0)
    rng = np.random.default_rng(10_000 + seed)
    count = len(trial.keypoints)
    factors = rng.normal(0.0, 1.0, (count, 3, 3)) * rng.uniform(0.5, 4.0, (count, 1, 1))
    covariances = factors @ np.swapaxes(factors, 1, 2)
    in_camera = trial.camera_from_map * trial.points
    _, across = projection_jacobians(camera, in_camera)
    by_point = across @ trial.camera_from_map.rotation.matrix()
    focal = camera.mean_focal_length()
    spread = np.eye(2) + by_point @ covariances @ np.swapaxes(by_point, 1, 2) / focal**2

    apart = cdist(trial.keypoints, trial.keypoints) / max(camera.width, camera.height)
    correlation = np.exp(-0.5 * np.square(apart / SHARED_DISTANCE)) + 1e-6 * np.eye(count)
    shared = np.linalg.cholesky(correlation) @ rng.normal(0.0, common, (count, 2))
    shared = np.einsum('kij,kj->ki', [sqrtm(each) for each in spread], shared)
    keypoints = trial.keypoints + rng.normal(0.0, own, (count, 2)) + shared
    wrong = np.einsum('kij,kj->ki', factors, rng.normal(0.0, own / focal, (count, 3)))
    return replace(trial, keypoints=keypoints, points=trial.points + wrong), covariances


@pytest.mark.parametrize('camera', [PINHOLE, FISHEYE], ids=['pinhole', 'fisheye'])
def test_covariance_tells_the_true_spread(camera: pycolmap.Camera) -> None:
    """Normalised errors squared of 500 trials: their mean within the 95 % band of chi-square."""
    trials = 500
    errors = []
    for seed in range(trials):
        trial, covariances = drawn_from_the_noise_model(camera, seed)
        pose = estimate_pose(
            trial.keypoints, trial.points, trial.weights, camera, covariances=covariances
        )
        assert pose is not None
        errors.append(
            normalised_error_squared(pose.camera_from_map, trial.camera_from_map, pose.covariance)
        )
    low, high = chi2.ppf([0.025, 0.975], 6 * trials) / trials
    assert low <= np.mean(errors) <= high
    assert max(errors) < 10.0**2


def with_neighbours_of_the_point(trial: Trial, share: float) -> tuple[Trial, np.ndarray]:
    """Some of the true matches shifted to one side by a few pixels, and which are not."""
    count = len(trial.keypoints)
    nearest = np.arange(count) >= share * count
    shift = np.where(nearest[:, None], 0.0, [6.0, 3.0])
    return replace(trial, keypoints=trial.keypoints + shift), nearest


@pytest.mark.parametrize('seed', range(5))
def test_refines_with_what_looks_and_geometry_agree_on(seed: int) -> None:
    trial, nearest = with_neighbours_of_the_point(
        make_trial(PINHOLE, seed, outliers=0, noise=0.3), share=0.4
    )

    blind = estimate(trial, PINHOLE)
    told = estimate_pose(trial.keypoints, trial.points, trial.weights, PINHOLE, nearest=nearest)

    assert told is not None
    error = pose_error(told.camera_from_map, trial.camera_from_map)
    assert error.rotation_deg < 0.05
    assert (
        error.rotation_deg < pose_error(blind.camera_from_map, trial.camera_from_map).rotation_deg
    )


def test_looks_have_no_say_where_they_are_the_minority() -> None:
    trial, nearest = with_neighbours_of_the_point(make_trial(PINHOLE, 0, outliers=0), share=0.8)

    blind = estimate(trial, PINHOLE)
    told = estimate_pose(trial.keypoints, trial.points, trial.weights, PINHOLE, nearest=nearest)

    assert told is not None
    np.testing.assert_array_equal(told.camera_from_map.matrix(), blind.camera_from_map.matrix())


@pytest.mark.parametrize('model', CAMERA_MODELS)
def test_every_camera_model_recovers_the_pose(model: str) -> None:
    camera = pycolmap.Camera.create_from_model_name(1, model, 700.0, 1024, 768)
    trial = make_trial(camera, seed=4)
    error = pose_error(estimate(trial, camera).camera_from_map, trial.camera_from_map)
    assert error.position < 0.05
    assert error.rotation_deg < 0.3


@pytest.mark.parametrize(
    ('model', 'params'),
    [
        ('OPENCV', [800, 800, 512, 384, -0.3, 0.1, 0.001, -0.001]),
        ('FULL_OPENCV', [800, 800, 512, 384, 0.3, -0.1, 0.001, 0.0, 0.02, 0.5, 0.0, 0.0]),
        ('OPENCV_FISHEYE', [330, 330, 512, 384, -0.02, 0.01, 0.0, 0.0]),
        ('THIN_PRISM_FISHEYE', [330, 330, 512, 384, -0.02, 0.01, 1e-3, 1e-3, 0, 0, 1e-3, 0]),
    ],
)
def test_distortion_is_taken_into_account(model: str, params: list[float]) -> None:
    camera = pycolmap.Camera(camera_id=1, model=model, width=1024, height=768, params=params)
    trial = make_trial(camera, seed=9)
    pose = estimate(trial, camera)
    error = pose_error(pose.camera_from_map, trial.camera_from_map)
    assert error.position < 0.05
    assert error.rotation_deg < 0.5
    assert np.count_nonzero(pose.inliers[50:]) >= 97


@pytest.mark.parametrize('unit', [1e-3, 1.0, 1e4])
def test_result_does_not_depend_on_the_unit_of_the_map(unit: float) -> None:
    trial = make_trial(PINHOLE, seed=2, unit=unit)
    reference_trial = make_trial(PINHOLE, seed=2)
    pose, reference = estimate(trial, PINHOLE), estimate(reference_trial, PINHOLE)
    scale = np.repeat([unit, 1.0], 3)
    np.testing.assert_allclose(
        pose.covariance / np.outer(scale, scale), reference.covariance, rtol=1e-3, atol=1e-10
    )
    np.testing.assert_array_equal(pose.inliers, reference.inliers)


def test_far_from_the_origin_the_covariance_stays_positive_definite() -> None:
    trial = make_trial(PINHOLE, seed=3, centre=(3e5, 5e6, 100.0))
    pose = estimate(trial, PINHOLE)
    np.linalg.cholesky(pose.covariance)
    assert pose_error(pose.camera_from_map, trial.camera_from_map).position < 0.05


def test_same_matches_give_the_same_bytes() -> None:
    trial = make_trial(PINHOLE, seed=5, outliers=100)
    first, second = estimate(trial, PINHOLE), estimate(trial, PINHOLE)
    assert first.camera_from_map.matrix().tobytes() == second.camera_from_map.matrix().tobytes()
    assert first.covariance.tobytes() == second.covariance.tobytes()


def test_finds_few_correct_matches_among_many_when_they_weigh_most() -> None:
    trial = make_trial(PINHOLE, seed=6, matches=1000, outliers=950)
    pose = estimate(trial, PINHOLE)
    assert np.count_nonzero(pose.inliers[950:]) >= 45
    assert pose_error(pose.camera_from_map, trial.camera_from_map).position < 0.1


@given(
    matches=st.integers(0, 60),
    share_of_outliers=st.floats(0.0, 1.0),
    noise=st.floats(0.0, 5.0),
    seed=st.integers(0, 1000),
)
@settings(max_examples=60, deadline=None)
def test_a_pose_is_always_well_formed(
    matches: int, share_of_outliers: float, noise: float, seed: int
) -> None:
    trial = make_trial(PINHOLE, seed, matches, int(matches * share_of_outliers), noise)
    options = PoseOptions(max_iterations=500)
    pose = estimate_pose(trial.keypoints, trial.points, trial.weights, PINHOLE, options)
    if pose is None:
        return
    assert np.count_nonzero(pose.inliers) >= 4
    assert np.isfinite(pose.covariance).all()
    assert (pose.covariance == pose.covariance.T).all()
    np.linalg.cholesky(pose.covariance)
    assert np.isfinite(pose.camera_from_map.matrix()).all()


@pytest.mark.parametrize('kind', ['one point', 'a line', 'one pixel'])
def test_degenerate_matches_give_no_confident_pose(kind: str) -> None:
    trial = make_trial(PINHOLE, seed=7, outliers=0)
    keypoints, points = trial.keypoints.copy(), trial.points.copy()
    if kind == 'one point':
        points[:] = points[0]
    elif kind == 'a line':
        points[:] = points[0] + np.linspace(0.0, 1.0, len(points))[:, None] * [1.0, 2.0, 3.0]
        keypoints[:] = np.asarray(PINHOLE.img_from_cam(trial.camera_from_map * points))
    else:
        keypoints[:] = keypoints[0]
    pose = estimate_pose(keypoints, points, trial.weights, PINHOLE)
    if pose is not None:
        worst = np.sqrt(np.linalg.eigvalsh(pose.covariance[3:, 3:])[-1])
        assert np.count_nonzero(pose.inliers) < 20 or np.rad2deg(worst) > 2.0


def test_points_behind_the_camera_are_no_inliers() -> None:
    trial = make_trial(PINHOLE, seed=8, outliers=0)
    points = trial.points.copy()
    centre = trial.camera_from_map.tgt_origin_in_src()
    points[:10] = 2.0 * centre - points[:10]
    pose = estimate(Trial(trial.keypoints, points, trial.weights, trial.camera_from_map), PINHOLE)
    assert not pose.inliers[:10].any()
    assert np.isinf(pose.errors[:10]).all()


def with_others(trial: Trial, keypoints: np.ndarray, points: np.ndarray) -> Trial:
    """The trial with more matches behind its own, of middling weight."""
    return Trial(
        np.vstack([trial.keypoints, keypoints]),
        np.vstack([trial.points, points]),
        np.concatenate([trial.weights, np.full(len(points), 0.5)]),
        trial.camera_from_map,
    )


def with_copies(trial: Trial, rows: np.ndarray) -> Trial:
    """The trial with some of its matches once more for every time that they are named."""
    return with_others(trial, trial.keypoints[rows], trial.points[rows])


def assert_one_to_one(pose: AbsolutePose, trial: Trial) -> None:
    for side in (trial.keypoints, trial.points):
        inliers = side[pose.inliers]
        assert len(np.unique(inliers, axis=0)) == len(inliers)


@given(seed=st.integers(0, 1000), distinct=st.integers(1, 20), copies=st.integers(1, 50))
@settings(max_examples=25, deadline=None)
def test_copies_of_matches_change_neither_pose_nor_covariance_nor_count(
    seed: int, distinct: int, copies: int
) -> None:
    trial = make_trial(PINHOLE, seed, matches=80, outliers=20)
    rows = np.random.default_rng(seed).permutation(80)[:distinct]
    copied = with_copies(trial, np.repeat(rows, copies))

    alone, together = estimate(trial, PINHOLE), estimate(copied, PINHOLE)

    assert_one_to_one(together, copied)
    assert np.count_nonzero(together.inliers) == np.count_nonzero(alone.inliers)
    per_direction = eigh(together.covariance, alone.covariance, eigvals_only=True)
    np.testing.assert_allclose(per_direction, 1.0, atol=0.02)
    np.testing.assert_allclose(
        together.camera_from_map.matrix(), alone.camera_from_map.matrix(), atol=1e-4
    )


@given(seed=st.integers(0, 1000), crowd=st.integers(2, 40))
@settings(max_examples=25, deadline=None)
def test_of_many_matches_of_a_keypoint_or_of_a_point_one_is_an_inlier(
    seed: int, crowd: int
) -> None:
    trial = make_trial(PINHOLE, seed, matches=80, outliers=20)
    rng = np.random.default_rng(seed)
    keypoint, point = 30, 40
    beside_the_keypoint = trial.keypoints[[point]] + rng.normal(0.0, 1.0, (crowd, 2))
    on_the_ray = trial.camera_from_map.inverse() * (
        (trial.camera_from_map * trial.points[[keypoint]]) * rng.uniform(0.8, 1.2, (crowd, 1))
    )
    crowded = with_others(
        trial,
        np.vstack([beside_the_keypoint, np.tile(trial.keypoints[keypoint], (crowd, 1))]),
        np.vstack([np.tile(trial.points[point], (crowd, 1)), on_the_ray]),
    )

    alone, pose = estimate(trial, PINHOLE), estimate(crowded, PINHOLE)

    assert_one_to_one(pose, crowded)
    error = pose_error(pose.camera_from_map, trial.camera_from_map)
    assert error.position < 0.1
    per_direction = eigh(pose.covariance, alone.covariance, eigvals_only=True)
    assert per_direction.min() > 0.7


@given(seed=st.integers(0, 1000), distinct=st.integers(1, 5), copies=st.integers(20, 300))
@settings(max_examples=25, deadline=None)
def test_a_flood_of_copies_of_few_matches_speaks_for_no_pose(
    seed: int, distinct: int, copies: int
) -> None:
    few = make_trial(PINHOLE, seed, matches=distinct, outliers=0)
    flood = with_copies(few, np.tile(np.arange(distinct), copies))

    pose = estimate_pose(flood.keypoints, flood.points, flood.weights, PINHOLE)

    if pose is not None:
        assert_one_to_one(pose, flood)
        assert np.count_nonzero(pose.inliers) <= distinct


def test_true_matches_win_against_a_flood_of_copies_of_wrong_ones() -> None:
    trial = make_trial(PINHOLE, seed=11, matches=100, outliers=50)
    flooded = with_copies(trial, np.repeat(np.arange(10), 60))

    pose = estimate(flooded, PINHOLE)

    assert pose_error(pose.camera_from_map, trial.camera_from_map).position < 0.1
    assert np.count_nonzero(pose.inliers[50:100]) >= 45
