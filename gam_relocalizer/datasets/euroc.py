# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""EuRoC MAV (Burri et al., IJRR 2016), and what is recorded in its layout.

    mav0/cam0/data.csv                          `stamp [ns],file` of the images in cam0/data/
    mav0/cam0/sensor.yaml                       intrinsics, distortion, T_BS: body_from_camera
    mav0/state_groundtruth_estimate0/data.csv   `stamp [ns],px,py,pz,qw,qx,qy,qz,...`:
                                                world_from_body

The frame is that of the motion capture or the laser tracker: z up.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from gam_relocalizer.cameras import CameraCalibration, camera_from_calibration
from gam_relocalizer.datasets.text import pose_of_matrix, pose_of_quaternion, read_lines
from gam_relocalizer.datasets.trajectory import Trajectory
from gam_relocalizer.errors import CameraError, DatasetError
from gam_relocalizer.image_set import ImageSet

if TYPE_CHECKING:
    from pathlib import Path

    import pycolmap

_TRUTH = 'state_groundtruth_estimate0'
_MAX_SENSOR_BYTES = 2**20
# The names of EuRoC, and of CameraInfo, for the same models.
_DISTORTION = {
    'radial-tangential': 'plumb_bob',
    'radtan': 'plumb_bob',
    'equidistant': 'equidistant',
    'none': '',
}


def read(folder: Path) -> ImageSet:
    """The images of cam0; `folder` is the recording or its mav0.

    Raises:
        DatasetError: Files missing or malformed.
    """
    root = folder / 'mav0' if (folder / 'mav0').is_dir() else folder
    sensor_file = root / 'cam0' / 'sensor.yaml'
    sensor = _read_sensor(sensor_file)
    camera_from_body = _body_from_sensor(sensor, sensor_file).inverse()
    trajectory = _read_trajectory(root / _TRUTH / 'data.csv')
    stamps: dict[str, int] = {}
    for line in read_lines(root / 'cam0' / 'data.csv', ','):
        line.expect(2, 'stamp [ns],file')
        stamps[line.file_name(1)] = line.stamp_ns(1)
    if not stamps:
        msg = f'{root / "cam0" / "data.csv"}: no images in it; expected lines `stamp [ns],file`'
        raise DatasetError(msg)
    names = tuple(sorted(stamps, key=lambda name: stamps[name]))
    poses = {name: trajectory.at(stamps[name]) for name in names}
    return ImageSet(
        root / 'cam0' / 'data',
        names,
        dict.fromkeys(names, _camera(sensor, sensor_file)),
        {
            name: camera_from_body * world_from_body.inverse()
            for name, world_from_body in poses.items()
            if world_from_body is not None
        },
    )


def _read_trajectory(file: Path) -> Trajectory:
    """world_from_body."""
    samples: dict[int, pycolmap.Rigid3d] = {}
    for line in read_lines(file, ','):
        numbers = line.numbers(1, 7, 'stamp [ns],px,py,pz,qw,qx,qy,qz')
        samples[line.stamp_ns(1)] = pose_of_quaternion(numbers[3:], numbers[:3], line.where)
    return Trajectory.of_samples(samples, file)


def _read_sensor(file: Path) -> dict[str, Any]:
    try:
        if file.stat().st_size > _MAX_SENSOR_BYTES:
            msg = f'{file}: larger than {_MAX_SENSOR_BYTES} bytes; this is no sensor.yaml'
            raise DatasetError(msg)
        # some tools write the header of OpenCV, which is not quite YAML
        text = file.read_text(encoding='utf-8').replace('%YAML:1.0', '')
        sensor = yaml.safe_load(text)
    except FileNotFoundError as err:
        msg = f'{file}: missing'
        raise DatasetError(msg) from err
    except (OSError, UnicodeDecodeError, yaml.YAMLError, RecursionError) as err:
        msg = f'{file}: cannot be read as YAML: {err}'
        raise DatasetError(msg) from err
    if not isinstance(sensor, dict):
        msg = f'{file}: expected names and values'
        raise DatasetError(msg)
    return sensor


def _body_from_sensor(sensor: dict[str, Any], file: Path) -> pycolmap.Rigid3d:
    try:
        data = np.array(sensor['T_BS']['data'], dtype=np.float64).reshape(4, 4)
    except (KeyError, TypeError, ValueError) as err:
        msg = f'{file}: expected T_BS with 16 numbers in data: {err!r}'
        raise DatasetError(msg) from err
    return pose_of_matrix(data, f'{file}: T_BS')


def _camera(sensor: dict[str, Any], file: Path) -> pycolmap.Camera:
    model = str(sensor.get('distortion_model', ''))
    if sensor.get('camera_model') != 'pinhole' or model not in _DISTORTION:
        msg = (
            f'{file}: camera_model `{sensor.get("camera_model")}` with distortion_model '
            f'`{model}`; known are pinhole with {", ".join(_DISTORTION)}'
        )
        raise DatasetError(msg)
    try:
        width, height = (int(value) for value in sensor['resolution'])
        fx, fy, cx, cy = (float(value) for value in sensor['intrinsics'])
        distortion = tuple(float(value) for value in sensor['distortion_coefficients'])
        calibration = CameraCalibration(
            width=width,
            height=height,
            distortion_model=_DISTORTION[model],
            d=distortion,
            k=(fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0),
            p=(),
        )
        return camera_from_calibration(calibration, image_is_rectified=False)
    except (KeyError, TypeError, ValueError, OverflowError, CameraError) as err:
        msg = f'{file}: resolution, intrinsics or distortion_coefficients are malformed: {err}'
        raise DatasetError(msg) from err
