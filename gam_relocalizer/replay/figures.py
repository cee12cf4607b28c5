# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The pictures of a report, drawn with matplotlib's objects (no global state, no display)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure

from gam_relocalizer.localization.pictures import draw_matches
from gam_relocalizer.localization.result import Status
from gam_relocalizer.plots import (
    FOUND,
    LABEL_SIZE,
    OTHERS,
    POINT,
    REFERENCE,
    REFUSED,
    WIDTH,
    View,
    dots,
    finish,
    fit_axes,
    fit_figure,
    legend_below,
    thinned,
    unit_of,
)
from gam_relocalizer.replay.summary import position_between

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from gam_relocalizer.geometry import PoseError
    from gam_relocalizer.replay.drift import Trajectories
    from gam_relocalizer.replay.result import TimedIllustration
    from gam_relocalizer.replay.summary import Row
    from gam_relocalizer.scene_map import SceneMap

FIX, TRUTH = FOUND, '#111111'
ODOMETRY, CORRECTED = OTHERS[1], OTHERS[0]
STAGE_COLOURS = (FOUND, *OTHERS)

SIGMAS = 3.0

_NO_QUERY, _NOTHING_FOUND = '#777777', OTHERS[1]
_STATUS_INCHES = 0.32


def trajectory_figure(
    rows: Sequence[Row], scene_map: SceneMap, view: View, trajectories: Trajectories | None = None
) -> Figure:
    """The map with the fixes, seen in one way."""
    figure = Figure(layout='constrained')
    draw_trajectory(figure.subplots(), rows, scene_map, view, trajectories)
    fit_figure(figure)
    return figure


def draw_trajectory(
    axes: Axes,
    rows: Sequence[Row],
    scene_map: SceneMap,
    view: View,
    trajectories: Trajectories | None = None,
) -> None:
    """Map points, reference cameras, fixes with their covariances, refused attempts, the truth.

    An attempt that was refused is where the truth says, or else between the fixes around it.
    """
    points = view.of(thinned(scene_map.points))
    cameras = view.of(scene_map.camera_positions)
    truth = view.of(_true_positions(rows, trajectories))
    fixes = [row.robot_pose for row in rows if row.robot_pose is not None]
    positions = view.of(np.array([fix.map_from_base.translation for fix in fixes]))
    dots(axes, points, s=1.2, c=POINT, alpha=0.5, label='map points')
    dots(axes, cameras, s=7, c=REFERENCE, label='reference images')
    if len(truth):
        axes.plot(*truth.T, '-', color=TRUTH, linewidth=1.0, label='ground truth')
    if trajectories is not None and trajectories.corrected:
        places = np.array([pose.map_from_base.translation for pose in trajectories.corrected])
        axes.plot(
            *view.of(places).T, '-', color=CORRECTED, linewidth=1.2, label='corrected odometry'
        )
    else:
        axes.plot(*positions.T, '-', color=FIX, linewidth=0.6, alpha=0.5)
    if fixes:
        dots(axes, positions, s=12, c=FIX, zorder=4, label=f'fixes, {SIGMAS:.0f}-sigma')
        spreads = [view.axes @ fix.covariance[:3, :3] @ view.axes.T for fix in fixes]
        _draw_ellipses(axes, positions, np.array(spreads))
    refused = view.of(_refused_positions(rows))
    if len(refused):
        dots(axes, refused, s=26, c=REFUSED, marker='x', linewidths=1.2, zorder=5, label='refused')
    fit_axes(axes, points, np.concatenate([cameras, positions, truth]))
    axes.set_xlabel(view.labels[0], fontsize=LABEL_SIZE)
    axes.set_ylabel(view.labels[1], fontsize=LABEL_SIZE)
    legend_below(axes)


def _true_positions(rows: Sequence[Row], trajectories: Trajectories | None) -> NDArray[np.float64]:
    """At the rate of the odometry, if there is any."""
    truths = [row.truth for row in rows]
    if trajectories is not None and trajectories.odometry:
        truths = [pose.truth for pose in trajectories.odometry]
    return np.array([truth.translation for truth in truths if truth is not None]).reshape(-1, 3)


def _refused_positions(rows: Sequence[Row]) -> NDArray[np.float64]:
    fixes = [(row.stamp_ns, row.robot_pose.map_from_base) for row in rows if row.robot_pose]
    guesses = [
        position_between(row.stamp_ns, fixes) if row.truth is None else row.truth.translation
        for row in rows
        if row.robot_pose is None
    ]
    return np.array([guess for guess in guesses if guess is not None]).reshape(-1, 3)


