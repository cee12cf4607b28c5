# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Where points in front of a camera lie in its image, by its true distortion model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.cameras import MAX_TANGENT, ROUND_TRIP_PX, undistort

if TYPE_CHECKING:
    import pycolmap
    from numpy.typing import NDArray

_BORDER_SAMPLES = 33
# What is cut off lies that share of the field of view outside of the image.
_MARGIN = 0.05


def project(camera: pycolmap.Camera, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixels of points, inside the image or not.

    Args:
        camera: One of `CAMERA_MODELS`.
        points: [N,3] in the camera's frame.

    Returns:
        [N,2] pixels (COLMAP convention); NaN for points that are not in front of the camera, are
        more than 80 degrees off its axis, or whose ray is beyond where the distortion model is
        valid: it would fold them back into the image.
    """
    pixels = np.full((len(points), 2), np.nan)
    ahead = points[:, 2] > 0.0
    rays = points[ahead, :2] / points[ahead, 2:]
    rays[np.linalg.norm(rays, axis=1) >= MAX_TANGENT] = np.nan
    seen = np.isfinite(rays).all(axis=1)
    found = np.full((len(rays), 2), np.nan)
    if seen.any():
        on_plane = np.column_stack([rays[seen], np.ones(int(seen.sum()))])
        projected = np.asarray(camera.img_from_cam(on_plane), np.float64)
        back = undistort(projected, camera)
        off = np.linalg.norm(back - rays[seen], axis=1) * camera.mean_focal_length()
        # a far ray is found again with an error that grows with it
        allowed = ROUND_TRIP_PX * (1.0 + np.square(rays[seen]).sum(axis=1))
        found[seen] = np.where((off < allowed)[:, None], projected, np.nan)
    pixels[ahead] = found
    return pixels


def in_image(camera: pycolmap.Camera, pixels: NDArray[np.float64]) -> NDArray[np.bool_]:
    """[...] which pixels [...,2] lie in the image; NaN does not."""
    inside = (pixels >= 0.0) & (pixels <= (camera.width, camera.height))
    return np.asarray(inside.all(axis=-1))


@dataclass(frozen=True)
class Field:
    """A pyramid that holds all that an image shows: rays x/z, y/z between two corners.

    Attributes:
        low: [2] smallest.
        high: [2] largest.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]

    @staticmethod
    def of(camera: pycolmap.Camera) -> Field:
        """From the rays of the image's border; 80 degrees where these are not known."""
        xs = np.linspace(0.0, camera.width, _BORDER_SAMPLES)
        ys = np.linspace(0.0, camera.height, _BORDER_SAMPLES)
        border = np.concatenate(
            [np.column_stack([xs, np.full_like(xs, y)]) for y in (0.0, camera.height)]
            + [np.column_stack([np.full_like(ys, x), ys]) for x in (0.0, camera.width)]
        )
        rays = undistort(border, camera)
        if not np.isfinite(rays).all():
            return Field(np.full(2, -MAX_TANGENT), np.full(2, MAX_TANGENT))
        low, high = rays.min(axis=0), rays.max(axis=0)
        margin = _MARGIN * (high - low)
        return Field(low - margin, high + margin)

    def planes(self, near: float) -> NDArray[np.float64]:
        """[5,4] planes a x + b y + c z + d >= 0 for what is inside, and further away than `near`.

        The first is that of `near`.
        """
        (left, top), (right, bottom) = self.low, self.high
        return np.array(
            [
                [0.0, 0.0, 1.0, -near],
                [1.0, 0.0, -left, 0.0],
                [-1.0, 0.0, right, 0.0],
                [0.0, 1.0, -top, 0.0],
                [0.0, -1.0, bottom, 0.0],
            ]
        )


def clipped(polygon: NDArray[np.float64], planes: NDArray[np.float64]) -> NDArray[np.float64]:
    """The part of a convex polygon [V,3] on the inner side of all planes [P,4]; may be empty."""
    for plane in planes:
        sides = polygon @ plane[:3] + plane[3]
        if (sides >= 0.0).all():
            continue
        kept: list[NDArray[np.float64]] = []
        for index, (point, side) in enumerate(zip(polygon, sides, strict=True)):
            before, side_before = polygon[index - 1], sides[index - 1]
            if (side >= 0.0) != (side_before >= 0.0):
                share = side_before / (side_before - side)
                kept.append(before + share * (point - before))
            if side >= 0.0:
                kept.append(point)
        polygon = np.array(kept).reshape(-1, 3)
        if not len(polygon):
            break
    return polygon
