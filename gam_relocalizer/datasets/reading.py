# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""One way to read them all."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gam_relocalizer.datasets import cambridge, euroc, kitti, seven_scenes, tum
from gam_relocalizer.datasets.layout import Layout, Split, layout_of
from gam_relocalizer.errors import DatasetError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from gam_relocalizer.image_set import ImageSet

_READERS: dict[Layout, Callable[[Path, Split], ImageSet]] = {
    Layout.CAMBRIDGE: cambridge.read,
    Layout.SEVEN_SCENES: seven_scenes.read,
    Layout.TUM: lambda folder, _: tum.read(folder),
    Layout.EUROC: lambda folder, _: euroc.read(folder),
    Layout.KITTI: lambda folder, _: kitti.read(folder),
}


def read_dataset(
    folder: Path, layout: Layout | None = None, split: Split = Split.TRAIN
) -> ImageSet:
    """Images, cameras and true poses of a dataset; the folder is only read.

    The poses are in the dataset's own frame, which is nowhere turned; all are in metres. Images
    without a true pose, and listed images that are not on disk, keep their place among the names:
    a map leaves them out and says so.

    Args:
        folder: As unpacked.
        layout: Found by the files in the folder when None.
        split: A layout without test images has one sequence, TRAIN.

    Raises:
        UsageError: The layout has no such split.
        DatasetError: An unknown layout, or files that are missing or malformed; with file and line.
    """
    chosen = layout_of(folder, split, layout)
    images = _READERS[chosen](folder, split)
    if not images.camera_from_world:
        msg = f'{folder}: none of the {len(images.names)} images has a true pose'
        raise DatasetError(msg)
    if not any((images.folder / name).is_file() for name in images.names):
        msg = f'{images.folder}: none of the images is there, for example `{images.names[0]}`'
        raise DatasetError(msg)
    return images
