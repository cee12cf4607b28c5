# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of a map, for those who just open a file: how it lies, hangs together, and works."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from scipy.sparse import triu
from scipy.spatial.distance import cdist

from gam_relocalizer import plots
from gam_relocalizer.errors import UsageError
from gam_relocalizer.geometry import write_text
from gam_relocalizer.mapping.coverage import SHARED_POINTS, Standing
from gam_relocalizer.plots import (
    LABEL_SIZE,
    POINT,
    REFERENCE,
    View,
    dots,
    fit_axes,
    write_picture,
)
from gam_relocalizer.scene_map import load_map

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from gam_relocalizer.mapping.coverage import Coverage, LeftOut, WeakSpot
    from gam_relocalizer.mapping.report import BuildReport
    from gam_relocalizer.scene_map import SceneMap

TOP, SIDE, GRAPH = 'top.png', 'side.png', 'covisibility.png'
BUILD_REPORT = 'report.json'
_KIND = 'gam_relocalizer map build'

# Blue and red can be told apart by everybody.
COLOURS = {
    Standing.FOUND: '#0b62c4',
    Standing.WEAK: '#e08a00',
    Standing.REFUSED: '#d62728',
    Standing.WRONG: '#8c1fa8',
}
MARKERS = {Standing.FOUND: 'o', Standing.WEAK: '^', Standing.REFUSED: 'X', Standing.WRONG: 'D'}
_HEAT = 'RdYlBu'
# The pale end of the colours cannot be seen as a line.
_EDGES = ListedColormap(colormaps['Blues'](np.linspace(0.35, 1.0, 128)))
# As many inliers as leave nothing to be wished for.
_PLENTY = 100
_CELLS = 90
_MOST_EDGES = 20_000
# How far an image speaks for its surroundings: as far as the next ones are, and in a sparse map no
# further than this share of the picture.
_WIDEST = 1.0 / 15.0
_SPOTS_LISTED = 8
_NAME_LENGTH = 28
_LINE_INCHES = 0.2


def write_build_report(map_path: Path, report: BuildReport, folder: Path) -> None:
    """Writes pictures of a map and the numbers of its build into a folder beside it.

    Raises:
        MapError: The map cannot be read.
        UsageError: The folder holds something else than such a report.
    """
    _check_folder(folder)
    scene_map = load_map(map_path)
    folder.mkdir(parents=True, exist_ok=True)
    content = {'kind': _KIND, 'map_id': scene_map.manifest.map_id, **report.as_dict()}
    write_text(folder / BUILD_REPORT, json.dumps(content, indent=2) + '\n')
    write_picture(folder / TOP, top_figure(scene_map))
    write_picture(folder / SIDE, side_figure(scene_map))
    write_picture(folder / GRAPH, covisibility_figure(scene_map))


def top_figure(scene_map: SceneMap) -> Figure:
    """From above: points coloured by height, and cameras with the way they look."""
    return _view_figure(scene_map, View.from_above(scene_map), 'height')


def side_figure(scene_map: SceneMap) -> Figure:
    """From the side: points coloured by nearness, and cameras with the way they look."""
    return _view_figure(scene_map, View.from_the_side(scene_map), 'nearness to the viewer')


def _view_figure(scene_map: SceneMap, view: View, depth_name: str) -> Figure:
    figure, axes = _figure(f'{scene_map.path.resolve().name}: {_counts(scene_map)}')
    in_map = scene_map.some_points(plots.MAX_POINTS_DRAWN)
    points, depth = view.of(in_map), in_map @ np.cross(*view.axes)
    order = np.argsort(depth)
    low, high = np.quantile(depth, [0.02, 0.98]) if len(depth) else (0.0, 1.0)
    norm = Normalize(low, max(high, low + 1e-9))
    dots(axes, points[order], s=1.5, c=depth[order], cmap='viridis', norm=norm, alpha=0.7)
    _arrows(axes, view, scene_map, REFERENCE)
    cameras = view.of(scene_map.camera_positions)
    dots(axes, cameras, s=9, c=REFERENCE, label='reference images, and the way they look')
    fit_axes(axes, points, cameras)
    _label(axes, view)
    bar = figure.colorbar(ScalarMappable(norm, 'viridis'), ax=axes, shrink=0.7, pad=0.02)
    bar.set_label(f'{depth_name} [{plots.unit_of(scene_map)}]', fontsize=LABEL_SIZE)
    bar.ax.tick_params(labelsize=8)
    axes.legend(loc='upper right', fontsize=8, framealpha=0.9)
    return figure


