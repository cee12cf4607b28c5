# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""An evaluation of running time as tables and figures for people and as JSON for programs."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from gam_relocalizer import pages
from gam_relocalizer.evaluation.metrics import THRESHOLDS
from gam_relocalizer.evaluation.timing import (
    COMPARED_COUNT,
    Averages,
    Method,
    averages,
    mean_speedup,
    speedup_of,
    summarise,
)
from gam_relocalizer.geometry import write_text
from gam_relocalizer.plots import FOUND, LABEL_SIZE, REFUSED, WIDTH, finish, write_picture

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from matplotlib.axes import Axes

    from gam_relocalizer.evaluation.metrics import Accuracy
    from gam_relocalizer.evaluation.timing import Run, SetTiming, Speedup, TimedScore

MARKDOWN = 'timing.md'
JSON = 'timing.json'
FIGURE = 'timing.png'
PAGE = 'timing.html'

_KIND = 'gam_relocalizer evaluate timing'
_TITLE = 'Running time'
_NAMES = {
    'local_features': 'Local features',
    'global_descriptor': 'Global descriptor',
    'retrieval': 'Scene retrieval',
    'matching': 'Matching',
    'pose': 'Pose',
    'verdict': 'Verdict',
    'total': 'Total',
}
_STYLES = {Method.SCENES: (FOUND, 'o-'), Method.IMAGES: (REFUSED, 's--')}
_PANELS = 3
_EXPLANATION = (
    'Mean and median over the queries [ms]. All poses found, whatever the verdict; time without '
    'local features and global descriptor, as in the paper, and of the localizer with its verdict, '
    'which image matching has none of.'
)


@dataclass(frozen=True)
class TimingReport:
    """All that was timed.

    Attributes:
        timings: Of at least one set of queries, all with the same numbers of retrieved images.
        machine: What it was measured on, see `machine_facts`.
    """

    timings: Sequence[SetTiming]
    machine: Mapping[str, str]


@dataclass(frozen=True)
class _Table:
    """Cells, and what they are about."""

    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]


def markdown(report: TimingReport) -> str:
    """Components, how many times faster, and the curves over the number of retrieved images."""
    parts = [', '.join(f'{name}: {value}' for name, value in report.machine.items()) + '.']
    for title, tables in _sections(report).items():
        parts.append(f'## {title}')
        parts += [part for table in tables for part in (table.caption, _as_markdown(table))]
    return '\n\n'.join(parts) + '\n'


def as_json(report: TimingReport) -> dict[str, Any]:
    """All numbers, shares in [0, 1]; what is not defined, as a median of nothing, is None."""
    speedup = _mean_speedup(report)
    content = {
        'kind': _KIND,
        'machine': dict(report.machine),
        'compared_retrieved_images': COMPARED_COUNT,
        'sets': [_set_row(timing) for timing in report.timings],
        'mean_speedup': None if speedup is None else asdict(speedup),
    }
    finite: dict[str, Any] = _finite(content)
    return finite


def figure(timings: Sequence[SetTiming]) -> Figure:
    """Figure (b), (c) and (d) of the paper side by side, a row per set."""
    drawn = Figure(figsize=(_PANELS * WIDTH, 4.0 * len(timings)), layout='constrained')
    rows = drawn.subplots(len(timings), _PANELS, squeeze=False)
    for axes, timing in zip(rows, timings, strict=True):
        _draw(axes, timing)
        axes[0].set_title(timing.name, fontsize=LABEL_SIZE)
    return drawn


def html(report: TimingReport) -> str:
    """A page of its own with all tables and figures."""
    parts = [
        pages.numbers(_headline(report)),
        *(
            pages.picture(
                _narrow_figure(timing),
                f'{timing.name}: error over time, time over the number of retrieved images, and '
                f'error over their number; times without local features and global descriptor.',
            )
            for timing in report.timings
        ),
        *pages.markdown(markdown(report)),
    ]
    return pages.page(_TITLE, parts)


def write_report(folder: Path, report: TimingReport) -> None:
    """Writes tables, numbers, figure and page to an existing folder."""
    write_text(folder / MARKDOWN, markdown(report))
    write_text(folder / JSON, json.dumps(as_json(report), indent=2, allow_nan=False) + '\n')
    write_text(folder / PAGE, html(report))
    write_picture(folder / FIGURE, figure(report.timings))


def _sections(report: TimingReport) -> dict[str, list[_Table]]:
    sections = {_TITLE: [_components_table(report)]}
    speedups = _speedup_table(report)
    if speedups is not None:
        sections['Image matching against the localizer'] = [speedups]
    sections['Number of retrieved images'] = [_curve_table(one) for one in report.timings]
    return sections


