# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""A picture of a map over the occupancy map it was aligned to, to see whether walls coincide."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from gam_relocalizer.plots import MAX_POINTS_DRAWN, REFERENCE, dots, write_picture
from gam_relocalizer.scene_map import load_map

if TYPE_CHECKING:
    from pathlib import Path

    from gam_relocalizer.alignment.constraints import Picks
    from gam_relocalizer.scene_map import MapFrame

_WIDTH_INCHES = 10.0
# in colour: the plan is grey
_POINT, _PICK = '#2a6fdb', '#c0392b'


def draw_over_occupancy(path: Path, frame: MapFrame, picks: Picks, picture: Path) -> None:
    """Draws points and cameras of a map, laid into a frame, over the occupancy map.

    Args:
        path: The bundle.
        frame: Of the alignment; not necessarily the one that the bundle has.
        picks: What it was aligned by.
        picture: The PNG file to write.

    Raises:
        MapError: The bundle cannot be read.
    """
    scene_map = load_map(path)
    occupancy = picks.occupancy
    frame_from_map = frame.map_from_sfm * scene_map.manifest.frame.map_from_sfm.inverse()
    points, cameras = (
        occupancy.pixels_from_map(np.asarray(frame_from_map * places)[:, :2])
        for places in (scene_map.some_points(MAX_POINTS_DRAWN), scene_map.camera_positions)
    )
    height, width = occupancy.image.shape
    figure = Figure(figsize=(_WIDTH_INCHES, _WIDTH_INCHES * height / width), layout='constrained')
    axes = figure.subplots()
    extent = (0.0, float(width), float(height), 0.0)
    axes.imshow(occupancy.image, cmap='gray', vmin=0, vmax=255, extent=extent)
    dots(axes, points, s=2, c=_POINT, label='points')
    dots(axes, cameras, s=14, c=REFERENCE, label='cameras')
    given = np.array(list(picks.pixels.values()))
    axes.scatter(given[:, 0], given[:, 1], s=40, c=_PICK, marker='x', label='picks')
    axes.set(xlim=(0, width), ylim=(height, 0), xlabel='column [px]', ylabel='row [px]')
    axes.legend(loc='upper right')
    write_picture(picture, figure)
