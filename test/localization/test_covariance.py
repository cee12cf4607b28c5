# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Covariances of points and poses: against simulated noise, and the laws that they obey."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import block_diag, eigvalsh
from scipy.spatial.transform import Rotation
from synthetic_place import bare_map

from gam_relocalizer.geometry import rigid3d_from, rigid3d_from_rotation
from gam_relocalizer.localization.covariance import (
    MIN_SIGMA_PX,
    cauchy_scale,
    movement_jacobians,
    point_covariances,
    pose_covariance,
    projection_jacobians,
    sigma_of,
)
from gam_relocalizer.localization.verdict import worst_deviations

CAMERA = pycolmap.Camera(model='PINHOLE', width=640, height=480, params=[500, 505, 318, 243])
CAMERAS = [
    CAMERA,
    pycolmap.Camera(model='SIMPLE_RADIAL', width=640, height=480, params=[500, 318, 243, -0.1]),
    pycolmap.Camera(
        model='OPENCV',
        width=640,
        height=480,
        params=[500, 505, 318, 243, -0.2, 0.05, 0.001, -0.002],
    ),
    pycolmap.Camera(
        model='OPENCV_FISHEYE',
        width=640,
        height=480,
        params=[250, 252, 320, 240, -0.02, 0.01, 0.0, 0.0],
    ),
]
POSE = rigid3d_from_rotation(Rotation.from_rotvec([0.2, -0.4, 0.1]), [0.3, -0.2, 0.5])

rotations = st.tuples(*[st.floats(-3.0, 3.0)] * 3).map(Rotation.from_rotvec)
shifts = st.tuples(*[st.floats(-100.0, 100.0)] * 3).map(np.array)
scales = st.floats(0.01, 100.0)