def covisibility_figure(scene_map: SceneMap) -> Figure:
    """From above: how many points each image sees, and how many any two share."""
    view = View.from_above(scene_map)
    figure, axes = _figure(
        f'{scene_map.path.resolve().name}: images that share at least {SHARED_POINTS} points'
    )
    points = view.of(scene_map.some_points(plots.MAX_POINTS_DRAWN))
    cameras = view.of(scene_map.camera_positions)
    dots(axes, points, s=1.0, c=POINT, alpha=0.25)
    shared = triu(scene_map.covisibility, k=1).tocoo()
    strong = shared.data >= SHARED_POINTS
    order = np.flatnonzero(strong)[np.argsort(shared.data[strong], kind='stable')][-_MOST_EDGES:]
    norm = Normalize(0.0, float(np.quantile(shared.data[strong], 0.95)) if strong.any() else 1.0)
    segments = np.stack([cameras[shared.row[order]], cameras[shared.col[order]]], axis=1)
    edges = LineCollection(list(segments), array=shared.data[order], cmap=_EDGES, norm=norm)
    edges.set(linewidths=0.7, alpha=0.8, zorder=2)
    axes.add_collection(edges, autolim=False)
    seen = scene_map.num_points_seen
    nodes = axes.scatter(
        cameras[:, 0], cameras[:, 1], s=26, c=seen, cmap='plasma', vmin=0, edgecolors='white',
        linewidths=0.4, zorder=3,
    )  # fmt: skip
    fit_axes(axes, points, cameras)
    _label(axes, view)
    for mappable, text in ((nodes, 'points that an image sees'), (edges, 'points that two share')):
        bar = figure.colorbar(mappable, ax=axes, shrink=0.7, pad=0.02)
        bar.set_label(text, fontsize=LABEL_SIZE)
        bar.ax.tick_params(labelsize=8)
    return figure


def coverage_figure(scene_map: SceneMap, coverage: Coverage) -> Figure:
    """From above: where the map works and how well; weak spots are numbered and listed."""
    view = View.from_above(scene_map)
    lines = _listed(coverage)
    below = _LINE_INCHES * (len(lines) + 2)
    figure = Figure(figsize=(9.6, 7.2 + below), layout='constrained')
    axes, text = figure.subplots(2, 1, height_ratios=(7.2, below))
    axes.set_title(_headline(scene_map, coverage), fontsize=10.5, loc='left')
    points = view.of(scene_map.some_points(plots.MAX_POINTS_DRAWN))
    cameras = view.of(scene_map.camera_positions)
    dots(axes, points, s=1.2, c=POINT, alpha=0.45, zorder=1)
    fit_axes(axes, points, cameras)
    heat = _draw_heat(axes, view, coverage)
    for standing, colour in COLOURS.items():
        chosen = [one for one in coverage.images if one.standing is standing]
        if chosen:
            _draw_images(axes, view, chosen, colour, MARKERS[standing])
    spots = coverage.weak_spots[:_SPOTS_LISTED]
    _number(axes, [view.of(np.array(spot.position))[0] for spot in spots])
    _label(axes, view)
    bar = figure.colorbar(heat, ax=axes, shrink=0.6, pad=0.02, ticks=[0.0, 0.5, 1.0])
    bar.ax.set_yticklabels(['not found', f'{_PLENTY // 2} inliers', f'{_PLENTY} and more'])
    bar.ax.tick_params(labelsize=8)
    text.set_axis_off()
    handles, labels = axes.get_legend_handles_labels()
    text.legend(handles, labels, loc='upper left', ncols=4, fontsize=8, frameon=False)
    text.text(
        0.0, 1.0 - 1.6 * _LINE_INCHES / below, '\n'.join(lines), fontsize=8, va='top',
        linespacing=1.6, transform=text.transAxes,
    )  # fmt: skip
    return figure


def _headline(scene_map: SceneMap, coverage: Coverage) -> str:
    tolerance = coverage.tolerance
    return (
        f'{scene_map.path.resolve().name}: {coverage.recall:.1%} of {len(coverage.images)} images '
        f'found without themselves, within {tolerance.position:.2g} {coverage.unit} and '
        f'{tolerance.rotation_deg:g}°'
    )


def _draw_heat(axes: Axes, view: View, coverage: Coverage) -> ScalarMappable:
    """Colours the surroundings of images by how well these were found."""
    left, right, bottom, top = (*axes.get_xlim(), *axes.get_ylim())
    size = max(right - left, top - bottom)
    columns, rows = (max(2, round(_CELLS * side / size)) for side in (right - left, top - bottom))
    x = left + (np.arange(columns) + 0.5) * (right - left) / columns
    y = bottom + (np.arange(rows) + 0.5) * (top - bottom) / rows
    places = view.of(np.array([one.position for one in coverage.images]))
    scores = np.array([_score(one) for one in coverage.images])
    known = [one.nearest for one in coverage.images if one.nearest is not None]
    width = min(max(float(np.median(known or [0.0])), size / 40.0), _WIDEST * size)
    mean, nearness = np.zeros((rows, columns)), np.zeros((rows, columns))
    for row, height in enumerate(y):  # all cells at once take much memory with many images
        weights = np.exp(
            -0.5 * cdist(np.c_[x, np.full(columns, height)], places, 'sqeuclidean') / width**2
        )
        mean[row] = weights @ scores / np.maximum(weights.sum(axis=1), 1e-12)
        nearness[row] = weights.max(axis=1)
    mappable = ScalarMappable(Normalize(0.0, 1.0), _HEAT)
    colours = mappable.to_rgba(mean)
    colours[:, :, 3] = 0.6 * np.clip(1.3 * nearness, 0.0, 1.0)
    axes.imshow(
        colours, origin='lower', extent=(left, right, bottom, top), interpolation='bilinear',
        zorder=0, aspect='equal',
    )  # fmt: skip
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)
    return mappable