def _components_table(report: TimingReport) -> _Table:
    rows = []
    for timing in report.timings:
        values = _components(timing.runs[Method.SCENES][COMPARED_COUNT].values())
        for average in ('mean', 'median'):
            cells = [f'{getattr(value, average):.1f}' for value in values.values()]
            rows.append([timing.name, average, *cells])
    return _Table(
        f'The localizer by its defaults (R = {COMPARED_COUNT}), milliseconds per query:',
        ['Map', 'Average', *(f'{name} [ms]' for name in _NAMES.values())],
        rows,
    )


def _speedup_table(report: TimingReport) -> _Table | None:
    """Times faster, beside the errors that it costs or saves."""
    rows = []
    for timing in report.timings:
        speedup = speedup_of(timing)
        if speedup is not None:
            scenes, images = (
                summarise(timing.runs[method][COMPARED_COUNT].values()).found
                for method in (Method.SCENES, Method.IMAGES)
            )
            rows.append(
                [
                    timing.name,
                    *_speedup_cells(speedup),
                    f'{_shown(scenes.median_position, ".4f")} / '
                    f'{_shown(images.median_position, ".4f")} {_unit(timing)}',
                    f'{_shown(scenes.median_rotation_deg, ".3f")} / '
                    f'{_shown(images.median_rotation_deg, ".3f")}',
                    ', '.join(_recall_pairs(scenes, images)),
                ]
            )
    mean = _mean_speedup(report)
    if mean is None:
        return None
    if len(rows) > 1:
        rows.append(['geometric mean', *_speedup_cells(mean), '', '', ''])
    thresholds = ', '.join(f'{one.position:g}/{one.rotation_deg:g}' for one in THRESHOLDS)
    return _Table(
        f'How many times faster than {Method.IMAGES.value} the localizer is with '
        f'R = {COMPARED_COUNT}: ratios of mean and of median times. First from features to a pose, '
        f'which both do; then with the verdict, which only the localizer has; then whole queries, '
        f'with local features and global descriptor. Then what both achieve, localizer / image '
        f'matching; recall at {thresholds} (position / deg).',
        [
            'Map',
            'Mean',
            'Median',
            'Mean, with verdict',
            'Median, with verdict',
            'Mean, whole query',
            'Median, whole query',
            'Median position',
            'Median [deg]',
            'Recall [%]',
        ],
        rows,
    )


def _recall_pairs(scenes: Accuracy, images: Accuracy) -> list[str]:
    return [
        f'{100 * scenes.recall[one]:.0f} / {100 * images.recall[one]:.0f}' for one in THRESHOLDS
    ]


def _curve_table(timing: SetTiming) -> _Table:
    """A row per number of retrieved images and method."""
    unit = _unit(timing)
    by_method = {
        method: {count: summarise(runs.values()) for count, runs in by_count.items()}
        for method, by_count in timing.runs.items()
    }
    counts = by_method[Method.SCENES]
    return _Table(
        _caption(timing),
        [
            'R',
            'Method',
            f'Median [{unit}]',
            'Median [deg]',
            *(f'{one.position:g} {unit}, {one.rotation_deg:g} deg [%]' for one in THRESHOLDS),
            'Poses',
            'Accepted',
            'Mean [ms]',
            'Median [ms]',
        ],
        [
            [str(count), method.value, *_score_cells(scores[count])]
            for count in counts
            for method, scores in by_method.items()
        ],
    )


def _caption(timing: SetTiming) -> str:
    queries = len(timing.runs[Method.SCENES][COMPARED_COUNT])
    frame = 'metric' if timing.metric else 'not metric'
    if timing.aligned:
        frame += ', laid over the reference'
    left_out = (
        f', {timing.images_without_truth} more images without truth'
        if timing.images_without_truth
        else ''
    )
    return (
        f'Map {timing.name} ({frame}; {timing.images} images, {timing.extractor}, '
        f'{timing.global_descriptor}), {queries} queries{left_out}. {_EXPLANATION}'
    )


def _score_cells(score: TimedScore) -> list[str]:
    found = score.found
    return [
        _shown(found.median_position, '.4f'),
        _shown(found.median_rotation_deg, '.3f'),
        *(f'{100 * found.recall[one]:.1f}' for one in THRESHOLDS),
        f'{found.localized}/{found.queries}',
        '' if score.accepted is None else f'{score.accepted}/{found.queries}',
        f'{score.elapsed.mean:.0f}',
        f'{score.elapsed.median:.0f}',
    ]


def _speedup_cells(speedup: Speedup) -> list[str]:
    return [
        f'{value:.1f}'
        for ratios in (speedup.to_pose, speedup.elapsed, speedup.whole)
        for value in (ratios.mean, ratios.median)
    ]


