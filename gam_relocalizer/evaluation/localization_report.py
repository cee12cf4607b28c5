# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""An evaluation of localization as tables for people and as JSON for programs."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from gam_relocalizer.evaluation.calibration import (
    precision_recall_figure,
    reliability_figure,
    write_figure,
)
from gam_relocalizer.evaluation.localization import RANKS, calibration_of, summarise
from gam_relocalizer.evaluation.metrics import CORRECT, THRESHOLDS
from gam_relocalizer.geometry import write_text

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

DEFAULT_MATCHERS = ('nn-ratio', 'nn-cross', 'nn-distance', 'nn-lgcnet', 'nn-oanet', 'gam')

MARKDOWN = 'localization.md'
JSON = 'localization.json'
RELIABILITY = 'reliability.png'
PRECISION_RECALL = 'precision_recall.png'

_LEFT = '---'
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
    """The paper's Table II by all poses and by the accepted ones, retrieval and confidence."""
    parts = [
        '## All poses found, whatever the verdict (as in the paper)',
        *_tables(report, _found, _found_columns),
        '## Accepted poses only, a rejected one counts as a miss',
        *_tables(report, _accepted, _accepted_columns),
        '## Retrieval of a covisible image',
        _retrieval_table(report.evaluations),
        f'## Confidence of {_label(report.methods[-1])}',
        *_confidence_parts(*_calibration(report)),
    ]
    return '\n\n'.join(parts) + '\n'


def as_json(report: LocalizationReport) -> dict[str, Any]:
    """All numbers, shares in [0, 1]; what is not defined, as a median of nothing, is None."""
    calibration, curve = _calibration(report)
    content = {
        'kind': _KIND,
        'retrieved_images': report.retrieved_images,
        'sets': [_set_row(one) for one in report.evaluations],
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
        'confidence': {
            **_method_row(report.methods[-1]),
            **asdict(calibration),
            'recall_without_error': curve.recall_without_error,
            'precision_recall': {name: value.tolist() for name, value in vars(curve).items()},
        },
    }
    finite: dict[str, Any] = _finite(content)
    return finite


def write_report(folder: Path, report: LocalizationReport) -> None:
    """Writes tables, numbers and the figures of the confidence to an existing folder."""
    write_text(folder / MARKDOWN, markdown(report))
    write_text(folder / JSON, json.dumps(as_json(report), indent=2, allow_nan=False) + '\n')
    calibration, curve = _calibration(report)
    write_figure(folder / RELIABILITY, reliability_figure(calibration))
    write_figure(folder / PRECISION_RECALL, precision_recall_figure(curve))


def _found(score: MethodScore) -> Accuracy:
    return score.found


def _accepted(score: MethodScore) -> Accuracy:
    return score.accepted


def _tables(
    report: LocalizationReport,
    part: Callable[[MethodScore], Accuracy],
    columns: Callable[[Sequence[MethodScore], str], list[_Column]],
) -> list[str]:
    """The mean over the sets, then every set."""
    parts = []
    if len(report.evaluations) > 1:
        means = [_mean_recall(report, method, part) for method in report.methods]
        parts.append(f'Mean over {len(report.evaluations)} sets:')
        parts.append(_table([*_method_columns(report.methods), *_recall_columns(means, '')]))
    for evaluation in report.evaluations:
        scores = _scores(evaluation)
        unit = 'm' if evaluation.metric else 'units'
        parts.append(_caption(evaluation, report.retrieved_images))
        parts.append(
            _table(
                [
                    *_method_columns(report.methods),
                    *_recall_columns([part(one).recall for one in scores], unit),
                    *columns(scores, unit),
                ]
            )
        )
    return parts


def _method_columns(methods: Sequence[Method]) -> list[_Column]:
    return [
        _Column('Coarse', [method.name for method in methods], _LEFT),
        _Column('Matcher', [method.matcher for method in methods], _LEFT),
    ]


def _recall_columns(recalls: Sequence[Mapping[Threshold, float]], unit: str) -> list[_Column]:
    return [
        _Column(
            f'{threshold.position:g} {unit}'.strip() + f', {threshold.rotation_deg:g} deg [%]',
            _numbers([100.0 * recall[threshold] for recall in recalls], '.1f', max),
        )
        for threshold in THRESHOLDS
    ]


def _found_columns(scores: Sequence[MethodScore], unit: str) -> list[_Column]:
    return [
        *_median_columns([score.found for score in scores], unit),
        _Column('Poses', [f'{one.found.localized}/{one.found.queries}' for one in scores]),
        _Column('Time [ms]', _numbers([score.milliseconds for score in scores], '.0f', None)),
    ]


def _accepted_columns(scores: Sequence[MethodScore], unit: str) -> list[_Column]:
    return [
        *_median_columns([score.accepted for score in scores], unit),
        _Column(f'Worst [{unit}]', _numbers([one.worst_position for one in scores], '.3f', min)),
        _Column('Worst [deg]', _numbers([one.worst_rotation_deg for one in scores], '.2f', min)),
        _Column('Accepted', [f'{one.accepted.localized}/{one.accepted.queries}' for one in scores]),
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
    scores = [one.retrieval for one in evaluations]
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
    """Of the whole method, the last row, over the queries of all sets."""
    whole = report.methods[-1]
    return calibration_of(
        outcome
        for evaluation in report.evaluations
        for outcome in evaluation.outcomes[whole].values()
    )


def _scores(evaluation: SetEvaluation) -> list[MethodScore]:
    return [summarise(outcomes.values()) for outcomes in evaluation.outcomes.values()]


def _mean_recall(
    report: LocalizationReport, method: Method, part: Callable[[MethodScore], Accuracy]
) -> dict[Threshold, float]:
    """The mean over the sets, each counting the same."""
    recalls = [
        part(summarise(evaluation.outcomes[method].values())).recall
        for evaluation in report.evaluations
    ]
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


def _set_row(evaluation: SetEvaluation) -> dict[str, Any]:
    return {
        **{key: value for key, value in vars(evaluation).items() if key != 'outcomes'},
        'retrieval': asdict(evaluation.retrieval),
        'methods': [
            {
                **_method_row(method),
                **_score_row(summarise(outcomes.values())),
                'outcomes': {name: _outcome_row(one) for name, one in outcomes.items()},
            }
            for method, outcomes in evaluation.outcomes.items()
        ],
    }


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
    error = outcome.error
    return {
        'status': outcome.status.name,
        'position': None if error is None else error.position,
        'rotation_deg': None if error is None else error.rotation_deg,
        'confidence': outcome.confidence,
        'milliseconds': outcome.milliseconds,
    }


def _finite(value: Any) -> Any:  # noqa: ANN401 - any JSON value
    """JSON knows no NaN."""
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