def error_figure(rows: Sequence[Row], unit: str) -> Figure:
    """Errors (where the truth is known) and standard deviations over time."""
    figure = Figure(figsize=(WIDTH, 4.8), layout='constrained')
    position, orientation = figure.subplots(2, 1, sharex=True)
    draw_position_errors(position, rows, unit)
    fixes = [row for row in rows if row.robot_pose is not None]
    _draw_errors(
        orientation,
        _seconds(fixes, rows),
        [row.error.rotation_deg if row.error else np.nan for row in fixes],
        [row.orientation_std_deg or np.nan for row in fixes],
    )
    orientation.set_ylabel('orientation [deg]', fontsize=LABEL_SIZE)
    orientation.set_xlabel('time [s]', fontsize=LABEL_SIZE)
    return figure


def draw_position_errors(axes: Axes, rows: Sequence[Row], unit: str) -> None:
    """Error of the position and its standard deviation over time."""
    fixes = [row for row in rows if row.robot_pose is not None]
    factor, shown = (100.0, 'cm') if unit == 'm' else (1.0, unit)
    _draw_errors(
        axes,
        _seconds(fixes, rows),
        [factor * row.error.position if row.error else np.nan for row in fixes],
        [factor * (row.position_std or np.nan) for row in fixes],
    )
    axes.set_ylabel(f'position [{shown}]', fontsize=LABEL_SIZE)


def drift_figure(trajectories: Trajectories) -> Figure:
    """Errors of odometry, fixes and corrected odometry over time; the map is metric."""
    figure = Figure(figsize=(WIDTH, 4.8), layout='constrained')
    position, orientation = figure.subplots(2, 1, sharex=True)
    draw_drift(position, trajectories, lambda error: 100.0 * error.position)
    draw_drift(orientation, trajectories, lambda error: error.rotation_deg)
    position.set_ylabel('position error [cm]', fontsize=LABEL_SIZE)
    orientation.set_ylabel('rotation error [deg]', fontsize=LABEL_SIZE)
    orientation.set_xlabel('time [s]', fontsize=LABEL_SIZE)
    return figure


def draw_drift(axes: Axes, trajectories: Trajectories, size: Callable[[PoseError], float]) -> None:
    """Errors of odometry, fixes and corrected odometry over time, where the truth is known."""
    styles: dict[str, dict[str, Any]] = {
        'odometry': {'color': ODOMETRY, 'linewidth': 1.2},
        'fixes': {'color': FIX, 'marker': 'o', 'markersize': 3.5, 'linestyle': 'none'},
        'corrected': {'color': CORRECTED, 'linewidth': 1.2},
    }
    begin_ns = min(poses[0].stamp_ns for poses in trajectories.by_name().values() if poses)
    for name, poses in trajectories.by_name().items():
        known = [(pose.stamp_ns, pose.error) for pose in poses]
        errors = [(stamp_ns, size(error)) for stamp_ns, error in known if error is not None]
        seconds = [(stamp_ns - begin_ns) / 1e9 for stamp_ns, _ in errors]
        axes.plot(seconds, [value for _, value in errors], label=name, **styles[name])
    axes.set_ylim(bottom=0)
    _finish(axes)


def inlier_figure(rows: Sequence[Row]) -> Figure:
    """Inliers of every attempt over time."""
    figure = Figure(figsize=(WIDTH, 2.6), layout='constrained')
    draw_inliers(figure.subplots(), rows)
    return figure


def draw_inliers(axes: Axes, rows: Sequence[Row]) -> None:
    """Inliers over time; refused attempts in red."""
    for accepted, colour, label in ((True, FIX, 'accepted'), (False, REFUSED, 'refused')):
        chosen = [row for row in rows if (row.status is Status.ACCEPTED) is accepted]
        if chosen:
            inliers = [row.inliers for row in chosen]
            axes.vlines(_seconds(chosen, rows), 0, inliers, color=colour, linewidth=1.0, alpha=0.6)
            axes.scatter(_seconds(chosen, rows), inliers, s=14, color=colour, label=label)
    axes.set_ylim(bottom=0)
    axes.set_xlabel('time [s]', fontsize=LABEL_SIZE)
    axes.set_ylabel('inliers', fontsize=LABEL_SIZE)
    _finish(axes)


def timing_figure(rows: Sequence[Row]) -> Figure:
    """Milliseconds of every attempt, stage upon stage."""
    figure = Figure(figsize=(WIDTH, 3.4), layout='constrained')
    axes = figure.subplots()
    seconds = _seconds(rows, rows)
    width = 0.8 * float(np.min(np.diff(seconds))) if len(seconds) > 1 else 0.8
    floor = np.zeros(len(rows))
    stages = dict.fromkeys(stage for row in rows for stage in row.milliseconds)
    for index, stage in enumerate(stages):
        height = np.array([row.milliseconds.get(stage, 0.0) for row in rows])
        colour = STAGE_COLOURS[index % len(STAGE_COLOURS)]
        axes.bar(seconds, height, width, bottom=floor, color=colour, label=stage, linewidth=0)
        floor += height
    axes.set_xlabel('time [s]', fontsize=LABEL_SIZE)
    axes.set_ylabel('time per attempt [ms]', fontsize=LABEL_SIZE)
    finish(axes)
    legend_below(axes)
    return figure


