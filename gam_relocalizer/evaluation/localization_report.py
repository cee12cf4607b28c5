# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""An evaluation of localization as tables for people and as JSON for programs."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from gam_relocalizer.evaluation.calibration import precision_recall_figure, reliability_figure
from gam_relocalizer.evaluation.localization import RANKS, calibration_of, summarise, tally
from gam_relocalizer.evaluation.localization_page import NamedFigure, figures_of, page
from gam_relocalizer.evaluation.metrics import CORRECT, THRESHOLDS, accuracy
from gam_relocalizer.geometry import quaternion_wxyz, write_text
from gam_relocalizer.plots import write_picture

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from pathlib import Path

    from gam_relocalizer.evaluation.calibration import Calibration, PrecisionRecall
    from gam_relocalizer.evaluation.localization import (
        Method,
        MethodScore,
        Outcome,
        SetEvaluation,
    )
    from gam_relocalizer.evaluation.metrics import Accuracy, Threshold
    from gam_relocalizer.geometry import PoseError

DEFAULT_MATCHERS = ('nn-ratio', 'nn-cross', 'nn-distance', 'nn-lgcnet', 'nn-oanet', 'gam')

MARKDOWN = 'localization.md'
JSON = 'localization.json'
PAGE = 'localization.html'
RELIABILITY = 'reliability.png'
PRECISION_RECALL = 'precision_recall.png'

_LEFT = '---'
# Of a set: what has rows of its own in the JSON.
_PARTS = frozenset({'retrieval', 'outcomes', 'others', 'sights'})
_KIND = 'gam_relocalizer evaluate localization'


@dataclass(frozen=True)
class LocalizationReport:
    """All that was evaluated.

    Attributes:
        evaluations: Of at least one set of queries, all by the same methods.
        retrieved_images: R of the paper.
    """

    evaluations: Sequence[SetEvaluation]
    retrieved_images: int

    @property
    def methods(self) -> tuple[Method, ...]:
        """The rows of the tables."""
        return tuple(self.evaluations[0].outcomes)

    @property
    def scored(self) -> list[SetEvaluation]:
        """The sets with a truth."""
        return [one for one in self.evaluations if one.has_truth]

    @property
    def counted(self) -> list[SetEvaluation]:
        """The sets without one."""
        return [one for one in self.evaluations if not one.has_truth]


@dataclass(frozen=True)
class _Column:
    """A column of a table.

    Attributes:
        title: Its head.
        cells: A text per row.
        ruler: Aligns it in Markdown, numbers to the right.
    """

    title: str
    cells: Sequence[str]
    ruler: str = '---:'


def markdown(report: LocalizationReport) -> str:
    """The paper's Table II by all poses and by the accepted ones, retrieval and confidence.

    Of sets without truth, only how many poses were found and accepted.
    """
    parts = []
    if report.scored:
        parts += [
            '## All poses found, whatever the verdict (as in the paper)',
            *_tables(report, _found, _found_columns, _accuracy_of_others),
            '## Accepted poses only, a rejected one counts as a miss',
            *_tables(report, _accepted, _accepted_columns, _no_others),
            '## Retrieval of a covisible image',
            _retrieval_table(report.scored),
            f'## Confidence of {_label(report.methods[-1])}',
            *_confidence_parts(*_calibration(report)),
        ]
    parts += _counted_parts(report)
    return '\n\n'.join(parts) + '\n'


def as_json(report: LocalizationReport) -> dict[str, Any]:
    """All numbers, shares in [0, 1]; what is not defined, as a median of nothing, is None."""
    content = {
        'kind': _KIND,
        'retrieved_images': report.retrieved_images,
        'sets': [_set_row(one) for one in report.evaluations],
        **(_summary_rows(report) if report.scored else {}),
    }
    finite: dict[str, Any] = _finite(content)
    return finite


def write_report(folder: Path, report: LocalizationReport) -> None:
    """Writes tables, numbers, figures and a page of them all to an existing folder."""
    write_text(folder / MARKDOWN, markdown(report))
    write_text(folder / JSON, json.dumps(as_json(report), indent=2, allow_nan=False) + '\n')
    figures = [*figures_of(report.evaluations), *_confidence_figures(report)]
    for one in figures:
        write_picture(folder / one.file, one.figure)
    write_text(folder / PAGE, page(report.evaluations, figures, markdown(report)))


