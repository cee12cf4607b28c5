# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The report of a run, replayed or live: one HTML file that holds all it shows."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from gam_relocalizer.geometry import write_text
from gam_relocalizer.localization.pictures import MATCHES_EXPLAINED, match_figure
from gam_relocalizer.localization.result import Status
from gam_relocalizer.pages import heading, numbers, page, paragraph, picture, table
from gam_relocalizer.plots import View, unit_of, write_picture
from gam_relocalizer.replay.figures import (
    SIGMAS,
    drift_figure,
    error_figure,
    inlier_figure,
    overview_figure,
    status_figure,
    timing_figure,
    trajectory_figure,
)
from gam_relocalizer.replay.summary import summarise

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from gam_relocalizer.replay.drift import Trajectories
    from gam_relocalizer.replay.result import TimedIllustration
    from gam_relocalizer.replay.summary import Row, Spread
    from gam_relocalizer.scene_map import SceneMap

REPORT = 'report.html'
OVERVIEW = 'overview.png'


@dataclass(frozen=True)
class Report:
    """All that a report shows.

    Attributes:
        title: Its heading.
        rows: One per attempt, in the order of their stamps.
        scene_map: The map.
        illustrations: Images whose matches are drawn, each of one of the rows; the first is on the
            overview, too.
        facts: What was run, by name: bag, map, options.
        trajectories: Odometry, fixes and corrected odometry, when there was odometry.
    """

    title: str
    rows: Sequence[Row]
    scene_map: SceneMap
    illustrations: Sequence[TimedIllustration] = ()
    facts: Mapping[str, str] = field(default_factory=dict)
    trajectories: Trajectories | None = None

    @property
    def unit(self) -> str:
        """Unit of the map."""
        return unit_of(self.scene_map)


def write_report(folder: Path, report: Report) -> None:
    """Writes `report.html` and `overview.png` into an existing folder."""
    headline = [f'{name}: {value}' for name, value in headline_numbers(report).items()]
    title = f'{report.title}\n{"   |   ".join(headline)}'
    overview = overview_figure(
        title, report.rows, report.scene_map, report.illustrations, report.trajectories
    )
    write_picture(folder / OVERVIEW, overview)
    write_text(folder / REPORT, report_html(report))


def report_html(report: Report) -> str:
    """The report as an HTML page without scripts and without anything to load."""
    parts = [numbers(headline_numbers(report))]
    if report.rows:
        parts += [
            *_map_parts(report),
            *_time_parts(report),
            *_drift_parts(report),
            *_match_parts(report),
            *_verdict_parts(report),
            *_attempt_parts(report),
        ]
    else:
        parts.append(paragraph('No image was tried: the bag has none on this topic.'))
    parts += [heading('What was run'), table(['', 'value'], list(report.facts.items()))]
    return page(report.title, parts)


def length_text(length: float, unit: str) -> str:
    """A length as people say it: centimetres below a metre."""
    if unit != 'm':
        return f'{length:.4g} {unit}'
    return f'{100.0 * length:.1f} cm' if abs(length) < 1.0 else f'{length:.2f} m'


def attempt_line(row: Row, scene_map: SceneMap) -> str:
    """One attempt in one line of a terminal."""
    parts = [f'{row.stamp_ns / 1e9:.3f} s', f'{row.inliers:4d} inliers']
    if row.robot_pose is None:
        return '  '.join([*parts, f'{row.status.name}: {row.reason}'])
    unit = unit_of(scene_map)
    x, y, z = row.robot_pose.map_from_base.translation
    parts.append(f'position {x:8.3f} {y:8.3f} {z:8.3f}')
    parts.append(f'1-sigma {length_text(row.position_std or 0.0, unit)}')
    if error := row.error:
        parts.append(f'error {length_text(error.position, unit)} {error.rotation_deg:.2f}°')
    return '  '.join([*parts, f'{row.total_milliseconds:.0f} ms'])


def headline_numbers(report: Report) -> dict[str, str]:
    """The numbers that sum up a run, by name."""
    summary = summarise(report.rows)
    share = f' ({summary.accepted / summary.attempts:.0%})' if summary.attempts else ''
    numbers = {'fixes / attempts': f'{summary.accepted} / {summary.attempts}{share}'}
    if summary.position_error and summary.rotation_error_deg:
        position, rotation = summary.position_error, summary.rotation_error_deg
        numbers['median error'] = _error_text(position.median, rotation.median, report.unit)
        numbers['largest error'] = _error_text(position.max, rotation.max, report.unit)
    if summary.total_milliseconds:
        time = summary.total_milliseconds
        numbers['time per attempt'] = f'{time.median:.0f} ms (95 %: {time.p95:.0f} ms)'
    return numbers