def status_figure(rows: Sequence[Row]) -> Figure:
    """Every attempt as a mark in the line of its verdict, over time."""
    statuses = [status for status in Status if any(row.status is status for row in rows)][::-1]
    figure = Figure(figsize=(WIDTH, 0.8 + _STATUS_INCHES * len(statuses)), layout='constrained')
    axes = figure.subplots()
    names = []
    for line, status in enumerate(statuses):
        chosen = [row for row in rows if row.status is status]
        seconds, colour = _seconds(chosen, rows), status_colour(status)
        axes.scatter(seconds, np.full(len(chosen), line), s=80, c=colour, marker='|', linewidths=2)
        names.append(f'{status.name} ({len(chosen)})')
    axes.set_yticks(range(len(statuses)), names)
    axes.set_ylim(-0.6, len(statuses) - 0.4)
    axes.set_xlabel('time [s]', fontsize=LABEL_SIZE)
    finish(axes)
    for label, status in zip(axes.get_yticklabels(), statuses, strict=True):
        label.set_color(status_colour(status))
    return figure


def status_colour(status: Status) -> str:
    """One for fixes, one for each way to fail: no query, nothing found, found and not believed."""
    if status is Status.ACCEPTED:
        return FIX
    if status.value < Status.TOO_FEW_FEATURES.value:
        return _NO_QUERY
    return _NOTHING_FOUND if status.value <= Status.NO_POSE.value else REFUSED


def overview_figure(
    title: str,
    rows: Sequence[Row],
    scene_map: SceneMap,
    illustrations: Sequence[TimedIllustration],
    trajectories: Trajectories | None = None,
) -> Figure:
    """The run in one picture: the map with the trajectory, matches on an image, the errors."""
    figure = Figure(figsize=(12.0, 6.8), layout='constrained')
    figure.suptitle(title, fontsize=10.5, linespacing=1.4)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.15, 1.0), height_ratios=(2.1, 1.0))
    draw_trajectory(
        figure.add_subplot(grid[:, 0]), rows, scene_map, View.from_above(scene_map), trajectories
    )
    matches = figure.add_subplot(grid[0, 1])
    if illustrations:
        draw_matches(matches, illustrations[0].illustration, scene_map)
    else:
        matches.text(0.5, 0.5, 'no image was localized', ha='center', va='center')
        matches.set_axis_off()
    below = figure.add_subplot(grid[1, 1])
    if any(row.error for row in rows):
        draw_position_errors(below, rows, unit_of(scene_map))
        below.set_xlabel('time [s]', fontsize=LABEL_SIZE)
    else:
        draw_inliers(below, rows)
    return figure


def _draw_errors(
    axes: Axes,
    seconds: NDArray[np.float64],
    errors: Sequence[float],
    deviations: Sequence[float],
) -> None:
    """Bands of one and of three standard deviations; errors on top of them."""
    deviation = np.array(deviations)
    for sigmas, alpha in ((SIGMAS, 0.13), (1.0, 0.25)):
        axes.fill_between(
            seconds, 0, sigmas * deviation, color=FIX, alpha=alpha, linewidth=0,
            label=f'{sigmas:.0f}-sigma',
        )  # fmt: skip
    axes.plot(seconds, deviation, '.', color=FIX, markersize=3)
    if np.isfinite(errors).any():
        axes.plot(seconds, errors, 'o', color=TRUTH, markersize=3.5, label='error')
    axes.set_ylim(bottom=0)
    _finish(axes)


def _finish(axes: Axes) -> None:
    finish(axes)
    if axes.get_legend_handles_labels()[0]:
        axes.set_ylim(top=1.25 * axes.get_ylim()[1])  # room for the legend
        axes.legend(fontsize=LABEL_SIZE, loc='upper right', ncols=4, framealpha=0.9, borderpad=0.3)


def _draw_ellipses(
    axes: Axes, centres: NDArray[np.float64], covariances: NDArray[np.float64]
) -> None:
    variances, directions = np.linalg.eigh(covariances)
    diameters = 2.0 * SIGMAS * np.sqrt(np.maximum(variances, 0.0))
    angles = np.degrees(np.arctan2(directions[:, 1, 1], directions[:, 0, 1]))
    axes.add_collection(
        EllipseCollection(
            diameters[:, 1], diameters[:, 0], angles, units='xy', offsets=centres,
            offset_transform=axes.transData, facecolors='none', edgecolors=FIX, linewidths=0.8,
        ),
        autolim=False,
    )  # fmt: skip


def _seconds(chosen: Sequence[Row], rows: Sequence[Row]) -> NDArray[np.float64]:
    """Time since the first attempt [s]."""
    return np.array([(row.stamp_ns - rows[0].stamp_ns) / 1e9 for row in chosen])
