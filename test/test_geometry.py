# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Poses in files, errors between poses, and covariances held against sampled perturbations."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from gam_relocalizer.errors import PosesFileError
from gam_relocalizer.geometry import (
    covariance_of_map_from_base,
    covariance_of_map_from_camera,
    pose_error,
    quaternion_wxyz,
    read_poses,
    rigid3d_from,
    rigid3d_from_rotation,
    rotation_of,
    skew,
    write_poses,
)

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

numbers = st.floats(-1e6, 1e6)
vectors = st.tuples(numbers, numbers, numbers)
quaternions = st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: np.linalg.norm(q) > 1e-3)
names = st.text(st.characters(blacklist_categories=('Z', 'C')), min_size=1, max_size=12).filter(
    lambda name: not name.startswith('#')
)


def random_covariance(rng: np.random.Generator) -> np.ndarray:
    factor = rng.normal(size=(6, 6))
    return 1e-6 * (factor @ factor.T + 0.1 * np.eye(6))


@given(quaternions, vectors)
def test_rigid_transform_and_its_quaternion_are_inverse(q: tuple, t: tuple) -> None:
    transform = rigid3d_from(q, t)
    wxyz = quaternion_wxyz(transform)
    assert np.linalg.norm(wxyz) == pytest.approx(1.0, abs=1e-12)
    assert wxyz[0] >= 0
    unit = np.array(q) / np.linalg.norm(q)
    assert abs(wxyz @ unit) == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_array_equal(transform.translation, t)


@given(st.dictionaries(names, st.tuples(quaternions, vectors), min_size=1, max_size=4))
def test_poses_survive_the_file(tmp_path_factory, entries: dict) -> None:  # noqa: ANN001
    file = tmp_path_factory.mktemp('poses') / 'poses.txt'
    poses = {name: rigid3d_from(q, t) for name, (q, t) in entries.items()}
    write_poses(file, poses)
    read = read_poses(file)
    assert list(read) == list(poses)
    for name, transform in poses.items():
        np.testing.assert_allclose(read[name].matrix(), transform.matrix(), rtol=1e-9, atol=1e-9)


def test_reads_names_with_spaces_comments_and_blank_lines(tmp_path: Path) -> None:
    file = tmp_path / 'poses.txt'
    file.write_text('# name qw qx qy qz tx ty tz\n\nleft camera/a b.png 1 0 0 0 1 2 3\n')
    poses = read_poses(file)
    assert list(poses) == ['left camera/a b.png']
    np.testing.assert_array_equal(poses['left camera/a b.png'].translation, [1, 2, 3])


@pytest.mark.parametrize(
    'content',
    [
        '',
        '# only a comment\n',
        'a.png 1 0 0 0 1 2\n',
        '1 0 0 0 1 2 3\n',
        'a.png 1 0 0 0 1 2 x\n',
        'a.png 1 0 0 0 1 2 nan\n',
        'a.png 1 0 0 0 1 inf 3\n',
        'a.png 0 0 0 0 1 2 3\n',
        'a.png 1 0 0 0 1 2 3\na.png 1 0 0 0 1 2 3\n',
    ],
)
def test_refuses_malformed_poses(tmp_path: Path, content: str) -> None:
    file = tmp_path / 'poses.txt'
    file.write_text(content)
    with pytest.raises(PosesFileError):
        read_poses(file)


def test_refuses_missing_and_binary_poses_files(tmp_path: Path) -> None:
    (tmp_path / 'poses.txt').write_bytes(b'\xff\xfe\x00')
    for name in ('none.txt', 'poses.txt'):
        with pytest.raises(PosesFileError):
            read_poses(tmp_path / name)


