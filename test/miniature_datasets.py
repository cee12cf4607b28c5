# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Small copies of published datasets: a rendered room with known poses, in the layout of each."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pycolmap
from corner_room import CAMERA, CornerRoom, looking_into_the_corner
from scipy.spatial.transform import Rotation

from gam_relocalizer.geometry import quaternion_wxyz, rigid3d_from_rotation

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

FOCAL = 340.0
COUNT = 8
EUROC_NS_APART = 50_000_000
FIRST_NS = 1_403_636_579_763_555_584
BODY_FROM_CAMERA = rigid3d_from_rotation(
    Rotation.from_rotvec([0.4, -1.1, 0.7]), np.array([-0.02, -0.06, 0.01])
)


def pose(index: int) -> pycolmap.Rigid3d:
    """camera_from_world of a frame."""
    return looking_into_the_corner(index / (COUNT - 1))


@cache
def _pixels(index: int) -> NDArray[np.uint8]:
    return cv2.cvtColor(CornerRoom().render(pose(index)), cv2.COLOR_RGB2BGR)


def write_frame(path: Path, index: int, scale: float = 1.0) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = _pixels(index)
    if scale != 1.0:
        pixels = cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(path), pixels)


def write_cambridge(folder: Path, radial: float = 0.0) -> dict[str, pycolmap.Rigid3d]:
    """Poses of the train images; the test image is the last one."""
    names = [f'seq1/frame{index:05d}.png' for index in range(COUNT)]
    poses = {name: pose(index) for index, name in enumerate(names)}
    for index, name in enumerate(names):
        write_frame(folder / name, index)
    header = 'Visual Landmark Dataset V1\nImageFile, Camera Position [X Y Z W P Q R]\n\n'
    lines = [
        f'{name} {_numbers(one.tgt_origin_in_src())} {_numbers(quaternion_wxyz(one))}\n'
        for name, one in poses.items()
    ]
    (folder / 'dataset_train.txt').write_text(header + ''.join(lines[:-1]))
    (folder / 'dataset_test.txt').write_text(header + lines[-1])
    cameras = [
        f'{name.replace("png", "jpg")}\t{FOCAL} {_numbers(quaternion_wxyz(one))} '
        f'{_numbers(one.tgt_origin_in_src())} {radial} 0\n'
        for name, one in poses.items()
    ]
    (folder / 'reconstruction.nvm').write_text(
        f'NVM_V3 \n\n{COUNT}\n{"".join(cameras)}\n1\n0 0 0 255 255 255 0\n'
    )
    return poses


def write_seven_scenes(folder: Path) -> dict[str, pycolmap.Rigid3d]:
    """The first half is sequence 1, to train; the others are sequence 2, to test."""
    poses: dict[str, pycolmap.Rigid3d] = {}
    for index in range(COUNT):
        sequence = 1 + 2 * index // COUNT
        name = f'seq-{sequence:02d}/frame-{index:06d}.color.png'
        write_frame(folder / name, index)
        rows = [*pose(index).inverse().matrix().tolist(), [0.0, 0.0, 0.0, 1.0]]
        text = ''.join(''.join(f'{value!r}\t ' for value in row) + '\n' for row in rows)
        (folder / name.replace('.color.png', '.pose.txt')).write_text(text)
        poses[name] = pose(index)
    (folder / 'TrainSplit.txt').write_text('sequence1\n')
    (folder / 'TestSplit.txt').write_text('sequence2\n')
    return poses


def write_tum(folder: Path) -> dict[str, pycolmap.Rigid3d]:
    """Stamps of images and poses agree but for the last image, which comes a second later."""
    truth, images, poses = ['# ground truth\n'], ['# color images\n'], {}
    for index in range(COUNT):
        stamp = f'1305031102.{175304 + 33333 * index:06d}'
        if index == COUNT - 1:
            stamp = f'1305031103.{175304 + 33333 * index:06d}'
        name = f'rgb/{stamp}.png'
        write_frame(folder / name, index)
        images.append(f'{stamp} {name}\n')
        if index == COUNT - 1:
            continue
        w, x, y, z = quaternion_wxyz(pose(index).inverse())
        position = pose(index).inverse().translation
        truth.append(f'{stamp} {_numbers(position)} {_numbers([x, y, z, w])}\n')
        poses[name] = pose(index)
    (folder / 'groundtruth.txt').write_text(''.join(truth))
    (folder / 'rgb.txt').write_text(''.join(images))
    return poses


