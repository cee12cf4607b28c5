# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Lists of queries as Aachen Day-Night and RobotCar Seasons have them, and hloc reads them.

    query/day/milestone/IMG_1.jpg SIMPLE_RADIAL 1600 1200 1469.2 800 600 -0.0353

A line per image: its name below a folder, the model of its camera, its size, and the parameters of
COLMAP. Nothing says where the images were taken: that is what the benchmark keeps for itself.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from gam_relocalizer.cameras import camera_from_line
from gam_relocalizer.datasets.text import read_lines
from gam_relocalizer.errors import DatasetError
from gam_relocalizer.image_set import ImageSet

if TYPE_CHECKING:
    from pathlib import Path

    import pycolmap

MAX_QUERIES = 1_000_000
_COLUMNS = 'name MODEL WIDTH HEIGHT PARAMS...'


def read_query_list(file: Path, folder: Path) -> ImageSet:
    """The images of a list, each with its camera, without poses.

    Args:
        file: The list; names hold no spaces.
        folder: What the names are relative to.

    Raises:
        DatasetError: Missing or malformed; a name twice, or one that leads out of the folder.
        CameraError: A camera that cannot be understood; with file and line.
    """
    cameras: dict[str, pycolmap.Camera] = {}
    for line in read_lines(file):
        line.expect(5, _COLUMNS)
        name = line.file_name(0)
        if name in cameras:
            msg = f'{line.where}: image `{name}` is listed a second time'
            raise DatasetError(msg)
        if len(cameras) == MAX_QUERIES:
            msg = f'{line.where}: more than {MAX_QUERIES} images; split the list'
            raise DatasetError(msg)
        cameras[name] = camera_from_line(' '.join(line.words[1:]), line.where)
    if not cameras:
        msg = f'{file}: no images in it; expected lines `{_COLUMNS}`'
        raise DatasetError(msg)
    return ImageSet(folder, tuple(cameras), cameras, source=file.name)