def test_pose_error_measures_position_and_angle() -> None:
    rng = np.random.default_rng(3)
    rotation = Rotation.random(rng=rng)
    centre = np.array([4.0, -2.0, 1.0])
    truth = rigid3d_from_rotation(rotation, -rotation.apply(centre))
    turned = Rotation.from_rotvec([0.0, 0.0, np.deg2rad(3.0)]) * rotation
    estimate = rigid3d_from_rotation(turned, -turned.apply(centre + np.array([0.3, 0.0, 0.4])))
    error = pose_error(estimate, truth)
    assert error.position == pytest.approx(0.5)
    assert error.rotation_deg == pytest.approx(3.0)


@given(vectors, vectors)
def test_skew_is_the_cross_product(a: tuple, b: tuple) -> None:
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), rtol=1e-9, atol=1e-3)


def sampled_covariance(transforms: list, reference) -> np.ndarray:  # noqa: ANN001
    """Of poses around a reference, in the order of REP-103."""
    rotations = Rotation.concatenate([rotation_of(transform) for transform in transforms])
    turns = (rotations * rotation_of(reference).inv()).as_rotvec()
    moves = np.array([transform.translation for transform in transforms]) - reference.translation
    return np.cov(np.hstack([moves, turns]).T)


def assert_same_covariance(sampled: np.ndarray, carried: np.ndarray) -> None:
    """Within sampling noise: about 1 % of the standard deviations for 20 000 samples."""
    deviations = np.sqrt(np.diag(carried))
    np.testing.assert_allclose(
        sampled / np.outer(deviations, deviations),
        carried / np.outer(deviations, deviations),
        atol=0.04,
    )
    np.testing.assert_array_equal(carried, carried.T)
    np.linalg.cholesky(carried)


def test_covariance_of_the_inverse_matches_samples() -> None:
    rng = np.random.default_rng(5)
    camera_from_map = rigid3d_from(rng.normal(size=4), [3.0, -2.0, 5.0])
    covariance = random_covariance(rng)
    deltas = rng.multivariate_normal(np.zeros(6), covariance, 20_000)
    samples = [
        (
            rigid3d_from_rotation(Rotation.from_rotvec(delta[:3]), delta[3:]) * camera_from_map
        ).inverse()
        for delta in deltas
    ]
    assert_same_covariance(
        sampled_covariance(samples, camera_from_map.inverse()),
        covariance_of_map_from_camera(camera_from_map, covariance),
    )


def test_covariance_of_the_base_matches_samples_of_a_rotated_offset_mount() -> None:
    rng = np.random.default_rng(6)
    map_from_camera = rigid3d_from(rng.normal(size=4), [10.0, 4.0, 1.0])
    base_from_camera = rigid3d_from([0.5, -0.5, 0.5, -0.5], [0.8, -0.3, 1.2])
    covariance = random_covariance(rng)
    deltas = rng.multivariate_normal(np.zeros(6), covariance, 20_000)
    rotation = rotation_of(map_from_camera)
    samples = [
        rigid3d_from_rotation(
            Rotation.from_rotvec(delta[3:]) * rotation, map_from_camera.translation + delta[:3]
        )
        * base_from_camera.inverse()
        for delta in deltas
    ]
    assert_same_covariance(
        sampled_covariance(samples, map_from_camera * base_from_camera.inverse()),
        covariance_of_map_from_base(map_from_camera, covariance, base_from_camera),
    )


def test_a_quaternion_of_length_zero_is_no_rotation() -> None:
    with pytest.raises(ValueError, match='length zero'):
        rigid3d_from((0.0, 0.0, 0.0, 0.0), (1.0, 2.0, 3.0))


@given(hnp.arrays(float, 4, elements=st.floats(-10.0, 10.0)))
def test_the_length_of_a_quaternion_does_not_matter(wxyz: NDArray[np.float64]) -> None:
    assume(np.linalg.norm(wxyz) > 1e-3)
    expected = Rotation.from_quat(wxyz[[1, 2, 3, 0]]).as_matrix()
    found = rigid3d_from(wxyz, (0.0, 0.0, 0.0)).matrix()[:, :3]
    np.testing.assert_allclose(found, expected, atol=1e-12)