def _map_parts(report: Report) -> Iterator[str]:
    above, side = View.from_above(report.scene_map), View.from_the_side(report.scene_map)
    ellipses = (
        f'Ellipses: {SIGMAS:.0f} standard deviations of the fixes. Refused attempts are where the '
        f'truth says, or between the fixes before and after.'
    )
    yield heading('From above and from the side')
    for view, caption in (
        (above, f'The map and the drive. {ellipses}'),
        (side, 'The same, upright.'),
    ):
        figure = trajectory_figure(report.rows, report.scene_map, view, report.trajectories)
        yield picture(figure, caption)


def _time_parts(report: Report) -> Iterator[str]:
    yield heading('Over time')
    if any(row.robot_pose for row in report.rows):
        caption = (
            'Position and orientation of the fixes: how far off they say they may be (bands of 1 '
            'and 3 standard deviations)'
        )
        known = any(row.error for row in report.rows)
        caption += ', and how far off they are (dots).' if known else '; the truth is not known.'
        yield picture(error_figure(report.rows, report.unit), caption)
    yield picture(inlier_figure(report.rows), 'Inliers of each attempt, those of refused ones too.')
    caption = 'The verdict on each attempt; how often each came is behind its name.'
    yield picture(status_figure(report.rows), caption)
    yield picture(timing_figure(report.rows), 'Time of each attempt by stage.')


def _match_parts(report: Report) -> Iterator[str]:
    """The images, each with what became of it."""
    rows = {row.stamp_ns: row for row in report.rows}
    for index, timed in enumerate(report.illustrations):
        if index == 0:
            yield heading('Matches: a good image, the worst fixes, refused attempts')
            yield paragraph(MATCHES_EXPLAINED)
        row = rows[timed.stamp_ns]
        words = [f'{_time_text(row, report)} s', row.status.name]
        if error := row.error:
            error_text = _error_text(error.position, error.rotation_deg, report.unit)
            words.append(f'error {error_text}')
        if row.status is not Status.ACCEPTED:
            words.append(row.reason)
        yield picture(match_figure(timed.illustration, report.scene_map), ', '.join(words))


def trajectory_errors(report: Report) -> list[tuple[str, ...]]:
    """Header and rows of the table of absolute trajectory errors; empty without odometry or truth.

    Each error is one of the position and one of the rotation.
    """
    errors = {} if report.trajectories is None else report.trajectories.errors()
    rows = [
        (
            name,
            str(error.poses),
            _error_text(error.position_rmse, error.rotation_rmse_deg, report.unit),
            _error_text(error.position_median, error.rotation_median_deg, report.unit),
            _error_text(error.position_max, error.rotation_max_deg, report.unit),
        )
        for name, error in errors.items()
    ]
    return [('trajectory', 'poses', 'RMSE', 'median', 'largest'), *rows] if rows else []


def _error_text(position: float, rotation_deg: float, unit: str) -> str:
    return f'{length_text(position, unit)}, {rotation_deg:.2f}°'


def _drift_parts(report: Report) -> Iterator[str]:
    errors = trajectory_errors(report)
    if report.trajectories is None or not errors:
        return
    yield heading('Drift correction')
    caption = (
        'Errors of the odometry by itself, laid on the truth at its start; of the fixes; and of '
        'the odometry as corrected by them, each fix from the time of its image on.'
    )
    yield picture(drift_figure(report.trajectories), caption)
    yield table(errors[0], errors[1:])


def _verdict_parts(report: Report) -> Iterator[str]:
    summary = summarise(report.rows)
    yield heading('Verdicts and times')
    yield table(['verdict', 'attempts'], [(name, str(n)) for name, n in summary.statuses.items()])
    spreads = dict(summary.milliseconds)
    if summary.total_milliseconds:
        spreads['all'] = summary.total_milliseconds
    if spreads:
        yield table(
            ['stage', 'median [ms]', '95 % [ms]', 'max [ms]'],
            [(stage, *_milliseconds(spread)) for stage, spread in spreads.items()],
        )


def _milliseconds(spread: Spread) -> tuple[str, str, str]:
    return f'{spread.median:.1f}', f'{spread.p95:.1f}', f'{spread.max:.1f}'


def _attempt_parts(report: Report) -> Iterator[str]:
    yield heading('Attempts')
    header = ['time [s]', 'verdict', 'inliers', 'error', '1-sigma', 'ms', 'reason', 'stamp [s]']
    refused = [at for at, row in enumerate(report.rows) if row.status is not Status.ACCEPTED]
    yield table(header, [_cells(row, report) for row in report.rows], refused)


def _cells(row: Row, report: Report) -> tuple[str, ...]:
    error, deviation = row.error, row.position_std
    return (
        _time_text(row, report),
        row.status.name,
        str(row.inliers),
        '' if error is None else _error_text(error.position, error.rotation_deg, report.unit),
        '' if deviation is None else length_text(deviation, report.unit),
        f'{row.total_milliseconds:.0f}',
        row.reason,
        f'{row.stamp_ns / 1e9:.3f}',
    )


def _time_text(row: Row, report: Report) -> str:
    """As on the axes of the figures: since the first attempt."""
    return f'{(row.stamp_ns - report.rows[0].stamp_ns) / 1e9:.1f}'
