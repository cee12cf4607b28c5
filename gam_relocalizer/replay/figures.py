# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The pictures of a report, drawn with matplotlib's objects (no global state, no display)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.collections import EllipseCollection, PathCollection
from matplotlib.figure import Figure

from gam_relocalizer.localization.result import Status
from gam_relocalizer.plots import (
    LABEL_SIZE,
    POINT,
    REFERENCE,
    View,
    dots,
    fit_axes,
    thinned,
    unit_of,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from gam_relocalizer.geometry import PoseError
    from gam_relocalizer.replay.drift import Trajectories
    from gam_relocalizer.replay.result import Illustration
    from gam_relocalizer.replay.summary import Row
    from gam_relocalizer.scene_map import SceneMap

FIX, TRUTH, REFUSED, INLIER, REPROJECTED = '#0b62c4', '#111111', '#d62728', '#2bd34a', '#ff9d00'
ODOMETRY, CORRECTED = '#f2a33a', '#2ca089'
STAGE_COLOURS = ('#0b62c4', '#2ca089', '#f2a33a', '#b04fa8', '#777777')

SIGMAS = 3.0


def trajectory_figure(rows: Sequence[Row], scene_map: SceneMap) -> Figure:
    """The map from above with the fixes."""
    figure = Figure(figsize=(6.4, 6.0), layout='constrained')
    draw_trajectory(figure.subplots(), rows, scene_map)
    return figure


def draw_trajectory(axes: Axes, rows: Sequence[Row], scene_map: SceneMap) -> None:
    """Map points, reference cameras, fixes with their covariances, and the truth, from above."""
    view = View.from_above(scene_map)
    points = view.of(thinned(scene_map.points))
    cameras = view.of(np.array([pose.tgt_origin_in_src() for pose in scene_map.camera_from_map]))
    fixes = [row.robot_pose for row in rows if row.robot_pose is not None]
    positions = view.of(np.array([fix.map_from_base.translation for fix in fixes]))
    truth = view.of(np.array([row.truth.translation for row in rows if row.truth is not None]))
    dots(axes, points, s=1.2, c=POINT, alpha=0.5, label='map points')
    dots(axes, cameras, s=7, c=REFERENCE, label='reference images')
    if len(truth):
        axes.plot(*truth.T, '-', color=TRUTH, linewidth=1.0, label='ground truth')
    axes.plot(*positions.T, '-', color=FIX, linewidth=0.6, alpha=0.5)
    dots(axes, positions, s=12, c=FIX, zorder=4, label=f'fixes, {SIGMAS:.0f}-sigma')
    if fixes:
        spreads = [view.axes @ fix.covariance[:3, :3] @ view.axes.T for fix in fixes]
        _draw_ellipses(axes, positions, np.array(spreads))
    refused = [row.truth for row in rows if row.robot_pose is None and row.truth is not None]
    if refused:
        where = view.of(np.array([truth.translation for truth in refused]))
        dots(
            axes, where, s=26, c=REFUSED, marker='x', linewidths=1.2, zorder=4,
            label='refused (at the truth)',
        )  # fmt: skip
    fit_axes(axes, points, np.concatenate([cameras, positions, truth]))
    axes.set_xlabel(view.labels[0], fontsize=LABEL_SIZE)
    axes.set_ylabel(view.labels[1], fontsize=LABEL_SIZE)
    legend = axes.legend(loc='upper right', fontsize=8, framealpha=0.9, borderpad=0.5)
    for handle in legend.legend_handles:
        if isinstance(handle, PathCollection):
            handle.set_alpha(1.0)
            handle.set_sizes([24])


def error_figure(rows: Sequence[Row], unit: str) -> Figure:
    """Errors (where the truth is known) and standard deviations over time."""
    figure = Figure(figsize=(6.4, 4.8), layout='constrained')
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
    figure = Figure(figsize=(6.4, 4.8), layout='constrained')
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
    figure = Figure(figsize=(6.4, 2.8), layout='constrained')
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
    figure = Figure(figsize=(6.4, 2.8), layout='constrained')
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
    _finish(axes)
    return figure


def match_figure(illustration: Illustration, scene_map: SceneMap) -> Figure:
    """An image with the inliers of its pose."""
    camera = illustration.camera
    figure = Figure(figsize=(6.4, 6.4 * camera.height / camera.width + 0.35), layout='constrained')
    draw_matches(figure.subplots(), illustration, scene_map)
    return figure


def draw_matches(axes: Axes, illustration: Illustration, scene_map: SceneMap) -> None:
    """Inlier keypoints, each tied to the place where the pose puts its map point."""
    image, camera, estimate = illustration.image, illustration.camera, illustration.estimate
    height, width = image.shape[:2]
    # the extent puts pixel centres at +0.5, where COLMAP has them
    axes.imshow(image, cmap='gray', vmin=0, vmax=255, extent=(0, width, height, 0))
    keypoints = np.asarray(estimate.inlier_keypoints, dtype=float)
    in_camera = np.array(
        [
            estimate.camera_from_map * point
            for point in scene_map.positions_of(estimate.inlier_points)
        ]
    ).reshape(-1, 3)
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
    axes.legend(loc='lower left', fontsize=8, framealpha=0.85, ncols=2, borderpad=0.4)


def overview_figure(
    title: str,
    rows: Sequence[Row],
    scene_map: SceneMap,
    illustrations: Sequence[Illustration],
) -> Figure:
    """The run in one picture: the map with the trajectory, matches on an image, the errors."""
    figure = Figure(figsize=(12.0, 6.6), layout='constrained')
    figure.suptitle(title, fontsize=10.5, linespacing=1.4)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.15, 1.0), height_ratios=(2.1, 1.0))
    draw_trajectory(figure.add_subplot(grid[:, 0]), rows, scene_map)
    matches = figure.add_subplot(grid[0, 1])
    if illustrations:
        draw_matches(matches, illustrations[0], scene_map)
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
    axes.fill_between(seconds, 0, deviations, color=FIX, alpha=0.15, linewidth=0)
    axes.plot(seconds, deviations, '-', color=FIX, linewidth=1.0, alpha=0.7, label='1-sigma')
    if np.isfinite(errors).any():
        axes.plot(seconds, errors, 'o', color=TRUTH, markersize=3.5, label='error')
    axes.set_ylim(bottom=0)
    _finish(axes)


def _finish(axes: Axes) -> None:
    axes.grid(alpha=0.3, linewidth=0.6)
    axes.tick_params(labelsize=8)
    axes.spines[['top', 'right']].set_visible(False)
    if axes.get_legend_handles_labels()[0]:
        axes.set_ylim(top=1.2 * axes.get_ylim()[1])  # room for the legend
        axes.legend(fontsize=8, loc='upper right', ncols=4, framealpha=0.9)


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
