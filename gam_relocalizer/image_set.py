# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Images to be mapped, and what is known of them, wherever they come from."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from gam_relocalizer.images import list_images

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    import pycolmap


@dataclass(frozen=True)
class ImageSet:
    """Images on disk that show one place.

    Attributes:
        folder: Where they are; never written to.
        names: Relative to the folder with forward slashes, in the order in which they were taken
            where that is known.
        cameras: By name of image, for those whose calibration is known. Images with equal cameras
            were taken by the same one. The camera of all others is guessed and refined.
        camera_from_world: By name of image; None when no poses are known. Images without a pose
            are left out of a map that is built with poses.
        metric: Whether one unit of the poses is a metre.
        source: Name of what they come from, for people; that of the folder when it is empty.
    """

    folder: Path
    names: tuple[str, ...]
    cameras: Mapping[str, pycolmap.Camera] = field(default_factory=dict)
    camera_from_world: Mapping[str, pycolmap.Rigid3d] | None = None
    metric: bool = True
    source: str = ''

    def __post_init__(self) -> None:
        if not self.source:
            object.__setattr__(self, 'source', self.folder.absolute().name)

    @classmethod
    def of_folder(
        cls,
        folder: Path,
        camera: pycolmap.Camera | None = None,
        camera_from_world: Mapping[str, pycolmap.Rigid3d] | None = None,
        *,
        metric: bool = True,
    ) -> ImageSet:
        """All images below a folder, taken by one camera if that is given.

        Raises:
            UsageError: No such folder, or no image in it.
        """
        names = tuple(list_images(folder))
        cameras = {} if camera is None else dict.fromkeys(names, camera)
        return cls(folder, names, cameras, camera_from_world, metric)
