# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The report of a run, replayed or live: one HTML file that holds all it shows."""

from __future__ import annotations

import base64
from dataclasses import dataclass, field
from html import escape
from typing import TYPE_CHECKING

from gam_relocalizer.geometry import write_text
from gam_relocalizer.localization.result import Status
from gam_relocalizer.plots import png, unit_of
from gam_relocalizer.replay.figures import (
    drift_figure,
    error_figure,
    inlier_figure,
    match_figure,
    overview_figure,
    timing_figure,
    trajectory_figure,
)
from gam_relocalizer.replay.summary import summarise

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from matplotlib.figure import Figure

    from gam_relocalizer.replay.drift import Trajectories
    from gam_relocalizer.replay.result import Illustration
    from gam_relocalizer.replay.summary import Row, Spread
    from gam_relocalizer.scene_map import SceneMap

REPORT = 'report.html'
OVERVIEW = 'overview.png'

_STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 0 auto; padding: 1rem;
       color: #1c2530; }
h1 { font-size: 1.5rem; margin: 0.5rem 0; } h2 { font-size: 1.15rem; margin: 2rem 0 0.5rem; }
img { max-width: 100%; height: auto; display: block; }
figure { margin: 0.5rem 0; } figcaption { color: #55606e; font-size: 0.9rem; }
.numbers { display: flex; flex-wrap: wrap; gap: 0.6rem; padding: 0; list-style: none; }
.numbers li { background: #eef2f7; border-radius: 0.5rem; padding: 0.5rem 0.8rem; }
.numbers b { display: block; font-size: 1.3rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.85rem; white-space: nowrap; }
th, td { padding: 0.25rem 0.6rem; text-align: right; border-bottom: 1px solid #dde3ea; }
th:nth-child(2), td:nth-child(2), td:last-child, th:last-child { text-align: left; }
tr.refused td { background: #fdeeee; }
"""


@dataclass(frozen=True)
class Report:
    """All that a report shows.

    Attributes:
        title: Its heading.
        rows: One per attempt, in the order of their stamps.
        scene_map: The map.
        illustrations: Images whose matches are drawn; the first is on the overview, too.
        facts: What was run, by name: bag, map, options.
        trajectories: Odometry, fixes and corrected odometry, when there was odometry.
    """

    title: str
    rows: Sequence[Row]
    scene_map: SceneMap
    illustrations: Sequence[Illustration] = ()
    facts: Mapping[str, str] = field(default_factory=dict)
    trajectories: Trajectories | None = None

    @property
    def unit(self) -> str:
        """Unit of the map."""
        return unit_of(self.scene_map)


def write_report(folder: Path, report: Report) -> None:
    """Writes `report.html` and `overview.png` into an existing folder."""
    numbers = [f'{name}: {value}' for name, value in headline_numbers(report).items()]
    title = f'{report.title}\n{"   |   ".join(numbers)}'
    overview = overview_figure(title, report.rows, report.scene_map, report.illustrations)
    (folder / OVERVIEW).write_bytes(png(overview))
    write_text(folder / REPORT, report_html(report))


def report_html(report: Report) -> str:
    """The report as an HTML page without scripts and without anything to load."""
    title = escape(report.title)
    return '\n'.join(
        [
            '<!DOCTYPE html>',
            '<html lang="en">',
            '<head>',
            '<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f'<title>{title}</title>',
            f'<style>{_STYLE}</style>',
            '</head>',
            '<body>',
            f'<h1>{title}</h1>',
            *_numbers(report),
            *_figures(report),
            *_drift(report),
            *_statuses(report),
            *_attempts(report),
            *_facts(report),
            '</body>',
            '</html>',
            '',
        ]
    )


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


def _numbers(report: Report) -> Iterator[str]:
    yield '<ul class="numbers">'
    for name, value in headline_numbers(report).items():
        yield f'<li><b>{escape(value)}</b>{escape(name)}</li>'
    yield '</ul>'


def _figures(report: Report) -> Iterator[str]:
    if not report.rows:
        yield '<p>No image was tried: the bag has none on this topic.</p>'
        return
    yield '<h2>From above</h2>'
    yield _image(trajectory_figure(report.rows, report.scene_map), 'The map and the fixes.')
    for illustration in report.illustrations:
        inliers = illustration.estimate.inliers
        caption = (
            f'Image {illustration.stamp_ns / 1e9:.3f} s, {inliers} inliers. Circles: keypoints; '
            f'dots: where the pose puts their map points.'
        )
        yield '<h2>Matches</h2>'
        yield _image(match_figure(illustration, report.scene_map), caption)
    yield '<h2>Over time</h2>'
    if any(row.robot_pose for row in report.rows):
        caption = 'Errors of the fixes and their own standard deviations.'
        yield _image(error_figure(report.rows, report.unit), caption)
    yield _image(inlier_figure(report.rows), 'Inliers of each attempt.')
    yield _image(timing_figure(report.rows), 'Time of each attempt by stage.')


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


def _drift(report: Report) -> Iterator[str]:
    table = trajectory_errors(report)
    if report.trajectories is None or not table:
        return
    yield '<h2>Drift correction</h2>'
    caption = (
        'Errors of the odometry by itself, laid on the truth at its start; of the fixes; and of '
        'the odometry as corrected by them, each fix from the time of its image on.'
    )
    yield _image(drift_figure(report.trajectories), caption)
    yield from _table(table[0], table[1:])


def _image(figure: Figure, caption: str) -> str:
    data, text = base64.b64encode(png(figure)).decode('ascii'), escape(caption)
    return (
        f'<figure><img alt="{text}" src="data:image/png;base64,{data}">'
        f'<figcaption>{text}</figcaption></figure>'
    )


def _statuses(report: Report) -> Iterator[str]:
    summary = summarise(report.rows)
    yield '<h2>Verdicts and times</h2>'
    yield from _table(
        ['verdict', 'attempts'], [(name, str(n)) for name, n in summary.statuses.items()]
    )
    spreads = dict(summary.milliseconds)
    if summary.total_milliseconds:
        spreads['all'] = summary.total_milliseconds
    yield from _table(
        ['stage', 'median [ms]', '95 % [ms]', 'max [ms]'],
        [(stage, *_milliseconds(spread)) for stage, spread in spreads.items()],
    )


def _milliseconds(spread: Spread) -> tuple[str, str, str]:
    return f'{spread.median:.1f}', f'{spread.p95:.1f}', f'{spread.max:.1f}'


def _attempts(report: Report) -> Iterator[str]:
    yield '<h2>Attempts</h2>'
    header = ['stamp [s]', 'verdict', 'inliers', '1-sigma', 'error', 'ms', 'reason']
    refused = [row.status is not Status.ACCEPTED for row in report.rows]
    yield from _table(header, [_cells(row, report.unit) for row in report.rows], refused)


def _cells(row: Row, unit: str) -> tuple[str, ...]:
    error, deviation = row.error, row.position_std
    return (
        f'{row.stamp_ns / 1e9:.3f}',
        row.status.name,
        str(row.inliers),
        '' if deviation is None else length_text(deviation, unit),
        '' if error is None else _error_text(error.position, error.rotation_deg, unit),
        f'{row.total_milliseconds:.0f}',
        row.reason,
    )


def _facts(report: Report) -> Iterator[str]:
    yield '<h2>What was run</h2>'
    yield from _table(['', 'value'], list(report.facts.items()))


def _table(
    header: Sequence[str], rows: Sequence[Sequence[str]], refused: Sequence[bool] = ()
) -> Iterator[str]:
    yield '<div class="wide"><table>'
    yield f'<tr>{"".join(f"<th>{escape(name)}</th>" for name in header)}</tr>'
    for index, cells in enumerate(rows):
        mark = ' class="refused"' if index < len(refused) and refused[index] else ''
        yield f'<tr{mark}>{"".join(f"<td>{escape(cell)}</td>" for cell in cells)}</tr>'
    yield '</table></div>'