def _headline(report: TimingReport) -> dict[str, str]:
    totals = [
        run.components.total
        for timing in report.timings
        for run in timing.runs[Method.SCENES][COMPARED_COUNT].values()
    ]
    shown = {'queries': str(len(totals)), 'median time': f'{averages(totals).median:.0f} ms'}
    speedup = _mean_speedup(report)
    if speedup is not None:
        shown[f'times faster than image matching, R = {COMPARED_COUNT}'] = (
            f'{speedup.to_pose.mean:.1f}, with the verdict {speedup.elapsed.mean:.1f}'
        )
    return shown


def _mean_speedup(report: TimingReport) -> Speedup | None:
    speedups = [one for one in map(speedup_of, report.timings) if one is not None]
    return mean_speedup(speedups) if speedups else None


def _components(runs: Iterable[Run]) -> dict[str, Averages]:
    every = [one.components for one in runs]
    return {name: averages([getattr(one, name) for one in every]) for name in _NAMES}


def _narrow_figure(timing: SetTiming) -> Figure:
    """The figure of one set, its parts below each other."""
    drawn = Figure(figsize=(WIDTH, 3.2 * _PANELS), layout='constrained')
    _draw(drawn.subplots(_PANELS, 1), timing)
    return drawn


def _draw(axes: Sequence[Axes], timing: SetTiming) -> None:
    for method, by_count in timing.runs.items():
        scores = [summarise(runs.values()) for runs in by_count.values()]
        counts = list(by_count)
        errors = [score.found.median_position for score in scores]
        times = [score.elapsed.mean for score in scores]
        colour, mark = _STYLES[method]
        axes[0].plot(times, errors, mark, color=colour, markersize=4, label=method.value)
        axes[1].plot(counts, times, mark, color=colour, markersize=4)
        axes[2].plot(counts, errors, mark, color=colour, markersize=4)
    error, elapsed = f'median position error [{_unit(timing)}]', 'mean time [ms]'
    axes[0].set(xlabel=elapsed, ylabel=error, xscale='log')
    axes[1].set(xlabel='retrieved images', ylabel=elapsed, yscale='log')
    axes[2].set(xlabel='retrieved images', ylabel=error)
    for one in (axes[0], axes[2]):
        one.margins(y=0.25)
        one.set_ylim(bottom=0.0)
    for axis in (axes[0].xaxis, axes[1].yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
        axis.set_major_formatter('{x:g}')
        axis.set_minor_formatter('')
    for one in axes:
        finish(one)
    axes[0].legend(fontsize=LABEL_SIZE)


def _set_row(timing: SetTiming) -> dict[str, Any]:
    speedup = speedup_of(timing)
    return {
        **{key: value for key, value in vars(timing).items() if key != 'runs'},
        'components': {
            name: asdict(value)
            for name, value in _components(
                timing.runs[Method.SCENES][COMPARED_COUNT].values()
            ).items()
        },
        'speedup': None if speedup is None else asdict(speedup),
        'methods': [
            {
                'name': method.value,
                'retrieved_images': count,
                **_score_row(summarise(runs.values())),
                'queries': {name: _run_row(run) for name, run in runs.items()},
            }
            for method, by_count in timing.runs.items()
            for count, runs in by_count.items()
        ],
    }


def _score_row(score: TimedScore) -> dict[str, Any]:
    recall = score.found.recall
    return {
        'found': {
            **vars(score.found),
            'recall': [{**asdict(one), 'recall': recall[one]} for one in THRESHOLDS],
        },
        'accepted': score.accepted,
        'to_pose': asdict(score.to_pose),
        'elapsed': asdict(score.elapsed),
        'whole': asdict(score.whole),
    }


def _run_row(run: Run) -> dict[str, Any]:
    return {
        'position': None if run.error is None else run.error.position,
        'rotation_deg': None if run.error is None else run.error.rotation_deg,
        'accepted': run.accepted,
        'milliseconds': asdict(run.components),
    }


def _as_markdown(table: _Table) -> str:
    """Columns of texts to the left, of numbers to the right."""
    texts = {'Map', 'Average', 'Method'}
    ruler = '|'.join('---' if name in texts else '---:' for name in table.header)
    lines = [f'| {" | ".join(cells)} |' for cells in (table.header, *table.rows)]
    return '\n'.join([lines[0], f'|{ruler}|', *lines[1:]])


def _unit(timing: SetTiming) -> str:
    return 'm' if timing.metric else 'units'


def _shown(value: float, style: str) -> str:
    return '-' if math.isnan(value) else format(value, style)


def _finite(value: Any) -> Any:  # noqa: ANN401 - any JSON value
    """JSON knows no NaN."""
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
