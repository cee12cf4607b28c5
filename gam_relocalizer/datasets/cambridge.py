# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Cambridge Landmarks (Kendall et al., ICCV 2015).

    dataset_train.txt, dataset_test.txt   three lines of header, then `name X Y Z W P Q R`: the
                                          camera's position, and the rotation camera_from_world
    reconstruction.nvm                    VisualSFM's model, with a focal length per image
    seq1/frame00001.png ...               the model calls them .jpg

The frame is that of VisualSFM, laid to metres by its authors; nothing says which way is up.
"""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import TYPE_CHECKING

import pycolmap

from gam_relocalizer.datasets.layout import Split
from gam_relocalizer.datasets.text import pose_of_quaternion, read_lines
from gam_relocalizer.errors import DatasetError, ImageError
from gam_relocalizer.image_set import ImageSet
from gam_relocalizer.images import read_image

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

_LISTS = {Split.TRAIN: 'dataset_train.txt', Split.TEST: 'dataset_test.txt'}
_HEADER_LINES = 3
_MODEL = 'reconstruction.nvm'
_COLUMNS = 'name X Y Z W P Q R'
_MODEL_COLUMNS = 'name focal qw qx qy qz x y z radial 0'


def read(folder: Path, split: Split) -> ImageSet:
    """Images of a split; without the NVM model their cameras are unknown.

    Raises:
        DatasetError: Files missing or malformed.
    """
    poses = _read_poses(folder / _LISTS[split])
    names = tuple(sorted(poses))
    cameras = _read_cameras(folder, names) if (folder / _MODEL).is_file() else {}
    return ImageSet(folder, names, cameras, poses)


def _read_poses(file: Path) -> dict[str, pycolmap.Rigid3d]:
    poses: dict[str, pycolmap.Rigid3d] = {}
    for line in read_lines(file, header=_HEADER_LINES):
        numbers = line.numbers(1, 7, _COLUMNS)
        position = numbers[:3]
        rotation = pose_of_quaternion(numbers[3:], position, line.where).rotation
        name = line.file_name(0)
        if name in poses:
            msg = f'{line.where}: image `{name}` has a second pose'
            raise DatasetError(msg)
        poses[name] = pycolmap.Rigid3d(rotation=rotation, translation=rotation * -position)
    if not poses:
        msg = f'{file}: no poses in it; expected three lines of header, then `{_COLUMNS}`'
        raise DatasetError(msg)
    return poses


def _read_cameras(folder: Path, names: Iterable[str]) -> dict[str, pycolmap.Camera]:
    """Cameras of those of the images that the model knows."""
    lenses = _read_lenses(folder / _MODEL)
    sizes: dict[PurePosixPath, tuple[int, int]] = {}
    cameras: dict[str, pycolmap.Camera] = {}
    for name in names:
        lens = lenses.get(_stem(name))
        sequence = PurePosixPath(name).parent
        if lens is None or not (folder / name).is_file():
            continue
        # a sequence is one video, so its first image tells the size of all
        if sequence not in sizes:
            sizes[sequence] = _size_of(folder / name)
        cameras[name] = _camera(*lens, *sizes[sequence])
    return cameras


def _read_lenses(file: Path) -> Mapping[str, tuple[float, float]]:
    """Focal length [px] and radial term by image, of the first model in the file."""
    lines = read_lines(file)
    header, count_line = next(lines, None), next(lines, None)
    if header is None or count_line is None or not header.words[0].startswith('NVM_V3'):
        msg = f'{file}: expected `NVM_V3` and the number of cameras'
        raise DatasetError(msg)
    lenses: dict[str, tuple[float, float]] = {}
    for _ in range(int(count_line.numbers(0, 1, 'number of cameras')[0])):
        line = next(lines, None)
        if line is None:
            msg = f'{file}: ends after {len(lenses)} cameras, {count_line.words[0]} are announced'
            raise DatasetError(msg)
        numbers = line.numbers(1, 10, _MODEL_COLUMNS)
        focal, radial = float(numbers[0]), float(numbers[8])
        if not (0.0 < focal < float('inf') and abs(radial) < 1e3):
            msg = f'{line.where}: focal length {focal} and radial term {radial} are impossible'
            raise DatasetError(msg)
        lenses[_stem(line.words[0])] = (focal, radial)
    return lenses


def _stem(name: str) -> str:
    return str(PurePosixPath(name).with_suffix(''))


def _size_of(path: Path) -> tuple[int, int]:
    try:
        height, width = read_image(path).shape[:2]
    except ImageError as err:
        raise DatasetError(str(err)) from err
    return width, height


def _camera(focal: float, radial: float, width: int, height: int) -> pycolmap.Camera:
    """VisualSFM takes distortion off: undistorted = m (1 + radial |m|^2).

    COLMAP puts it on; this is the inverse up to the fifth power of the radius.
    """
    return pycolmap.Camera(
        model='RADIAL',
        width=width,
        height=height,
        params=[focal, width / 2, height / 2, 0.0 - radial, 3 * radial**2],
    )