def _confidence_figures(report: LocalizationReport) -> list[NamedFigure]:
    if not report.scored:
        return []
    calibration, curve = _calibration(report)
    whole = _label(report.methods[-1])
    return [
        NamedFigure(
            RELIABILITY,
            reliability_figure(calibration),
            f'Share of correct poses over the confidence of {whole}: on the diagonal when '
            f'calibrated. Below, for how many queries each point stands.',
        ),
        NamedFigure(
            PRECISION_RECALL,
            precision_recall_figure(curve),
            'Precision over recall, when poses are accepted from a confidence on.',
        ),
    ]


def _found(score: MethodScore) -> Accuracy:
    return score.found


def _accepted(score: MethodScore) -> Accuracy:
    return score.accepted


def _accuracy_of_others(evaluation: SetEvaluation) -> dict[str, Accuracy]:
    """Of the poses that other localizers found."""
    return {
        name: accuracy(list(errors.values()), evaluation.queries)
        for name, errors in evaluation.others.items()
    }


def _no_others(_: SetEvaluation) -> dict[str, Accuracy]:
    """Nobody's verdict on the poses of others is known."""
    return {}


def _tables(
    report: LocalizationReport,
    part: Callable[[MethodScore], Accuracy],
    columns: Callable[[Sequence[MethodScore], Sequence[Accuracy], str], list[_Column]],
    others: Callable[[SetEvaluation], Mapping[str, Accuracy]],
) -> list[str]:
    """The mean over the sets with truth, then every one of them."""
    parts = []
    evaluations, rows = report.scored, _method_columns(report.methods, others(report.scored[0]))
    if len(evaluations) > 1:
        means = [_mean_recall(report, method, part) for method in report.methods]
        means += _mean_recalls_of_others([others(one) for one in evaluations]).values()
        parts.append(f'Mean over {len(evaluations)} sets:')
        parts.append(_table([*rows, *_recall_columns(means, '')]))
    for evaluation in evaluations:
        scores = _scores(evaluation)
        accuracies = [*(part(one) for one in scores), *others(evaluation).values()]
        unit = 'm' if evaluation.metric else 'units'
        parts.append(_caption(evaluation, report.retrieved_images))
        parts.append(
            _table(
                [
                    *rows,
                    *_recall_columns([one.recall for one in accuracies], unit),
                    *columns(scores, accuracies, unit),
                ]
            )
        )
    return parts


def _counted_parts(report: LocalizationReport) -> list[str]:
    """Tables of the sets without truth."""
    parts = ['## Poses, where no truth is known'] if report.counted else []
    for evaluation in report.counted:
        tallies = [tally(outcomes.values()) for outcomes in evaluation.outcomes.values()]
        times = _numbers([one.milliseconds for one in tallies], '.0f', None)
        parts.append(_caption(evaluation, report.retrieved_images))
        parts.append(
            _table(
                [
                    *_method_columns(report.methods, {}),
                    _Column('Poses', [f'{one.found}/{one.queries}' for one in tallies]),
                    _Column('Accepted', [f'{one.accepted}/{one.queries}' for one in tallies]),
                    _Column('Time [ms]', times),
                ]
            )
        )
    return parts


def _method_columns(methods: Sequence[Method], others: Iterable[str]) -> list[_Column]:
    names = list(others)
    return [
        _Column('Coarse', [*(method.name for method in methods), *names], _LEFT),
        _Column('Matcher', [*(method.matcher for method in methods), *('-' for _ in names)], _LEFT),
    ]


def _recall_columns(recalls: Sequence[Mapping[Threshold, float]], unit: str) -> list[_Column]:
    return [
        _Column(
            f'{threshold.position:g} {unit}'.strip() + f', {threshold.rotation_deg:g} deg [%]',
            _numbers([100.0 * recall[threshold] for recall in recalls], '.1f', max),
        )
        for threshold in THRESHOLDS
    ]


def _found_columns(
    scores: Sequence[MethodScore], accuracies: Sequence[Accuracy], unit: str
) -> list[_Column]:
    """Rows beyond the scores are those of others, who say nothing of their time."""
    times = [score.milliseconds for score in scores]
    times += [math.nan] * (len(accuracies) - len(scores))
    return [
        *_median_columns(accuracies, unit),
        _Column('Poses', [f'{one.localized}/{one.queries}' for one in accuracies]),
        _Column('Time [ms]', _numbers(times, '.0f', None)),
    ]


