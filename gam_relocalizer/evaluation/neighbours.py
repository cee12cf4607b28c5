# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The figure of the paper over the number of neighbours, for kNN and for kNN ratio."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from matplotlib.figure import Figure

from gam_relocalizer.plots import FOUND, LABEL_SIZE, REFUSED, WIDTH, finish

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from matplotlib.axes import Axes

    from gam_relocalizer.evaluation.matching import Score

NEIGHBOURS = tuple(range(1, 9))
# kNN is kNN ratio that keeps every neighbour.
RATIOS = {'kNN ratio': 0.7, 'kNN': 0.0}
COLOURS = {'kNN ratio': FOUND, 'kNN': REFUSED}


@dataclass(frozen=True)
class Candidacy:
    """One way to choose candidates.

    Attributes:
        label: A key of `RATIOS`.
        neighbours: k.
    """

    label: str
    neighbours: int

    @property
    def ratio(self) -> float:
        """The r of kNN ratio."""
        return RATIOS[self.label]

    @property
    def name(self) -> str:
        """What its matcher is called."""
        return f'{self.label}, k = {self.neighbours}'


CANDIDACIES = tuple(Candidacy(label, k) for label in RATIOS for k in NEIGHBOURS)


def curves_of(scores: Mapping[str, Score]) -> dict[str, list[Score]]:
    """The scores of all candidacies, by label, over rising k.

    Args:
        scores: By the name of the candidacy.
    """
    return {label: [scores[Candidacy(label, k).name] for k in NEIGHBOURS] for label in RATIOS}


def neighbours_figure(curves: Mapping[str, Sequence[Score]]) -> Figure:
    """Precision and recall on the left, errors of position and rotation on the right."""
    figure = Figure(figsize=(1.2 * WIDTH, 5.0), layout='constrained')
    panels: tuple[tuple[str, Callable[[Score], float]], ...] = (
        ('M.Precision [%]', lambda score: 100.0 * score.precision),
        ('MPE [‰ of the depth]', lambda score: score.position_permille),
        ('M.Recall [%]', lambda score: 100.0 * score.recall),
        ('MRE [deg]', lambda score: score.rotation_deg),
    )
    for axes, (title, value) in zip(figure.subplots(2, 2).flat, panels, strict=True):
        _draw(axes, title, {name: [value(one) for one in curve] for name, curve in curves.items()})
    figure.axes[0].legend(fontsize=LABEL_SIZE)
    return figure


def _draw(axes: Axes, title: str, curves: Mapping[str, Sequence[float]]) -> None:
    for label, values in curves.items():
        axes.plot(NEIGHBOURS, values, 'o-', markersize=4, color=COLOURS[label], label=label)
    axes.set_title(title, fontsize=LABEL_SIZE)
    axes.set_xlabel('k', fontsize=LABEL_SIZE)
    axes.set_xticks(NEIGHBOURS)
    finish(axes)
