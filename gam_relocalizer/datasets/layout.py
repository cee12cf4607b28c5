# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The layouts that are known, and how a folder tells which one it has."""

from __future__ import annotations

from enum import Enum
from typing import TYPE_CHECKING

from gam_relocalizer.errors import DatasetError, UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


class Layout(str, Enum):
    """How a dataset lies on disk."""

    CAMBRIDGE = 'cambridge'
    SEVEN_SCENES = '7scenes'
    TUM = 'tum'
    EUROC = 'euroc'
    KITTI = 'kitti'

    @property
    def has_test_split(self) -> bool:
        """Whether the layout names images to test with."""
        return self in {Layout.CAMBRIDGE, Layout.SEVEN_SCENES}

    @property
    def camera_is_nominal(self) -> bool:
        """Whether its camera is nobody's calibration, but a start for one."""
        return self is Layout.SEVEN_SCENES

    @property
    def spacing(self) -> float:
        """Metres between images that are worth mapping: some twentieth of what they look at."""
        return _SPACING[self]


class Split(str, Enum):
    """Which images of a dataset: those to map, or those to test with."""

    TRAIN = 'train'
    TEST = 'test'


_SPACING = {
    Layout.CAMBRIDGE: 0.5,
    Layout.SEVEN_SCENES: 0.1,
    Layout.TUM: 0.1,
    Layout.EUROC: 0.2,
    Layout.KITTI: 1.0,
}
# Of each layout, the sets of files and folders that give it away.
_SIGNS = {
    Layout.CAMBRIDGE: (('dataset_train.txt',),),
    Layout.SEVEN_SCENES: (('TrainSplit.txt',), ('TestSplit.txt',)),
    Layout.TUM: (('rgb.txt', 'groundtruth.txt'),),
    Layout.EUROC: (('mav0/cam0/data.csv',), ('cam0/data.csv',)),
    Layout.KITTI: (('calib.txt', 'times.txt'), ('sequences', 'poses')),
}


def detect_layout(folder: Path) -> Layout | None:
    """The one layout that a folder has the files of; None when there is none or several."""
    found = _layouts_of(folder)
    return found[0] if len(found) == 1 else None


def layout_of(folder: Path, split: Split, given: Layout | None) -> Layout:
    """The layout to read a folder by.

    Raises:
        UsageError: The layout has no such split.
        DatasetError: No such folder, or it is not clear which layout it has.
    """
    if not folder.is_dir():
        msg = f'{folder}: no such folder'
        raise DatasetError(msg)
    layout = given or _only(_layouts_of(folder), folder)
    if split is Split.TEST and not layout.has_test_split:
        msg = f'{folder}: {layout.value} has no test images; its one sequence is read as train'
        raise UsageError(msg)
    return layout


def _layouts_of(folder: Path) -> list[Layout]:
    return [
        layout
        for layout, alternatives in _SIGNS.items()
        if any(all((folder / name).exists() for name in names) for names in alternatives)
    ]


def _only(found: Sequence[Layout], folder: Path) -> Layout:
    if len(found) == 1:
        return found[0]
    if found:
        names = ', '.join(layout.value for layout in found)
        msg = f'{folder}: could be {names}; say which with --layout'
        raise DatasetError(msg)
    looked_for = '; '.join(
        f'{layout.value}: {" or ".join(" and ".join(names) for names in alternatives)}'
        for layout, alternatives in _SIGNS.items()
    )
    msg = f'{folder}: none of the known datasets; looked for {looked_for}'
    raise DatasetError(msg)