def _accepted_columns(
    scores: Sequence[MethodScore], accuracies: Sequence[Accuracy], unit: str
) -> list[_Column]:
    return [
        *_median_columns(accuracies, unit),
        _Column(f'Worst [{unit}]', _numbers([one.worst_position for one in scores], '.3f', min)),
        _Column('Worst [deg]', _numbers([one.worst_rotation_deg for one in scores], '.2f', min)),
        _Column('Accepted', [f'{one.localized}/{one.queries}' for one in accuracies]),
    ]


def _median_columns(accuracies: Sequence[Accuracy], unit: str) -> list[_Column]:
    positions = [one.median_position for one in accuracies]
    rotations = [one.median_rotation_deg for one in accuracies]
    return [
        _Column(f'Median [{unit}]', _numbers(positions, '.4f', min)),
        _Column('Median [deg]', _numbers(rotations, '.3f', min)),
    ]


def _caption(evaluation: SetEvaluation, retrieved_images: int) -> str:
    frame = 'metric' if evaluation.metric else 'not metric'
    if evaluation.aligned:
        frame += ', laid over the reference'
    left_out = (
        f', {evaluation.images_without_truth} more images without truth'
        if evaluation.images_without_truth
        else ''
    )
    return (
        f'Map {evaluation.name} ({frame}), R = {retrieved_images}, '
        f'{evaluation.queries} queries{left_out}:'
    )


def _retrieval_table(evaluations: Sequence[SetEvaluation]) -> str:
    scores = [one.retrieval for one in evaluations if one.retrieval is not None]
    return _table(
        [
            _Column('Map', [one.name for one in evaluations], _LEFT),
            _Column('Descriptor', [one.global_descriptor for one in evaluations], _LEFT),
            _Column('Queries', [str(score.queries) for score in scores]),
            _Column(
                'Covisible [%]', _numbers([100 * one.covisible for one in scores], '.1f', None)
            ),
            *(
                _Column(
                    f'Recall@{rank} [%]',
                    _numbers([100.0 * score.recall[rank - 1] for score in scores], '.1f', None),
                )
                for rank in RANKS
            ),
        ]
    )


def _confidence_parts(calibration: Calibration, curve: PrecisionRecall) -> list[str]:
    count = sum(one.count for one in calibration.bins)
    if not count:
        return ['No pose was found.']
    bins = calibration.bins
    return [
        f'{count} poses of all sets; correct is within {CORRECT.position:g} m and '
        f'{CORRECT.rotation_deg:g} deg. '
        f'Expected calibration error {calibration.expected_calibration_error:.3f}, '
        f'Brier score {calibration.brier_score:.3f}. '
        f'Accepted by confidence alone, without a wrong one: '
        f'{100.0 * curve.recall_without_error:.1f} % of all queries.',
        _table(
            [
                _Column('Confidence', [f'{one.low:.1f} - {one.high:.1f}' for one in bins], _LEFT),
                _Column('Mean', [f'{one.confidence:.3f}' for one in bins]),
                _Column('Correct', [f'{one.correct:.3f}' for one in bins]),
                _Column('Poses', [str(one.count) for one in bins]),
            ]
        ),
    ]


def _calibration(report: LocalizationReport) -> tuple[Calibration, PrecisionRecall]:
    """Of the whole method, the last row, over the queries of all sets with truth."""
    whole = report.methods[-1]
    return calibration_of(
        outcome for evaluation in report.scored for outcome in evaluation.outcomes[whole].values()
    )


def _scores(evaluation: SetEvaluation) -> list[MethodScore]:
    return [summarise(outcomes.values()) for outcomes in evaluation.outcomes.values()]


def _mean_recall(
    report: LocalizationReport, method: Method, part: Callable[[MethodScore], Accuracy]
) -> dict[Threshold, float]:
    """The mean over the sets, each counting the same."""
    recalls = [
        part(summarise(evaluation.outcomes[method].values())).recall for evaluation in report.scored
    ]
    return _mean(recalls)


def _mean_recalls_of_others(
    others: Sequence[Mapping[str, Accuracy]],
) -> dict[str, dict[Threshold, float]]:
    """The same for every name; the sets have the same ones."""
    return {name: _mean([one[name].recall for one in others]) for name in others[0]}


def _mean(recalls: Sequence[Mapping[Threshold, float]]) -> dict[Threshold, float]:
    return {one: float(np.mean([recall[one] for recall in recalls])) for one in THRESHOLDS}