def covariances_seen_from(points: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Of points [K,3] that cameras at all positions [I,3] see."""
    poses = [rigid3d_from([1, 0, 0, 0], -position) for position in positions]
    everything = np.arange(len(points))
    scene_map = bare_map(points, poses, [everything] * len(poses))
    return point_covariances(scene_map, everything, np.arange(len(poses)))


def triangulated(point: np.ndarray, positions: np.ndarray, sigma: float, draws: int) -> np.ndarray:
    """Points [T,3] nearest to lines of sight that are off by sigma [rad] across each axis."""
    rng = np.random.default_rng(0)
    sight = point - positions
    distances = np.linalg.norm(sight, axis=1)[:, None]
    sight = sight / distances + rng.normal(0.0, sigma, (draws, len(positions), 3))
    sight /= np.linalg.norm(sight, axis=2, keepdims=True)
    across = (np.eye(3) - sight[..., :, None] * sight[..., None, :]) / distances[..., None] ** 2
    sums = np.einsum('tnij,nj->ti', across, positions)
    return np.linalg.solve(across.sum(axis=1), sums[..., None])[..., 0]


@pytest.mark.parametrize(
    'positions',
    [
        np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]),
        np.array([[-0.2, 0.0, 0.0], [0.1, 0.1, 0.0], [0.2, 0.0, 0.1]]),
        np.array([[-3.0, 0.0, 4.0], [2.0, 1.0, 0.0], [0.0, -2.0, 2.0], [0.0, 1.0, -8.0]]),
    ],
    ids=['two', 'close together', 'all around'],
)
def test_triangulated_points_are_as_far_off_as_their_covariance_says(
    positions: np.ndarray,
) -> None:
    point, sigma = np.array([0.3, -0.4, 5.0]), 2e-4
    told = sigma**2 * covariances_seen_from(point[None], positions)[0]
    found = np.cov(triangulated(point, positions, sigma, 5000).T)
    np.testing.assert_allclose(eigvalsh(found, told), 1.0, atol=0.12)


def test_point_seen_from_one_direction_is_uncertain_along_it_and_finite() -> None:
    sight = np.array([1.0, 2.0, 2.0]) / 3.0
    positions = np.array([-sight, -2.0 * sight, -3.0 * sight])
    covariance = covariances_seen_from(np.zeros((1, 3)), positions)[0]
    variances, axes = np.linalg.eigh(covariance)
    assert np.isfinite(covariance).all()
    assert abs(axes[:, 2] @ sight) == pytest.approx(1.0)
    assert variances[2] > 100.0 * variances[1] > 0.0


def test_point_in_the_very_camera_that_saw_it_is_no_error() -> None:
    positions = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    assert np.isfinite(covariances_seen_from(positions[:1], positions)).all()


@given(rotations, shifts, scales)
@settings(max_examples=30, deadline=None)
def test_points_are_as_uncertain_in_any_frame_and_unit(
    rotation: Rotation, shift: np.ndarray, scale: float
) -> None:
    rng = np.random.default_rng(0)
    points, positions = rng.normal(0.0, 3.0, (10, 3)), rng.normal(0.0, 3.0, (4, 3))
    turn = rotation.as_matrix()
    expected = scale**2 * turn @ covariances_seen_from(points, positions) @ turn.T
    moved = covariances_seen_from(
        scale * rotation.apply(points) + shift, scale * rotation.apply(positions) + shift
    )
    np.testing.assert_allclose(moved, expected, rtol=1e-5, atol=1e-7 * np.abs(expected).max())


class Matches:
    """Matches of a view of scattered points, with noise."""

    def __init__(
        self,
        noise: float = 1.0,
        corner: tuple[float, float] = (640.0, 480.0),
        point_sigma: float = 0.0,
    ) -> None:
        rng = np.random.default_rng(0)
        pixels = rng.uniform([0.0, 0.0], corner, (200, 2))
        in_camera = np.column_stack([CAMERA.cam_from_img(pixels), np.ones(200)])
        in_camera *= rng.uniform(2.0, 8.0, (200, 1))
        self.points = POSE.inverse() * in_camera
        self.keypoints = pixels + rng.normal(0.0, noise, pixels.shape)
        across = rng.normal(size=(200, 3, 3))
        self.covariances = point_sigma**2 * (np.eye(3) + across @ np.swapaxes(across, 1, 2))

    def covariance(self) -> np.ndarray:
        covariance = pose_covariance(POSE, self.keypoints, self.points, self.covariances, CAMERA)
        assert covariance is not None
        np.linalg.cholesky(covariance)
        assert (covariance == covariance.T).all()
        return covariance


@given(rotations, shifts, scales)
@settings(max_examples=30, deadline=None)
def test_poses_are_as_uncertain_in_any_frame_and_unit(
    rotation: Rotation, shift: np.ndarray, scale: float
) -> None:
    matches, turn = Matches(point_sigma=2.0), rotation.as_matrix()
    to_frame = rigid3d_from_rotation(rotation, shift)
    scaled_pose = pycolmap.Rigid3d(POSE.rotation, scale * POSE.translation)
    moved = pose_covariance(
        scaled_pose * to_frame.inverse(),
        matches.keypoints,
        to_frame * (scale * matches.points),
        scale**2 * turn @ matches.covariances @ turn.T,
        CAMERA,
    )
    carry = block_diag(scale * turn, turn)
    expected = carry @ matches.covariance() @ carry.T
    deviations = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        moved / np.outer(deviations, deviations),
        expected / np.outer(deviations, deviations),
        atol=1e-4,
    )


def test_more_noise_makes_every_direction_less_certain() -> None:
    less, more = (Matches(noise).covariance() for noise in (1.0, 2.0))
    assert (eigvalsh(more, less) > 1.5).all()


def test_uncertain_points_make_a_pose_less_certain() -> None:
    exact, rough = (Matches(point_sigma=sigma).covariance() for sigma in (0.0, 10.0))
    for of_rough, of_exact in zip(worst_deviations(rough), worst_deviations(exact), strict=True):
        assert of_rough > 1.2 * of_exact


def test_inliers_in_one_corner_make_a_pose_less_certain() -> None:
    spread, corner = Matches().covariance(), Matches(corner=(160.0, 120.0)).covariance()
    for of_corner, of_spread in zip(
        worst_deviations(corner), worst_deviations(spread), strict=True
    ):
        assert of_corner > 3.0 * of_spread


def test_matches_that_say_nothing_new_do_not_make_a_pose_certain() -> None:
    """What neighbours share does not average out."""
    once, often = Matches(), Matches()
    for name in ('keypoints', 'points', 'covariances'):
        setattr(often, name, np.repeat(getattr(once, name), 50, axis=0))
    for of_often, of_once in zip(
        worst_deviations(often.covariance()), worst_deviations(once.covariance()), strict=True
    ):
        assert of_often > 0.2 * of_once


def test_sigma_is_that_of_the_noise_whatever_the_outliers() -> None:
    rng = np.random.default_rng(0)
    errors = np.linalg.norm(rng.normal(0.0, 3.0, (4000, 2)), axis=1)
    assert sigma_of(errors) == pytest.approx(3.0, rel=0.05)
    errors[:400] = 1e3
    assert sigma_of(errors) == pytest.approx(3.0, rel=0.15)
    assert sigma_of(np.zeros(10)) == MIN_SIGMA_PX
    assert cauchy_scale(10.0 * errors) == pytest.approx(10.0 * cauchy_scale(errors))


def points_in_view(camera: pycolmap.Camera) -> np.ndarray:
    rng = np.random.default_rng(0)
    pixels = rng.uniform([20.0, 20.0], [620.0, 460.0], (50, 2))
    return np.column_stack([camera.cam_from_img(pixels), np.ones(50)]) * rng.uniform(
        0.5, 20.0, (50, 1)
    )


@pytest.mark.parametrize('camera', CAMERAS, ids=lambda camera: camera.model_name)
def test_projections_change_with_points_as_the_jacobians_say(camera: pycolmap.Camera) -> None:
    points = points_in_view(camera)
    projected, jacobians = projection_jacobians(camera, points)
    np.testing.assert_array_equal(projected, camera.img_from_cam(points))
    steps = np.random.default_rng(1).normal(0.0, 1e-4, points.shape) * points[:, 2:]
    found = (camera.img_from_cam(points + steps) - camera.img_from_cam(points - steps)) / 2.0
    np.testing.assert_allclose(np.einsum('kij,kj->ki', jacobians, steps), found, atol=1e-6)


@pytest.mark.parametrize('camera', CAMERAS, ids=lambda camera: camera.model_name)
def test_projections_change_with_the_pose_as_the_jacobians_say(camera: pycolmap.Camera) -> None:
    points = points_in_view(camera)
    jacobians = movement_jacobians(points, projection_jacobians(camera, points)[1])
    for axis, step in enumerate([1e-5] * 6):
        movement = np.eye(6)[axis] * step
        ahead, behind = (
            camera.img_from_cam(
                Rotation.from_rotvec(sign * movement[:3]).apply(points) + sign * movement[3:]
            )
            for sign in (1.0, -1.0)
        )
        found = (ahead - behind) / (2.0 * step)
        np.testing.assert_allclose(jacobians[:, :, axis], found, rtol=1e-4, atol=1e-3)
