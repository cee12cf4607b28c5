# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""TUM RGB-D (Sturm et al., IROS 2012).

    rgb.txt           `time file` of the colour images
    groundtruth.txt   `time tx ty tz qx qy qz qw`: world_from_camera of the colour camera, optical

The frame is that of the motion capture: z up.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from gam_relocalizer.cameras import CameraCalibration, camera_from_calibration
from gam_relocalizer.datasets.text import pose_of_quaternion, read_lines
from gam_relocalizer.datasets.trajectory import Trajectory
from gam_relocalizer.errors import DatasetError
from gam_relocalizer.image_set import ImageSet

if TYPE_CHECKING:
    from pathlib import Path

    import pycolmap

_NS_PER_S = 10**9
# fx, fy, cx, cy, then k1, k2, p1, p2, k3: the calibrations that come with the dataset.
_CALIBRATIONS = {
    'freiburg1': (
        (517.3, 516.5, 318.6, 255.3),
        (0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    ),
    'freiburg2': (
        (520.9, 521.0, 325.1, 249.7),
        (0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    ),
    'freiburg3': ((535.4, 539.2, 320.1, 247.6), (0.0, 0.0, 0.0, 0.0, 0.0)),
}


def read(folder: Path) -> ImageSet:
    """The colour images of a sequence; the name of its folder tells the camera.

    Raises:
        DatasetError: Files missing or malformed.
    """
    trajectory = _read_trajectory(folder / 'groundtruth.txt')
    stamps: dict[str, int] = {}
    for line in read_lines(folder / 'rgb.txt'):
        line.expect(2, 'time file')
        stamps[line.file_name(1)] = line.stamp_ns(_NS_PER_S)
    if not stamps:
        msg = f'{folder / "rgb.txt"}: no images in it; expected lines `time file`'
        raise DatasetError(msg)
    names = tuple(sorted(stamps, key=lambda name: stamps[name]))
    camera = _camera_of(folder.absolute().name)
    poses = {name: trajectory.at(stamps[name]) for name in names}
    return ImageSet(
        folder,
        names,
        {} if camera is None else dict.fromkeys(names, camera),
        {name: pose.inverse() for name, pose in poses.items() if pose is not None},
    )


def _read_trajectory(file: Path) -> Trajectory:
    samples: dict[int, pycolmap.Rigid3d] = {}
    for line in read_lines(file):
        numbers = line.numbers(1, 7, 'time tx ty tz qx qy qz qw')
        samples[line.stamp_ns(_NS_PER_S)] = pose_of_quaternion(
            numbers[[6, 3, 4, 5]], numbers[:3], line.where
        )
    return Trajectory.of_samples(samples, file)


def _camera_of(folder_name: str) -> pycolmap.Camera | None:
    for name, ((fx, fy, cx, cy), distortion) in _CALIBRATIONS.items():
        if name in folder_name:
            calibration = CameraCalibration(
                width=640,
                height=480,
                distortion_model='plumb_bob',
                d=distortion,
                k=(fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0),
                p=(),
            )
            return camera_from_calibration(calibration, image_is_rectified=False)
    return None