def _table(columns: Sequence[_Column]) -> str:
    """A table in Markdown."""
    rows = zip(*(column.cells for column in columns), strict=True)
    return '\n'.join(
        [
            f'| {" | ".join(column.title for column in columns)} |',
            f'|{"|".join(column.ruler for column in columns)}|',
            *(f'| {" | ".join(row)} |' for row in rows),
        ]
    )


def _numbers(
    values: Sequence[float], style: str, best: Callable[[Iterable[float]], float] | None
) -> list[str]:
    """Formats a column; the best number, as printed, is bold unless all are; NaN is a dash."""
    shown = ['-' if math.isnan(value) else format(value, style) for value in values]
    if best is None or len(set(shown)) < 2:
        return shown
    winner = format(best(value for value in values if not math.isnan(value)), style)
    return [f'**{one}**' if one == winner else one for one in shown]


def _label(method: Method) -> str:
    return f'{method.name} with {method.matcher}'


def _summary_rows(report: LocalizationReport) -> dict[str, Any]:
    """What is said of all sets with truth together."""
    calibration, curve = _calibration(report)
    others = _mean_recalls_of_others([_accuracy_of_others(one) for one in report.scored])
    return {
        'mean': [
            {
                **_method_row(method),
                **{
                    name: _recall_rows(_mean_recall(report, method, part))
                    for name, part in (('found', _found), ('accepted', _accepted))
                },
            }
            for method in report.methods
        ],
        'mean_of_others': {name: _recall_rows(recall) for name, recall in others.items()},
        'confidence': {
            **_method_row(report.methods[-1]),
            **asdict(calibration),
            'recall_without_error': curve.recall_without_error,
            'precision_recall': {name: value.tolist() for name, value in vars(curve).items()},
        },
    }


def _set_row(evaluation: SetEvaluation) -> dict[str, Any]:
    given = {name: value for name, value in vars(evaluation).items() if name not in _PARTS}
    if evaluation.retrieval is None:
        return {**given, 'has_truth': False, 'methods': _counted_rows(evaluation)}
    return {
        **given,
        'has_truth': True,
        'retrieval': asdict(evaluation.retrieval),
        'methods': [
            {
                **_method_row(method),
                **_score_row(summarise(outcomes.values())),
                'outcomes': {
                    name: {**_outcome_row(one), **_error_row(one.error)}
                    for name, one in outcomes.items()
                },
            }
            for method, outcomes in evaluation.outcomes.items()
        ],
        'others': {
            name: {
                'found': _accuracy_row(found),
                'outcomes': {
                    image: _error_row(error) for image, error in evaluation.others[name].items()
                },
            }
            for name, found in _accuracy_of_others(evaluation).items()
        },
    }


def _counted_rows(evaluation: SetEvaluation) -> list[dict[str, Any]]:
    """The methods on a set without truth, with nothing that only a truth could tell."""
    return [
        {
            **_method_row(method),
            **asdict(tally(outcomes.values())),
            'outcomes': {name: _outcome_row(one) for name, one in outcomes.items()},
        }
        for method, outcomes in evaluation.outcomes.items()
    ]


def _method_row(method: Method) -> dict[str, Any]:
    return {**asdict(method), 'coarse': method.coarse.value}


def _score_row(score: MethodScore) -> dict[str, Any]:
    return {
        **vars(score),
        'found': _accuracy_row(score.found),
        'accepted': _accuracy_row(score.accepted),
    }


def _accuracy_row(accuracy: Accuracy) -> dict[str, Any]:
    return {**vars(accuracy), 'recall': _recall_rows(accuracy.recall)}


def _recall_rows(recall: Mapping[Threshold, float]) -> list[dict[str, float]]:
    return [{**asdict(threshold), 'recall': share} for threshold, share in recall.items()]


def _outcome_row(outcome: Outcome) -> dict[str, Any]:
    pose = outcome.camera_from_world
    return {
        'status': outcome.status.name,
        'confidence': outcome.confidence,
        'milliseconds': outcome.milliseconds,
        'camera_from_world': (
            None
            if pose is None
            else [*quaternion_wxyz(pose).tolist(), *np.asarray(pose.translation).tolist()]
        ),
    }


def _error_row(error: PoseError | None) -> dict[str, float | None]:
    return {
        'position': None if error is None else error.position,
        'rotation_deg': None if error is None else error.rotation_deg,
    }


def _finite(value: Any) -> Any:  # noqa: ANN401 - any JSON value
    """JSON knows no NaN."""
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
