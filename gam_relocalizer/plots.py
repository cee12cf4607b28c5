# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What all pictures of maps share: views, colours, and how they become files."""

from __future__ import annotations

from dataclasses import dataclass
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.collections import PathCollection

from gam_relocalizer.geometry import rotation_of

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from gam_relocalizer.scene_map import SceneMap

POINT, REFERENCE = '#8a8f98', '#c9a227'
# What was found, what was refused: blue and red can be told apart by everybody.
FOUND, REFUSED = '#0b62c4', '#d62728'
# For things that only differ: none like the two above.
OTHERS = ('#2ca089', '#f2a33a', '#b04fa8', '#777777', '#7a5230', '#8fb339', '#3f3d9e', '#111111')
# Inches: a column of a page, and on a phone still to be read.
WIDTH = 4.8
MAX_POINTS_DRAWN = 60_000
LABEL_SIZE = 10
DPI = 150
# Cameras that look up or down by turns are still held upright on average.
MAX_TILT_DEG = 30.0


@dataclass(frozen=True)
class View:
    """The map seen from above or from the side.

    Attributes:
        axes: [2,3] directions of the picture's right and top, in the map frame.
        labels: What the two axes of the picture are.
    """

    axes: NDArray[np.float64]
    labels: tuple[str, str]

    @staticmethod
    def from_above(scene_map: SceneMap) -> View:
        """Looks down the map's z axis if that is vertical, else down the cameras' own vertical.

        Cameras are held upright more or less: the mean of their upward directions tells where up
        is in a map whose frame says nothing about gravity.
        """
        unit = unit_of(scene_map)
        up = upward_direction(scene_map)
        if up is None or tilt_of(up) < MAX_TILT_DEG:
            return View(np.eye(3)[:2], (f'x [{unit}]', f'y [{unit}]'))
        sideways = np.eye(3)[np.argmin(np.abs(up))]
        right = sideways - up * (up @ sideways)
        right /= np.linalg.norm(right)
        return View(np.array([right, np.cross(up, right)]), (f'across [{unit}]', f'along [{unit}]'))

    @staticmethod
    def from_the_side(scene_map: SceneMap) -> View:
        """Looks along the top of the view from above, so that both have the same left and right."""
        above = View.from_above(scene_map)
        up = f'{"z" if above.labels[0].startswith("x") else "up"} [{unit_of(scene_map)}]'
        return View(np.array([above.axes[0], np.cross(*above.axes)]), (above.labels[0], up))

    def of(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """[N,2] of [N,3]."""
        return np.asarray(positions, dtype=float).reshape(-1, 3) @ self.axes.T


def unit_of(scene_map: SceneMap) -> str:
    """Unit of a map's lengths."""
    return 'm' if scene_map.manifest.frame.metric else 'map units'


def upward_direction(scene_map: SceneMap) -> NDArray[np.float64] | None:
    """[3] mean direction in which the tops of the reference images point, of length one."""
    downs = [rotation_of(pose).as_matrix()[1] for pose in scene_map.camera_from_map]
    up = -np.sum(downs, axis=0)
    length = float(np.linalg.norm(up))
    return None if length < 1e-6 else np.asarray(up / length, np.float64)


def tilt_of(up: NDArray[np.float64]) -> float:
    """Angle of a direction [3] of length one from the z axis [deg]."""
    return float(np.degrees(np.arccos(np.clip(up[2], -1.0, 1.0))))


def png(figure: Figure) -> bytes:
    """The picture as a PNG file."""
    stream = BytesIO()
    figure.savefig(stream, format='png', dpi=DPI, metadata={'Software': None})
    return stream.getvalue()


def write_picture(file: Path, figure: Figure) -> None:
    """Writes a PNG under a temporary name, then renames it."""
    temporary = file.with_name(f'.{file.name}.part')
    temporary.write_bytes(png(figure))
    temporary.replace(file)


def dots(axes: Axes, places: NDArray[np.float64], **style: Any) -> None:  # noqa: ANN401
    """Places [N,2] without an outline."""
    axes.scatter(places[:, 0], places[:, 1], **{'linewidths': 0, **style})


def fit_axes(axes: Axes, points: NDArray[np.float64], bodies: NDArray[np.float64]) -> None:
    """Limits that hold all bodies and nearly all points: a few points lie far out."""
    shown = bodies
    if len(points):
        shown = np.concatenate([bodies, np.quantile(points, [0.02, 0.98], axis=0)])
    if len(shown):
        low, high = shown.min(axis=0), shown.max(axis=0)
        margin = 0.06 * max(float(np.max(high - low)), 1e-3)
        axes.set_xlim(low[0] - margin, high[0] + margin)
        axes.set_ylim(low[1] - margin, high[1] + margin)
    axes.set_aspect('equal', adjustable='box')
    axes.grid(alpha=0.25, linewidth=0.6)
    axes.tick_params(labelsize=8)


def fit_figure(figure: Figure) -> None:
    """Gives a figure of one map the height that the map's shape asks for."""
    axes = figure.axes[0]
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    share = (high - low) / max(right - left, 1e-9)
    figure.set_size_inches(WIDTH, float(np.clip(0.85 * WIDTH * share, 1.2, 1.2 * WIDTH)) + 1.7)


def legend_below(axes: Axes) -> None:
    """A legend that covers nothing, its marks large enough to be seen."""
    if not axes.get_legend_handles_labels()[0]:
        return
    legend = axes.legend(
        loc='upper center', bbox_to_anchor=(0.5, 0.0), borderaxespad=4.0, ncols=2,
        fontsize=LABEL_SIZE, frameon=False, columnspacing=1.2, handletextpad=0.5,
    )  # fmt: skip
    for handle in legend.legend_handles:
        if isinstance(handle, PathCollection):
            handle.set_alpha(1.0)
            handle.set_sizes([24])


def finish(axes: Axes) -> None:
    """What all charts share."""
    axes.grid(alpha=0.3, linewidth=0.6)
    axes.tick_params(labelsize=LABEL_SIZE)
    axes.spines[['top', 'right']].set_visible(False)


def thinned(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Evenly picked points, so many as make sense in a picture."""
    return points[:: max(1, -(-len(points) // MAX_POINTS_DRAWN))]
