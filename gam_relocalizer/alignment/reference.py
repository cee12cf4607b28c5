# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""A map in its SfM frame: what an alignment starts from, however often the map was aligned."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from gam_relocalizer.errors import AlignmentError, UsageError
from gam_relocalizer.scene_map import SFM, SceneMap, load_map, verify_files

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

_EXAMPLES = 3
_Given = TypeVar('_Given')


@dataclass(frozen=True)
class Reference:
    """The reference images and points of a map, SfM frame.

    Attributes:
        scene_map: The map as it lies at present.
        names: I reference images.
        camera_from_sfm: I poses.
    """

    scene_map: SceneMap
    names: tuple[str, ...]
    camera_from_sfm: tuple[pycolmap.Rigid3d, ...]

    @cached_property
    def positions(self) -> NDArray[np.float64]:
        """[I,3] where the images were taken."""
        return np.array([pose.tgt_origin_in_src() for pose in self.camera_from_sfm])

    @cached_property
    def sfm_from_camera(self) -> Rotation:
        """I orientations of the cameras."""
        quaternions = [np.asarray(pose.rotation.quat) for pose in self.camera_from_sfm]
        return Rotation.from_quat(np.array(quaternions)).inv()

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """[N,3] all points."""
        points = self.scene_map.points
        sfm_from_map = self.scene_map.manifest.frame.map_from_sfm.inverse()
        return np.asarray(sfm_from_map * points, np.float64) if len(points) else points

    @cached_property
    def model(self) -> pycolmap.Reconstruction:
        """The COLMAP model beside the arrays.

        Raises:
            AlignmentError: The map was made, or copied, without it.
            MapError: It is damaged.
        """
        folder = self.scene_map.path / SFM
        if not folder.is_dir():
            msg = (
                f'{self.scene_map.path}: has no {SFM}/ folder, which says where images see points '
                f'and by what cameras they were taken; use the map as it was built, or align it by '
                f'--poses or --positions'
            )
            raise AlignmentError(msg)
        manifest = self.scene_map.manifest
        names = (name for name in manifest.files if name.startswith(f'{SFM}/'))
        verify_files(self.scene_map.path, manifest, names)
        return pycolmap.Reconstruction(folder)


def read_reference(path: Path) -> Reference:
    """Loads a map and takes it back to its SfM frame.

    Raises:
        MapError: As `load_map`.
    """
    scene_map = load_map(path)
    sfm_from_map = scene_map.manifest.frame.map_from_sfm.inverse()
    poses = tuple(sfm_from_map.transform_camera_world(pose) for pose in scene_map.camera_from_map)
    return Reference(scene_map, scene_map.image_names, poses)


def rows_of(
    reference: Reference, given: Mapping[str, _Given], least: int
) -> tuple[list[int], list[_Given], tuple[str, ...]]:
    """What is given for reference images, in their order.

    Returns:
        Indices of the images, what is given for them, and the names that are no reference images.

    Raises:
        UsageError: Fewer than `least` names are reference images.
    """
    rows = [row for row, name in enumerate(reference.names) if name in given]
    unknown = tuple(sorted(set(given).difference(reference.names)))
    if len(rows) < least:
        msg = (
            f'{len(rows)} of {len(given)} given names are reference images of the map, '
            f'{least} are needed at least; given are {examples(list(given))}, the map has '
            f'{examples(reference.names)}'
        )
        raise UsageError(msg)
    return rows, [given[reference.names[row]] for row in rows], unknown


def examples(names: Sequence[str]) -> str:
    """The first few names."""
    shown = ', '.join(f'`{name}`' for name in names[:_EXAMPLES]) or 'none'
    return shown if len(names) <= _EXAMPLES else f'{shown}, ... ({len(names)})'
