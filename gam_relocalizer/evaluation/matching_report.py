# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""An evaluation of matchers as tables for people and as JSON for programs."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from gam_relocalizer import pages
from gam_relocalizer.evaluation.figures import bars_figure
from gam_relocalizer.evaluation.matching import TRUE_CANDIDATES, mean_over_maps
from gam_relocalizer.evaluation.neighbours import curves_of, neighbours_figure
from gam_relocalizer.geometry import write_text
from gam_relocalizer.plots import write_picture

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from pathlib import Path

    from matplotlib.figure import Figure

    from gam_relocalizer.evaluation.matching import EvaluationOptions, MapEvaluation, Score

TABLES = {
    '2D-3D matching': (
        'nn-ratio',
        'nn-cross',
        'nn-distance',
        'nn-lgcnet',
        'nn-oanet',
        'bmnet',
        'gam',
    ),
    'Ablation study': ('plainnet', 'plainnet-hp', 'bmnet-no-mining', 'bmnet-small'),
}
OTHERS = 'Other matchers'
DEFAULT_MATCHERS = tuple(dict.fromkeys(name for names in TABLES.values() for name in names))

MARKDOWN = 'matching.md'
JSON = 'matching.json'
PAGE = 'matching.html'
SHARES = 'precision_and_recall.png'
FIGURE = 'neighbours.png'

_KIND = 'gam_relocalizer evaluate matching'
_TITLE = 'Matching'


@dataclass(frozen=True)
class MatchingReport:
    """All that was evaluated.

    Attributes:
        evaluations: Of at least one map.
        matchers: Names of the matchers in the tables.
        options: What of the maps was evaluated.
        swept: Name of the matcher of the figure over k, if there is one; the scores of the
            evaluations then hold its candidacies too.
    """

    evaluations: Sequence[MapEvaluation]
    matchers: Sequence[str]
    options: EvaluationOptions
    swept: str | None = None


@dataclass(frozen=True)
class _Column:
    """A column of a table.

    Attributes:
        title: Its head.
        value: What it shows of a score.
        style: Format of the number.
        best: Which of the numbers is printed bold.
    """

    title: str
    value: Callable[[Any], float]
    style: str
    best: Callable[[Iterable[float]], float] | None


_SHARES = (
    _Column('M.Precision [%]', lambda score: 100.0 * score.precision, '.1f', max),
    _Column('M.Recall [%]', lambda score: 100.0 * score.recall, '.1f', max),
    _Column('G.Precision [%]', lambda score: 100.0 * score.geometric_precision, '.1f', max),
    _Column('G.Recall [%]', lambda score: 100.0 * score.geometric_recall, '.1f', max),
    _Column('Matches', lambda score: score.matches, '.0f', None),
)
_ERRORS = (
    _Column('MPE [‰ of depth]', lambda score: score.position_permille, '.3f', min),
    _Column('MRE [deg]', lambda score: score.rotation_deg, '.4f', min),
)


def markdown(report: MatchingReport) -> str:
    """The tables of the paper: the mean over the maps, then every map."""
    parts = []
    for title, names in _tables(report.matchers).items():
        parts.append(f'## {title}')
        if len(report.evaluations) > 1:
            parts.append(f'Mean over {len(report.evaluations)} maps:')
            parts.append(_table(mean_over_maps(report.evaluations), names, _SHARES + _ERRORS))
        for evaluation in report.evaluations:
            parts.append(_caption(evaluation))
            parts.append(_table(evaluation.scores, names, _map_columns(evaluation)))
    return '\n\n'.join(parts) + '\n'


def as_json(report: MatchingReport) -> dict[str, Any]:
    """All numbers, shares in [0, 1]; an infinite error (no pose) is None."""
    means = mean_over_maps(report.evaluations)
    content: dict[str, Any] = {
        'kind': _KIND,
        **asdict(report.options),
        'maps': [
            {
                **{key: value for key, value in vars(one).items() if key != 'scores'},
                'matchers': {
                    name: _row(one.scores[name]) for name in (*report.matchers, TRUE_CANDIDATES)
                },
            }
            for one in report.evaluations
        ],
        'mean': {name: _row(means[name]) for name in (*report.matchers, TRUE_CANDIDATES)},
    }
    if report.swept is not None:
        content['neighbours'] = {
            'matcher': report.swept,
            'maps': [_curve_rows(one.scores) for one in report.evaluations],
            'mean': _curve_rows(means),
        }
    return content


