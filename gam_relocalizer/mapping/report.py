# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What a map build has to say about its result."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from gam_relocalizer.cameras import have_known_rays

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    import pycolmap

    from gam_relocalizer.mapping.intrinsics import ImageCameras

# A calibration that is worth giving is nearer to the truth.
_MOST_REFINED = 1.3
# Between a lens that sees 100 degrees and one that sees 20; others are taken by special cameras.
_USUAL_FOCAL_PER_SIDE = (0.4, 3.0)
_MOST_WITHOUT_RAY = 0.02
_GRID = 50
_ADVICE = (
    'calibrate it and build with --camera and without --refine-camera, or add images that move '
    'sideways'
)


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
        warnings: What to look at before the map is trusted.
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
    warnings: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Plain values for the manifest."""
        return asdict(self)


def calibration_warnings(
    start: ImageCameras, refined: Mapping[int, pycolmap.Camera]
) -> tuple[str, ...]:
    """What speaks against the intrinsics that a map came out with.

    Images that turn, or move along their view, leave the focal length to chance: errors stay
    small, and every position is wrong.

    Args:
        start: What the build started from; cameras that it kept are never warned of.
        refined: By id, as the build left them.
    """
    return tuple(
        f'camera {camera.camera_id}: {found}; {_ADVICE}'
        for camera in start.cameras
        if camera.camera_id in refined
        for found in _oddities(
            camera, refined[camera.camera_id], was_given=camera.camera_id in start.given
        )
    )


def _oddities(
    start: pycolmap.Camera, refined: pycolmap.Camera, *, was_given: bool
) -> Iterator[str]:
    before, after = start.mean_focal_length(), refined.mean_focal_length()
    low, high = (share * max(refined.width, refined.height) for share in _USUAL_FOCAL_PER_SIDE)
    if was_given and not 1.0 / _MOST_REFINED <= after / before <= _MOST_REFINED:
        yield f'its focal length was given as {before:.0f} px and refined to {after:.0f} px'
    if not was_given and not low <= after <= high:
        yield (
            f'its focal length was guessed and came out as {after:.0f} px for '
            f'{refined.width} x {refined.height} pixels'
        )
    without_ray = _share_without_ray(refined)
    if without_ray > _share_without_ray(start) + _MOST_WITHOUT_RAY:
        yield f'its distortion was refined so far that it folds {without_ray:.0%} of the image'


def _share_without_ray(camera: pycolmap.Camera) -> float:
    """Of the places all over the image of a camera."""
    x, y = ((np.arange(_GRID) + 0.5) * side / _GRID for side in (camera.width, camera.height))
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return float(np.mean(~have_known_rays(places, camera)))
