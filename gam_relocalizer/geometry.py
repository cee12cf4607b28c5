# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Thin helpers around pycolmap's rigid transforms: files, errors and covariance transport."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from gam_relocalizer.errors import PosesFileError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class PoseError:
    """How far an estimate is from the truth.

    Attributes:
        position: Distance between the two positions [unit of the map, m when metric].
        rotation_deg: Angle between the two orientations [deg].
    """

    position: float
    rotation_deg: float


def rigid3d_from(quaternion_wxyz: ArrayLike, translation: ArrayLike) -> pycolmap.Rigid3d:
    """Rigid transform from a quaternion (w, x, y, z; any length but zero) and a translation [3].

    Raises:
        ValueError: The quaternion is zero.
    """
    # not through SciPy, which takes long for one: all of /tf and the odometry come through here
    rotation = pycolmap.Rotation3d(np.asarray(quaternion_wxyz, dtype=float)[[1, 2, 3, 0]])
    if rotation.norm() == 0.0:
        msg = 'a quaternion of length zero is no rotation'
        raise ValueError(msg)
    rotation.normalize()
    return pycolmap.Rigid3d(rotation=rotation, translation=np.asarray(translation, dtype=float))


def rigid3d_from_rotation(rotation: Rotation, translation: ArrayLike) -> pycolmap.Rigid3d:
    """Rigid transform from a scipy rotation and a translation [3]."""
    return pycolmap.Rigid3d(
        rotation=pycolmap.Rotation3d(rotation.as_quat()),
        translation=np.asarray(translation, dtype=float),
    )


def rotation_of(transform: pycolmap.Rigid3d) -> Rotation:
    """The rotation part as a scipy rotation."""
    return Rotation.from_quat(np.asarray(transform.rotation.quat))


def quaternion_wxyz(transform: pycolmap.Rigid3d) -> NDArray[np.float64]:
    """Unit quaternion w, x, y, z with w >= 0, so that equal rotations print alike."""
    x, y, z, w = rotation_of(transform).as_quat(canonical=True)
    return np.array([w, x, y, z])


def pose_error(estimated: pycolmap.Rigid3d, truth: pycolmap.Rigid3d) -> PoseError:
    """Error between two `camera_from_map` (or two `base_from_map`) transforms."""
    position = np.linalg.norm(estimated.tgt_origin_in_src() - truth.tgt_origin_in_src())
    rotation = (rotation_of(estimated) * rotation_of(truth).inv()).magnitude()
    return PoseError(float(position), math.degrees(rotation))


def read_poses(path: Path) -> dict[str, pycolmap.Rigid3d]:
    """Reads a poses file: lines `name qw qx qy qz tx ty tz` (camera_from_world), `#` comments.

    Names may hold spaces.

    Raises:
        PosesFileError: Missing file, malformed line, number that is not finite, or a name twice.
    """
    if not path.is_file():
        msg = f'{path}: no such poses file'
        raise PosesFileError(msg)
    try:
        lines = path.read_text(encoding='utf-8').splitlines()
    except (OSError, UnicodeDecodeError) as err:
        msg = f'{path}: cannot be read as a poses file: {err}'
        raise PosesFileError(msg) from err
    poses: dict[str, pycolmap.Rigid3d] = {}
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith('#'):
            continue
        name, camera_from_world = _parse_pose(line, f'{path}:{number}')
        if name in poses:
            msg = f'{path}:{number}: image `{name}` has a second pose'
            raise PosesFileError(msg)
        poses[name] = camera_from_world
    if not poses:
        msg = f'{path}: no poses in it; expected lines `name qw qx qy qz tx ty tz`'
        raise PosesFileError(msg)
    return poses


def write_poses(path: Path, poses: Mapping[str, pycolmap.Rigid3d]) -> None:
    """Writes lines `name qw qx qy qz tx ty tz` (the long-term visual localization benchmark's)."""
    lines = [
        ' '.join(
            [
                name,
                *(f'{value:.12g}' for value in quaternion_wxyz(transform)),
                *(f'{value:.12g}' for value in transform.translation),
            ]
        )
        for name, transform in poses.items()
    ]
    write_text(path, ''.join(f'{line}\n' for line in lines))


def write_text(path: Path, text: str) -> None:
    """Writes a text file under a temporary name, then renames it: never a half-written file."""
    temporary = path.with_name(f'.{path.name}.part')
    temporary.write_text(text, encoding='utf-8')
    temporary.replace(path)


def skew(vector: ArrayLike) -> NDArray[np.float64]:
    """The matrix [v]x with [v]x a = v x a."""
    x, y, z = np.asarray(vector, dtype=float)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def covariance_of_map_from_camera(
    camera_from_map: pycolmap.Rigid3d, covariance: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Covariance of the camera's pose in the map, from that of its movements in its own frame.

    Args:
        camera_from_map: The estimate.
        covariance: [6,6] of small rotations about and then small shifts along the camera's axes,
            that is of `camera_from_map` <- exp(movement) * `camera_from_map`.

    Returns:
        [6,6] in the order of REP-103: x, y, z, rotations about the fixed x, y, z axes of the map.
    """
    map_from_camera_rotation = rotation_of(camera_from_map).as_matrix().T
    jacobian = np.zeros((6, 6))
    jacobian[:3, 3:] = -map_from_camera_rotation
    jacobian[3:, :3] = -map_from_camera_rotation
    return symmetric(jacobian @ covariance @ jacobian.T)


def covariance_of_map_from_base(
    map_from_camera: pycolmap.Rigid3d,
    covariance_map_from_camera: NDArray[np.float64],
    base_from_camera: pycolmap.Rigid3d,
) -> NDArray[np.float64]:
    """Carries a REP-103 covariance of the camera's pose to a body rigidly attached to it.

    Args:
        map_from_camera: The camera's pose.
        covariance_map_from_camera: [6,6], order of REP-103.
        base_from_camera: The mount, taken as exact.

    Returns:
        [6,6] covariance of `map_from_base`, order of REP-103.
    """
    base_in_camera = base_from_camera.inverse().translation
    lever_arm = rotation_of(map_from_camera).apply(base_in_camera)
    jacobian = np.eye(6)
    jacobian[:3, 3:] = -skew(lever_arm)
    return symmetric(jacobian @ covariance_map_from_camera @ jacobian.T)


def symmetric(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """The exactly symmetric part; filters refuse a covariance that is off by rounding."""
    result: NDArray[np.float64] = (matrix + matrix.T) / 2.0
    return result


def _parse_pose(line: str, where: str) -> tuple[str, pycolmap.Rigid3d]:
    words = line.rsplit(maxsplit=7)
    if len(words) != 8:
        msg = f'{where}: expected `name qw qx qy qz tx ty tz`, found `{line.strip()[:80]}`'
        raise PosesFileError(msg)
    numbers = _finite_numbers(words[1:], where)
    if np.linalg.norm(numbers[:4]) < 1e-6:
        msg = f'{where}: the quaternion is zero'
        raise PosesFileError(msg)
    return words[0], rigid3d_from(numbers[:4], numbers[4:])


def _finite_numbers(words: Sequence[str], where: str) -> list[float]:
    try:
        numbers = [float(word) for word in words]
    except ValueError as err:
        msg = f'{where}: not a number: {err}'
        raise PosesFileError(msg) from err
    if not all(math.isfinite(number) for number in numbers):
        msg = f'{where}: a number is not finite'
        raise PosesFileError(msg)
    return numbers