def write_report(folder: Path, report: MatchingReport) -> None:
    """Writes the tables, the numbers, the figures and a page of them all to an existing folder."""
    write_text(folder / MARKDOWN, markdown(report))
    write_text(folder / JSON, json.dumps(as_json(report), indent=2, allow_nan=False) + '\n')
    figures = _figures(report)
    for file, (figure, _) in figures.items():
        write_picture(folder / file, figure)
    parts = [
        pages.numbers(_headline(report)),
        *(pages.picture(figure, caption) for figure, caption in figures.values()),
        *pages.markdown(markdown(report)),
    ]
    write_text(folder / PAGE, pages.page(_TITLE, parts))


def _headline(report: MatchingReport) -> dict[str, str]:
    """Of the last matcher."""
    last = report.matchers[-1]
    score = mean_over_maps(report.evaluations)[last]
    return {
        'matcher': last,
        'images': str(sum(one.images for one in report.evaluations)),
        'precision of its matches': f'{100.0 * score.precision:.1f} %',
        'true matches that it finds': f'{100.0 * score.recall:.1f} %',
        'images with a pose': f'{100.0 * score.poses:.1f} %',
    }


def _figures(report: MatchingReport) -> dict[str, tuple[Figure, str]]:
    """With their captions, by the names of their files."""
    means = mean_over_maps(report.evaluations)
    shares = {
        name: {'precision': means[name].precision, 'recall': means[name].recall}
        for name in report.matchers
    }
    figures = {
        SHARES: (
            bars_figure(shares, '[%]'),
            'Share of the matches that are true, and of the true ones that are found, for each '
            'matcher: mean over the maps.',
        )
    }
    if report.swept is not None:
        figures[FIGURE] = (
            neighbours_figure(curves_of(means)),
            f'Candidates from the k nearest neighbours, with and without the ratio, judged by '
            f'{report.swept}: mean over the maps.',
        )
    return figures


def _tables(chosen: Sequence[str]) -> dict[str, list[str]]:
    """The chosen matchers in the tables of the paper, and those that are in none."""
    tables = {title: [name for name in names if name in chosen] for title, names in TABLES.items()}
    tables[OTHERS] = [
        name for name in chosen if not any(name in names for names in TABLES.values())
    ]
    return {title: names for title, names in tables.items() if names}


def _caption(evaluation: MapEvaluation) -> str:
    left_out = (
        f', {evaluation.images_without_truth} more without any true correspondence'
        if evaluation.images_without_truth
        else ''
    )
    unit = 'metric' if evaluation.metric else 'not metric'
    return f'Map {evaluation.name} ({unit}), {evaluation.images} images{left_out}:'


def _map_columns(evaluation: MapEvaluation) -> tuple[_Column, ...]:
    unit = 'm' if evaluation.metric else 'map units'
    return (*_SHARES, _Column(f'MPE [{unit}]', lambda score: score.position, '.5f', min), *_ERRORS)


def _table(scores: Mapping[str, Score], names: Sequence[str], columns: Sequence[_Column]) -> str:
    """A table in Markdown; the best number of a column, as printed, is bold, but for the bound."""
    cells = [
        [
            *_cells(column, [scores[name] for name in names]),
            *_cells(column, [scores[TRUE_CANDIDATES]]),
        ]
        for column in columns
    ]
    rows = zip((*names, TRUE_CANDIDATES), *cells, strict=True)
    return '\n'.join(
        [
            f'| Matcher | {" | ".join(column.title for column in columns)} |',
            f'|---|{"---:|" * len(columns)}',
            *(f'| {" | ".join(row)} |' for row in rows),
        ]
    )


def _cells(column: _Column, scores: Sequence[Score]) -> list[str]:
    values = [column.value(score) for score in scores]
    shown = [format(value, column.style) if math.isfinite(value) else '∞' for value in values]
    if column.best is None or len(values) < 2:
        return shown
    best = shown[values.index(column.best(values))]
    return [f'**{one}**' if one == best != '∞' else one for one in shown]


def _row(score: Score) -> dict[str, float | None]:
    return {name: value if math.isfinite(value) else None for name, value in asdict(score).items()}


def _curve_rows(scores: Mapping[str, Score]) -> dict[str, list[dict[str, float | None]]]:
    return {label: [_row(score) for score in curve] for label, curve in curves_of(scores).items()}