def _score(one: LeftOut) -> float:
    """How well an image was found, 0 to 1."""
    found = one.standing in {Standing.FOUND, Standing.WEAK}
    return min(one.inliers / _PLENTY, 1.0) if found else 0.0


def _draw_images(axes: Axes, view: View, images: list[LeftOut], colour: str, marker: str) -> None:
    places = view.of(np.array([one.position for one in images]))
    ahead = view.of(np.array([one.direction for one in images]))
    _quiver(axes, places, ahead, colour)
    dots(
        axes, places, s=26, c=colour, marker=marker, zorder=4, linewidths=0.4, edgecolors='white',
        label=f'{images[0].standing.value}: {len(images)}',
    )  # fmt: skip


def _number(axes: Axes, places: list[NDArray[np.float64]]) -> None:
    """Numbers beside places, moved apart where they would lie upon each other."""
    if not places:
        return
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    gap = 0.045 * max(right - left, top - bottom)
    taken: list[NDArray[np.float64]] = []
    for number, place in enumerate(places, start=1):
        turns = np.arange(0.0, 6.0 * np.pi, np.pi / 6.0)
        around = place + gap * np.stack([np.cos(turns + 0.8), np.sin(turns + 0.8)], axis=1) * (
            1.2 + turns / (2.0 * np.pi)
        ).reshape(-1, 1)
        inside = ((around > [left + gap, bottom + gap]) & (around < [right - gap, top - gap])).all(
            axis=1
        )
        free = np.array(
            [all(np.linalg.norm(one - other) > gap for other in taken) for one in around]
        )
        chosen = around[int(np.argmax(inside & free))]
        taken.append(chosen)
        axes.annotate(
            str(number), xy=tuple(place), xytext=tuple(chosen), fontsize=10, fontweight='bold',
            ha='center', va='center', zorder=6,
            bbox={'boxstyle': 'circle,pad=0.2', 'fc': 'white', 'ec': '#111111', 'lw': 1.0},
            arrowprops={'arrowstyle': '-', 'color': '#111111', 'lw': 1.0},
        )  # fmt: skip


def _listed(coverage: Coverage) -> list[str]:
    """The weak spots, a line each."""
    spots = coverage.weak_spots
    lines = [_spot_line(number, spot, coverage.unit) for number, spot in enumerate(spots, start=1)]
    more = len(lines) - _SPOTS_LISTED
    return lines[:_SPOTS_LISTED] + ([f'and {more} more'] if more > 0 else [])


def _spot_line(number: int, spot: WeakSpot, unit: str) -> str:
    name = spot.around
    if len(name) > _NAME_LENGTH:
        name = f'...{name[3 - _NAME_LENGTH :]}'
    images = f'{len(spot.images)} images around' if len(spot.images) > 1 else 'image'
    nearest = '' if spot.nearest is None else f', next image {spot.nearest:.2g} {unit} away'
    return f'{number}: {images} {name}: {spot.standing.value}{nearest}'


def _figure(title: str) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(8.4, 6.4), layout='constrained')
    axes = figure.subplots()
    axes.set_title(title, fontsize=10.5, loc='left')
    return figure, axes


def _counts(scene_map: SceneMap) -> str:
    return f'{scene_map.num_images} images, {scene_map.num_points} points'


def _arrows(axes: Axes, view: View, scene_map: SceneMap, colour: str) -> None:
    directions = np.array([pose.rotation.matrix()[2] for pose in scene_map.camera_from_map])
    _quiver(axes, view.of(scene_map.camera_positions), view.of(directions), colour)


def _quiver(
    axes: Axes, places: NDArray[np.float64], ahead: NDArray[np.float64], colour: str
) -> None:
    """Short arrows of the same length whatever the scale of the map."""
    axes.quiver(
        *places.T, *ahead.T, angles='xy', scale=32.0, scale_units='width', width=0.0022,
        headwidth=4.0, headlength=5.0, color=colour, zorder=3,
    )  # fmt: skip


def _label(axes: Axes, view: View) -> None:
    axes.set_xlabel(view.labels[0], fontsize=LABEL_SIZE)
    axes.set_ylabel(view.labels[1], fontsize=LABEL_SIZE)


def _check_folder(folder: Path) -> None:
    """Refuses a folder that somebody else filled."""
    try:
        content = json.loads((folder / BUILD_REPORT).read_text(encoding='utf-8'))
    except (OSError, ValueError):
        content = None
    ours = isinstance(content, dict) and content.get('kind') == _KIND
    if ours or not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return
    msg = (
        f'{folder}: exists and is not the report of a build, so none was written; the map itself '
        f'is complete'
    )
    raise UsageError(msg)
