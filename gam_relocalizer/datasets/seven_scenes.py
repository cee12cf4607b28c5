# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""7-Scenes (Shotton et al., CVPR 2013), handheld indoor video of a Kinect.

    TrainSplit.txt, TestSplit.txt     lines `sequence1`
    seq-01/frame-000000.color.png     640 x 480
    seq-01/frame-000000.pose.txt      4x4 matrix world_from_camera [m]; not finite where lost

The frame is that of KinectFusion: near the first camera of a sequence, z forward rather than up.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np
import pycolmap

from gam_relocalizer.datasets.layout import Split
from gam_relocalizer.datasets.text import pose_of_matrix, read_lines
from gam_relocalizer.errors import DatasetError
from gam_relocalizer.image_set import ImageSet

if TYPE_CHECKING:
    from pathlib import Path

_LISTS = {Split.TRAIN: 'TrainSplit.txt', Split.TEST: 'TestSplit.txt'}
_COLOUR = '.color.png'
_FOCAL = 525.0


def read(folder: Path, split: Split) -> ImageSet:
    """Images of a split, with the nominal colour camera of a Kinect.

    The focal length of 585 px that is often copied is the depth camera's. Refine the camera.

    Raises:
        DatasetError: Files missing or malformed.
    """
    poses: dict[str, pycolmap.Rigid3d] = {}
    names: list[str] = []
    for sequence in _sequences(folder, folder / _LISTS[split]):
        files = sorted((folder / sequence).glob(f'frame-*{_COLOUR}'))
        if not files:
            msg = f'{folder / sequence}: no images frame-NNNNNN{_COLOUR} in it'
            raise DatasetError(msg)
        for file in files:
            name = f'{sequence}/{file.name}'
            names.append(name)
            pose = _read_pose(file.with_name(f'{file.name.removesuffix(_COLOUR)}.pose.txt'))
            if pose is not None:
                poses[name] = pose
    camera = pycolmap.Camera(
        model='SIMPLE_PINHOLE', width=640, height=480, params=[_FOCAL, 320.0, 240.0]
    )
    return ImageSet(folder, tuple(names), dict.fromkeys(names, camera), poses)


def _sequences(folder: Path, file: Path) -> list[str]:
    """Folders of the sequences that a split names."""
    sequences: list[str] = []
    for line in read_lines(file):
        match = re.fullmatch(r'sequence(\d{1,3})', line.words[0])
        if match is None:
            msg = f'{line.where}: expected `sequence1`, found `{line.words[0][:40]}`'
            raise DatasetError(msg)
        name = f'seq-{int(match[1]):02d}'
        if not (folder / name).is_dir():
            msg = f'{line.where}: {folder / name} is missing'
            raise DatasetError(msg)
        sequences.append(name)
    if not sequences:
        msg = f'{file}: no sequences in it; expected lines `sequence1`'
        raise DatasetError(msg)
    return sequences


def _read_pose(file: Path) -> pycolmap.Rigid3d | None:
    """camera_from_world, or None where the truth was lost."""
    rows = [line.numbers(0, 4, 'four numbers') for line in read_lines(file)]
    if len(rows) != 4:
        msg = f'{file}: expected four lines of four numbers, found {len(rows)}'
        raise DatasetError(msg)
    world_from_camera = np.array(rows)
    if not np.isfinite(world_from_camera).all():
        return None
    return pose_of_matrix(world_from_camera, f'{file}:1').inverse()