def write_euroc(folder: Path) -> dict[str, pycolmap.Rigid3d]:
    """Poses of the body come with the stamps of the images."""
    camera, truth_folder = folder / 'mav0' / 'cam0', folder / 'mav0/state_groundtruth_estimate0'
    truth_folder.mkdir(parents=True)
    images, truth, poses = ['#timestamp [ns],filename\n'], ['#timestamp, p_RS_R_x [m]\n'], {}
    for index in range(COUNT):
        stamp = FIRST_NS + EUROC_NS_APART * index
        write_frame(camera / 'data' / f'{stamp}.png', index)
        images.append(f'{stamp},{stamp}.png\r\n')
        world_from_body = (BODY_FROM_CAMERA * pose(index)).inverse()
        columns = [*world_from_body.translation, *quaternion_wxyz(world_from_body), *[0.0] * 9]
        truth.append(f'{stamp},{",".join(repr(float(value)) for value in columns)}\r\n')
        poses[f'{stamp}.png'] = pose(index)
    (camera / 'data.csv').write_text(''.join(images))
    (truth_folder / 'data.csv').write_text(''.join(truth))
    matrix = np.vstack([BODY_FROM_CAMERA.matrix(), [0.0, 0.0, 0.0, 1.0]])
    (camera / 'sensor.yaml').write_text(
        'sensor_type: camera\n'
        f'T_BS:\n  cols: 4\n  rows: 4\n  data: {matrix.ravel().tolist()}\n'
        f'resolution: [{CAMERA.width}, {CAMERA.height}]\n'
        'camera_model: pinhole\n'
        f'intrinsics: [{FOCAL}, {FOCAL}, 191.5, 143.5]\n'
        'distortion_model: radial-tangential\n'
        'distortion_coefficients: [-0.02, 0.003, 0.0002, 0.00002]\n'
    )
    return poses


def write_kitti(folder: Path) -> dict[str, pycolmap.Rigid3d]:
    """Sequence 07 of colour images; camera 2 is beside camera 0."""
    sequence = folder / 'sequences' / '07'
    camera2_from_camera0 = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([0.06, -0.001, 0.003]))
    matrix = np.array([[FOCAL, 0.0, 191.5], [0.0, FOCAL, 143.5], [0.0, 0.0, 1.0]])
    projection = np.column_stack([matrix, matrix @ camera2_from_camera0.translation])
    lines, poses = [], {}
    for index in range(COUNT):
        name = f'image_2/{index:06d}.png'
        write_frame(sequence / name, index)
        world_from_camera0 = pose(index).inverse() * camera2_from_camera0
        lines.append(f'{_numbers(world_from_camera0.matrix().ravel())}\n')
        poses[name] = pose(index)
    grey = np.column_stack([matrix, np.zeros(3)])
    (sequence / 'calib.txt').write_text(
        f'P0: {_numbers(grey.ravel())}\nP2: {_numbers(projection.ravel())}\nTr: 1 0 0\n'
    )
    (sequence / 'times.txt').write_text(''.join(f'{0.1 * i:e}\n' for i in range(COUNT)))
    (folder / 'poses').mkdir()
    (folder / 'poses' / '07.txt').write_text(''.join(lines))
    return poses


@dataclass(frozen=True)
class ListedQueries:
    """Images with a list of queries, whose poses only the benchmark knows.

    Attributes:
        folder: What names are relative to.
        file: The list.
        poses: camera_from_world by name.
    """

    folder: Path
    file: Path
    poses: dict[str, pycolmap.Rigid3d]


def write_aachen(folder: Path) -> ListedQueries:
    """Three images by day and one by night, of a camera with fewer pixels."""
    lines, poses = ['# queries with intrinsics\n'], {}
    for index in (1, 3, 5, 6):
        by_day = index < 6
        name = f'query/{"day/milestone" if by_day else "night/nexus5x"}/IMG_{index}.png'
        scale = 1.0 if by_day else 0.75
        write_frame(folder / name, index, scale)
        width, height = int(CAMERA.width * scale), int(CAMERA.height * scale)
        lines.append(
            f'{name} SIMPLE_RADIAL {width} {height} {FOCAL * scale} {width / 2} {height / 2} 0.0\n'
        )
        poses[name] = pose(index)
    (folder / 'queries.txt').write_text(''.join(lines))
    return ListedQueries(folder, folder / 'queries.txt', poses)


def write_robotcar(folder: Path) -> ListedQueries:
    """Two cameras of a car, whose images have the same names: their stamps."""
    lines, poses = [], {}
    for index in (2, 5):
        camera = 'rear' if index == 2 else 'left'
        name = f'night-rain/{camera}/1417176976842290.png'
        write_frame(folder / 'images' / name, index)
        lines.append(f'{name} PINHOLE {CAMERA.width} {CAMERA.height} {FOCAL} {FOCAL} 192 144')
        poses[name] = pose(index)
    # hloc leaves out the end of the last line
    (folder / 'queries.txt').write_text('\n'.join(lines))
    return ListedQueries(folder / 'images', folder / 'queries.txt', poses)


def write_hloc_results(file: Path, poses: Mapping[str, pycolmap.Rigid3d]) -> None:
    """A results.txt of hloc: base names, and all digits."""
    lines = [
        f'{name.split("/")[-1]} {_numbers(quaternion_wxyz(one))} {_numbers(one.translation)}\n'
        for name, one in poses.items()
    ]
    file.write_text(''.join(lines))


def same_poses(
    found: Mapping[str, pycolmap.Rigid3d] | None, expected: Mapping[str, pycolmap.Rigid3d]
) -> bool:
    """Names and poses agree, to 1e-9."""
    return (
        found is not None
        and set(found) == set(expected)
        and all(np.abs(found[n].matrix() - expected[n].matrix()).max() < 1e-9 for n in expected)
    )


def _numbers(values: Sequence[float] | NDArray[np.float64]) -> str:
    return ' '.join(repr(float(value)) for value in values)
