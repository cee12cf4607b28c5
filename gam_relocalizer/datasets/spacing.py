# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Fewer images of a long sequence: those between which the camera moved."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from gam_relocalizer.geometry import pose_error

if TYPE_CHECKING:
    import pycolmap

    from gam_relocalizer.image_set import ImageSet

# A third of the narrower angle of view of usual cameras; two thirds of the view stay in common.
DEFAULT_ANGLE_DEG = 15.0


def spaced(images: ImageSet, distance: float, angle_deg: float = DEFAULT_ANGLE_DEG) -> ImageSet:
    """Keeps an image when the camera moved or turned enough since the last one kept.

    Images without a pose stay among the names, where a map counts them as left out.

    Args:
        images: In the order they were taken.
        distance: Enough of a movement [unit of the poses]; a twentieth of the distance to what
            the camera looks at, see `Layout.spacing`. With 0 all are kept.
        angle_deg: Enough of a turn [deg].
    """
    poses = images.camera_from_world or {}
    kept: list[str] = []
    last: pycolmap.Rigid3d | None = None
    for name in images.names:
        pose = poses.get(name)
        if pose is not None:
            if last is not None and not _apart(last, pose, distance, angle_deg):
                continue
            last = pose
        kept.append(name)
    return replace(images, names=tuple(kept))


def _apart(
    first: pycolmap.Rigid3d, second: pycolmap.Rigid3d, distance: float, angle_deg: float
) -> bool:
    moved = pose_error(second, first)
    return moved.position >= distance or moved.rotation_deg >= angle_deg
