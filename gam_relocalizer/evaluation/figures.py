# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The figures of the evaluations: errors, recall, times, and where in the map it goes wrong."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from gam_relocalizer.plots import (
    FOUND,
    LABEL_SIZE,
    OTHERS,
    POINT,
    REFUSED,
    WIDTH,
    dots,
    finish,
    fit_axes,
    fit_figure,
    legend_below,
    thinned,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from gam_relocalizer.geometry import PoseError
    from gam_relocalizer.plots import View
    from gam_relocalizer.scene_map import SceneMap

COLOURS = (FOUND, REFUSED, *OTHERS)
_BAR = 0.8
_BAR_INCHES = 0.13
# Errors beyond these ends are of no interest: nearer than a map is exact, or plainly wrong.
_POSITIONS, _ROTATIONS_DEG = (0.001, 10.0), (0.01, 100.0)


def error_curves_figure(
    errors: Mapping[str, Sequence[PoseError | None]], unit: str, whole: str
) -> Figure:
    """Share of the queries whose pose is off by at most so much, over so much.

    Args:
        errors: Of every query, by name of the method; None without a pose.
        unit: Of the positions.
        whole: The method to stand out.
    """
    figure = Figure(figsize=(WIDTH, 6.4), layout='constrained')
    position, rotation = figure.subplots(2, 1)
    for index, (name, every) in enumerate(errors.items()):
        found = [error for error in every if error is not None]
        style: dict[str, Any] = {
            'color': COLOURS[index % len(COLOURS)],
            'linewidth': 2.4 if name == whole else 1.1,
            'linestyle': '-' if index < len(COLOURS) else '--',
            'label': name,
        }
        share = 100.0 * np.arange(len(found) + 1) / max(len(every), 1)
        for axes, values in (
            (position, [error.position for error in found]),
            (rotation, [error.rotation_deg for error in found]),
        ):
            axes.step([1e-12, *sorted(values), 1e12], [*share, share[-1]], where='post', **style)
    for axes, limits, label in (
        (position, _POSITIONS, f'position within [{unit}]'),
        (rotation, _ROTATIONS_DEG, 'rotation within [deg]'),
    ):
        axes.set(xscale='log', xlim=limits, ylim=(0, 102))
        axes.set_xlabel(label, fontsize=LABEL_SIZE)
        axes.set_ylabel('queries [%]', fontsize=LABEL_SIZE)
        finish(axes)
    legend_below(rotation)
    return figure


def bars_figure(shares: Mapping[str, Mapping[str, float]], label: str) -> Figure:
    """Bars from 0 to 100 %.

    Args:
        shares: In [0, 1], by name of the row and of the bar in it.
        label: What they are shares of.
    """
    bars = list(next(iter(shares.values())))
    figure = Figure(
        figsize=(WIDTH, 1.3 + _BAR_INCHES * len(shares) * (len(bars) + 1)), layout='constrained'
    )
    axes = figure.subplots()
    for index, bar in enumerate(bars):
        lines = np.arange(len(shares)) + _BAR * ((index + 0.5) / len(bars) - 0.5)
        percent = [100.0 * row[bar] for row in shares.values()]
        colour = COLOURS[index % len(COLOURS)]
        axes.barh(lines, percent, 0.9 * _BAR / len(bars), color=colour, label=bar)
    axes.set_yticks(range(len(shares)), list(shares))
    axes.invert_yaxis()
    axes.set_xlim(0, 100)
    axes.set_xlabel(label, fontsize=LABEL_SIZE)
    finish(axes)
    legend_below(axes)
    return figure


def times_figure(milliseconds: Mapping[str, Sequence[float]]) -> Figure:
    """Median time by name of the method, and up to where 95 % of the queries lie."""
    figure = Figure(figsize=(WIDTH, 1.0 + 0.26 * len(milliseconds)), layout='constrained')
    axes = figure.subplots()
    medians, highest = (
        np.array([np.quantile(values, share) for values in milliseconds.values()])
        for share in (0.5, 0.95)
    )
    lines = np.arange(len(medians))
    axes.barh(lines, medians, 0.7, color=FOUND)
    axes.hlines(lines, medians, highest, color=OTHERS[3], linewidth=1.5)
    axes.set_yticks(lines, list(milliseconds))
    axes.invert_yaxis()
    axes.set_xlim(left=0)
    axes.set_xlabel('matching and pose [ms]', fontsize=LABEL_SIZE)
    finish(axes)
    return figure


def places_figure(
    scene_map: SceneMap,
    view: View,
    positions: NDArray[np.float64],
    errors: NDArray[np.float64],
    unit: str,
) -> Figure:
    """Where queries were taken, coloured by the error of the position.

    Args:
        scene_map: The map.
        view: How it is looked at.
        positions: [Q,3] true positions of the cameras.
        errors: [Q]; NaN where no pose was found.
        unit: Of the errors.
    """
    figure = Figure(layout='constrained')
    axes = figure.subplots()
    points, places = view.of(thinned(scene_map.points)), view.of(positions)
    dots(axes, points, s=1.2, c=POINT, alpha=0.4)
    found = np.isfinite(errors)
    norm = LogNorm(*_POSITIONS, clip=True)
    shown = np.maximum(errors[found], _POSITIONS[0])
    across, upwards = places[found].T
    drawn = axes.scatter(
        across, upwards, s=22, c=shown, cmap='turbo', norm=norm, edgecolors='white', linewidths=0.4
    )
    if not found.all():
        dots(axes, places[~found], s=30, c=REFUSED, marker='x', linewidths=1.4, label='no pose')
    fit_axes(axes, points, places)
    axes.set_xlabel(view.labels[0], fontsize=LABEL_SIZE)
    axes.set_ylabel(view.labels[1], fontsize=LABEL_SIZE)
    legend_below(axes)
    bar = figure.colorbar(drawn, ax=axes, shrink=0.8, pad=0.02)
    bar.set_label(f'error [{unit}]', fontsize=LABEL_SIZE)
    fit_figure(figure)
    return figure
