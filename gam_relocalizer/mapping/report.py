# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What a map build has to say about its result."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping


@dataclass(frozen=True)
class BuildReport:
    """Numbers of a finished build.

    Attributes:
        images_given: Images in the folder.
        images_registered: Images in the map.
        unregistered: Names of readable images that found no place in the map.
        unreadable: Name to reason of images that could not be read.
        without_pose: Names of images left out since the poses file does not name them.
        other_models: Sizes in images of further, separate models that were dropped.
        pairs_matched: Image pairs that were compared.
        pairs_verified: Image pairs whose matches obey one geometry.
        points: 3D points.
        observations: Observations of these points in the images.
        mean_track_length: Observations per point.
        mean_reprojection_error: Over all observations [px].
        cameras: Final intrinsics, one line each.
        seconds: Time per step.
        reused: Step to the number of images, pairs of images, and images of the model that were
            found finished in the workspace.
    """

    images_given: int
    images_registered: int
    unregistered: tuple[str, ...]
    unreadable: Mapping[str, str]
    without_pose: tuple[str, ...]
    other_models: tuple[int, ...]
    pairs_matched: int
    pairs_verified: int
    points: int
    observations: int
    mean_track_length: float
    mean_reprojection_error: float
    cameras: tuple[str, ...]
    seconds: Mapping[str, float]
    reused: Mapping[str, int] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Plain values for the manifest."""
        return asdict(self)
