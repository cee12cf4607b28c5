# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of single queries: the matches behind a pose, drawn on the image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np
from matplotlib.figure import Figure

from gam_relocalizer.plots import LABEL_SIZE, WIDTH, dots

if TYPE_CHECKING:
    import pycolmap
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from gam_relocalizer.localization.result import PoseEstimate
    from gam_relocalizer.scene_map import SceneMap

INLIER, REPROJECTED = '#2bd34a', '#ff9d00'

MATCHES_EXPLAINED = (
    'Circles: keypoints that the pose explains; orange dots: where it puts their map points.'
)

Item = TypeVar('Item')


@dataclass(frozen=True)
class Illustration:
    """An image with the pose found for it, for a picture of its matches.

    Attributes:
        image: RGB [H,W,3] or grey [H,W].
        camera: The camera that took it.
        estimate: The pose, accepted or not, with its inliers.
    """

    image: NDArray[np.uint8]
    camera: pycolmap.Camera
    estimate: PoseEstimate


class Foremost(Generic[Item]):
    """Keeps the few items with the greatest keys and no other: images are large."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._kept: list[tuple[tuple[float, ...], Item]] = []

    def consider(self, item: Item, *key: float) -> None:
        """Keeps the item, or forgets it; of items with equal keys the earlier one stays."""
        self._kept.append((key, item))
        self._kept.sort(key=lambda one: one[0], reverse=True)
        del self._kept[self._count :]

    @property
    def items(self) -> tuple[Item, ...]:
        """The greatest key first."""
        return tuple(item for _, item in self._kept)


def match_figure(illustration: Illustration, scene_map: SceneMap) -> Figure:
    """An image with the inliers of its pose."""
    camera = illustration.camera
    figure = Figure(
        figsize=(WIDTH, WIDTH * camera.height / camera.width + 0.35), layout='constrained'
    )
    draw_matches(figure.subplots(), illustration, scene_map)
    return figure


def draw_matches(axes: Axes, illustration: Illustration, scene_map: SceneMap) -> None:
    """Inlier keypoints, each tied to the place where the pose puts its map point."""
    image, camera, estimate = illustration.image, illustration.camera, illustration.estimate
    height, width = image.shape[:2]
    # the extent puts pixel centres at +0.5, where COLMAP has them
    axes.imshow(image, cmap='gray', vmin=0, vmax=255, extent=(0, width, height, 0))
    keypoints = np.asarray(estimate.inlier_keypoints, dtype=float).reshape(-1, 2)
    in_camera = estimate.camera_from_map * scene_map.positions_of(estimate.inlier_points)
    reprojected = np.asarray(camera.img_from_cam(in_camera)).reshape(-1, 2)
    residuals = np.stack([keypoints, reprojected]).transpose(2, 0, 1)
    axes.plot(*residuals, '-', color=REPROJECTED, linewidth=0.8)
    dots(
        axes, keypoints, s=16, facecolors='none', edgecolors=INLIER, linewidths=0.9,
        label=f'{estimate.inliers} inliers',
    )  # fmt: skip
    dots(axes, reprojected, s=2.5, c=REPROJECTED, label='map points, reprojected')
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)
    axes.set_axis_off()
    axes.legend(
        loc='upper center', bbox_to_anchor=(0.5, 0.0), fontsize=LABEL_SIZE, ncols=2, frameon=False
    )
