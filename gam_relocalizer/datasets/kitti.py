# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""KITTI odometry (Geiger et al., CVPR 2012).

    sequences/00/image_2/000000.png   the left colour camera; image_0 is the left grey one
    sequences/00/calib.txt            `P2: 12 numbers`, 3x4: pixels of camera 2 from places in
                                      camera 0's frame; images are rectified
    sequences/00/times.txt            a line per image
    poses/00.txt                      12 numbers, 3x4: world_from_camera of camera 0

The frame is that of the first camera 0: x right, y down, z forward.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pycolmap

from gam_relocalizer.cameras import CameraCalibration, camera_from_calibration
from gam_relocalizer.datasets.text import pose_of_matrix, read_lines
from gam_relocalizer.errors import CameraError, DatasetError, ImageError
from gam_relocalizer.image_set import ImageSet
from gam_relocalizer.images import read_image

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

_CAMERAS = (2, 0)


def read(folder: Path) -> ImageSet:
    """The images of a sequence; `folder` is sequences/NN, or the root if it has one sequence.

    Colour images are taken where they are, else the grey ones.

    Raises:
        DatasetError: Files missing or malformed, or several sequences.
    """
    sequence = _sequence_of(folder)
    camera = next((one for one in _CAMERAS if (sequence / f'image_{one}').is_dir()), None)
    if camera is None:
        msg = f'{sequence}: neither image_2 nor image_0 is there'
        raise DatasetError(msg)
    projection = _read_projection(sequence / 'calib.txt', f'P{camera}')
    camera_from_camera0 = pycolmap.Rigid3d(
        rotation=pycolmap.Rotation3d(),
        translation=np.linalg.solve(projection[:, :3], projection[:, 3]),
    )
    poses = _read_poses(sequence)
    names = tuple(f'image_{camera}/{index:06d}.png' for index in range(len(poses)))
    return ImageSet(
        sequence,
        names,
        dict.fromkeys(names, _camera(projection, sequence, names)),
        {
            name: camera_from_camera0 * world_from_camera0.inverse()
            for name, world_from_camera0 in zip(names, poses, strict=True)
        },
    )


def _sequence_of(folder: Path) -> Path:
    if (folder / 'calib.txt').is_file():
        return folder.absolute()
    found = sorted((folder / 'sequences').glob('*/calib.txt'))
    if len(found) != 1:
        names = ', '.join(str(file.parent.relative_to(folder)) for file in found) or 'none'
        msg = f'{folder}: give the folder of one sequence; found {names}'
        raise DatasetError(msg)
    return found[0].parent.absolute()


def _read_projection(file: Path, name: str) -> NDArray[np.float64]:
    """[3,4] the projection of a rectified camera."""
    for line in read_lines(file):
        if line.words[0] != f'{name}:':
            continue
        projection = line.numbers(1, 12, f'{name}: 12 numbers').reshape(3, 4)
        matrix = projection[:, :3]
        is_upper = np.abs(np.tril(matrix, -1)).max() == 0.0 and matrix[2, 2] == 1.0
        if not (np.isfinite(projection).all() and is_upper and min(np.diag(matrix)) > 0.0):
            msg = f'{line.where}: {name} is not the projection of a rectified camera'
            raise DatasetError(msg)
        return projection
    msg = f'{file}: no line `{name}: ...` in it'
    raise DatasetError(msg)


def _read_poses(sequence: Path) -> list[pycolmap.Rigid3d]:
    """world_from_camera0 of each image."""
    file = sequence.parent.parent / 'poses' / f'{sequence.name}.txt'
    poses = [
        pose_of_matrix(line.numbers(0, 12, '12 numbers').reshape(3, 4), line.where)
        for line in read_lines(file)
    ]
    times = sum(1 for _ in read_lines(sequence / 'times.txt'))
    if len(poses) != times or not poses:
        msg = f'{file}: {len(poses)} poses, but {sequence / "times.txt"} has {times} images'
        raise DatasetError(msg)
    return poses


def _camera(
    projection: NDArray[np.float64], sequence: Path, names: tuple[str, ...]
) -> pycolmap.Camera:
    """The rectified camera; its images are all of the size of the first that is there."""
    first = next((sequence / name for name in names if (sequence / name).is_file()), None)
    if first is None:
        msg = f'{sequence}: none of the images is there, for example `{names[0]}`'
        raise DatasetError(msg)
    try:
        height, width = read_image(first).shape[:2]
        calibration = CameraCalibration(
            width=width,
            height=height,
            distortion_model='',
            d=(),
            k=(),
            p=tuple(float(value) for value in projection.ravel()),
        )
        return camera_from_calibration(calibration, image_is_rectified=True)
    except (ImageError, CameraError) as err:
        raise DatasetError(str(err)) from err
