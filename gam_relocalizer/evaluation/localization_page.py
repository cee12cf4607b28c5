# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""An evaluation of localization as one HTML page with all its figures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer import pages
from gam_relocalizer.evaluation.figures import (
    bars_figure,
    error_curves_figure,
    places_figure,
    times_figure,
)
from gam_relocalizer.evaluation.localization import summarise, tally
from gam_relocalizer.evaluation.metrics import CORRECT, THRESHOLDS, accuracy
from gam_relocalizer.localization.pictures import MATCHES_EXPLAINED, match_figure
from gam_relocalizer.plots import View

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from matplotlib.figure import Figure

    from gam_relocalizer.evaluation.localization import Method, Outcome, SetEvaluation
    from gam_relocalizer.evaluation.metrics import Threshold
    from gam_relocalizer.geometry import PoseError

TITLE = 'Localization'


@dataclass(frozen=True)
class NamedFigure:
    """A figure of the page that is a file, too.

    Attributes:
        file: Name of the file.
        figure: The figure.
        caption: What it shows.
    """

    file: str
    figure: Figure
    caption: str


def page(
    evaluations: Sequence[SetEvaluation], figures: Sequence[NamedFigure], markdown: str
) -> str:
    """The page: the numbers that sum it up, figures, the worst queries, and all tables.

    Args:
        evaluations: Of at least one set of queries, all by the same methods.
        figures: To be shown.
        markdown: The tables as they are printed.
    """
    parts = [pages.numbers(_headline(evaluations))]
    if figures:
        parts.append(pages.heading('At a glance'))
        parts += [pages.picture(one.figure, one.caption) for one in figures]
    parts += [*pages.markdown(markdown), *_worst_parts(evaluations)]
    return pages.page(TITLE, parts)


def figures_of(evaluations: Sequence[SetEvaluation]) -> list[NamedFigure]:
    """Errors, recall, times, and where the queries were; without truth, times alone."""
    scored, every = [one for one in evaluations if one.has_truth], _methods(evaluations)
    figures = []
    if scored:
        figures.append(
            NamedFigure(
                'errors.png',
                error_curves_figure(_errors(scored), _unit(scored), label(every[-1])),
                f'Share of the queries whose pose, whatever the verdict, is within a distance and '
                f'within an angle of the truth. Thick: {label(every[-1])}.',
            )
        )
        caption = 'Recall: share of the queries within a distance and an angle, of all poses found.'
        figures.append(
            NamedFigure('recall.png', bars_figure(_recalls(scored), 'recall [%]'), caption)
        )
    times = {
        label(method): [one.milliseconds for one in _outcomes(evaluations, method)]
        for method in every
    }
    caption = 'Time of matching and pose: median over the queries; lines end where 95 % lie.'
    figures.append(NamedFigure('times.png', times_figure(times), caption))
    for number, evaluation in enumerate(scored, start=1):
        figures += _places(evaluation, number)
    return figures


def label(method: Method) -> str:
    """A method in a word or two."""
    return f'{method.name} {method.matcher}'


def _headline(evaluations: Sequence[SetEvaluation]) -> dict[str, str]:
    """Of the whole method, the last row."""
    whole = _methods(evaluations)[-1]
    counts = tally(_outcomes(evaluations, whole))
    numbers = {
        'method': label(whole),
        'accepted / queries': f'{counts.accepted} / {counts.queries}',
        'time, median': f'{counts.milliseconds:.0f} ms',
    }
    scored = [one for one in evaluations if one.has_truth]
    if not scored:
        return numbers
    unit = _unit(scored)
    recalls = [summarise(one.outcomes[whole].values()).accepted.recall[CORRECT] for one in scored]
    name = f'accepted within {CORRECT.position:g} {unit}, {CORRECT.rotation_deg:g} deg'
    numbers[name] = f'{100.0 * float(np.mean(recalls)):.1f} %'
    if len(scored) == 1:
        accepted = summarise(scored[0].outcomes[whole].values()).accepted
        if accepted.localized:
            numbers['median error of the accepted'] = (
                f'{accepted.median_position:.3g} {unit}, {accepted.median_rotation_deg:.2g} deg'
            )
    return numbers


def _methods(evaluations: Sequence[SetEvaluation]) -> tuple[Method, ...]:
    return tuple(evaluations[0].outcomes)


def _outcomes(evaluations: Sequence[SetEvaluation], method: Method) -> list[Outcome]:
    return [outcome for one in evaluations for outcome in one.outcomes[method].values()]


def _unit(evaluations: Sequence[SetEvaluation]) -> str:
    return 'm' if all(one.metric for one in evaluations) else 'units'


def _errors(scored: Sequence[SetEvaluation]) -> dict[str, list[PoseError | None]]:
    """Of all queries with a truth, None without a pose, by method and by other localizer."""
    errors: dict[str, list[PoseError | None]] = {
        label(method): [outcome.error for outcome in _outcomes(scored, method)]
        for method in _methods(scored)
    }
    for name in scored[0].others:
        errors[name] = [
            one.others[name].get(image)
            for one in scored
            for image in one.outcomes[_methods(scored)[-1]]
        ]
    return errors


def _recalls(scored: Sequence[SetEvaluation]) -> dict[str, dict[str, float]]:
    """Mean over the sets, by method and threshold."""
    unit = _unit(scored)
    recalls: dict[str, list[Mapping[Threshold, float]]] = {
        label(method): [summarise(one.outcomes[method].values()).found.recall for one in scored]
        for method in _methods(scored)
    }
    for name in scored[0].others:
        recalls[name] = [
            accuracy(list(one.others[name].values()), one.queries).recall for one in scored
        ]
    return {
        name: {
            f'{limit.position:g} {unit}, {limit.rotation_deg:g} deg': float(
                np.mean([recall[limit] for recall in every])
            )
            for limit in THRESHOLDS
        }
        for name, every in recalls.items()
    }


def _places(evaluation: SetEvaluation, number: int) -> Iterator[NamedFigure]:
    """The map from above and from the side with the queries, as the whole method does on them."""
    sights, whole = evaluation.sights, _methods([evaluation])[-1]
    if sights is None:
        return
    outcomes = evaluation.outcomes[whole]
    errors = [outcomes[name].error for name in sights.positions]
    for name, words, view in (
        ('above', 'from above', View.from_above(sights.scene_map)),
        ('side', 'from the side', View.from_the_side(sights.scene_map)),
    ):
        yield NamedFigure(
            f'{name}_{number}.png',
            places_figure(
                sights.scene_map,
                view,
                np.array(list(sights.positions.values())),
                np.array([np.nan if one is None else one.position for one in errors]),
                _unit([evaluation]),
            ),
            f'Queries in map {evaluation.name} {words}, by the error of {label(whole)}.',
        )


def _worst_parts(evaluations: Sequence[SetEvaluation]) -> Iterator[str]:
    whole = _methods(evaluations)[-1]
    for evaluation in evaluations:
        if evaluation.sights is None or not evaluation.sights.worst:
            continue
        yield pages.heading(f'Worst poses of {label(whole)} in map {evaluation.name}')
        yield pages.paragraph(MATCHES_EXPLAINED)
        for name, illustration in evaluation.sights.worst.items():
            outcome, unit = evaluation.outcomes[whole][name], _unit([evaluation])
            words = [name, outcome.status.name, f'confidence {outcome.confidence:.2f}']
            if error := outcome.error:
                words.append(f'error {error.position:.3g} {unit}, {error.rotation_deg:.3g} deg')
            figure = match_figure(illustration, evaluation.sights.scene_map)
            yield pages.picture(figure, ', '.join(words))
