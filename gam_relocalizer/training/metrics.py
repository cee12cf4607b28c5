# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""How well pooled matches agree with the truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from gam_relocalizer.matching.pooling import hungarian_pooling
from gam_relocalizer.training.batches import side_by_side

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from gam_relocalizer.matching.graph import MatchingNetwork
    from gam_relocalizer.training.labelled import LabelledGraph

CONFIDENT = 0.5


@dataclass(frozen=True)
class MatchMetrics:
    """Means over graphs.

    Attributes:
        precision: Share of the pooled edges that are true.
        recall: True pooled edges over the most that any one-to-one matching could hold.
        confident_precision: As `precision`, of pooled edges with a weight of 0.5 or more.
        confident_recall: As `recall`, of pooled edges with a weight of 0.5 or more.
        average_precision: Area under precision over recall as the weight threshold falls.
    """

    precision: float
    recall: float
    confident_precision: float
    confident_recall: float
    average_precision: float


def evaluate(net: MatchingNetwork, graphs: Sequence[LabelledGraph]) -> MatchMetrics:
    """Metrics of a network on labelled graphs."""
    rows = []
    with torch.inference_mode():
        for graph in graphs:
            logits = net(side_by_side([graph]).graphs())
            rows.append(_of_graph(graph, torch.sigmoid(logits[:, 0]).numpy()))
    return MatchMetrics(*(float(value) for value in np.mean(rows, axis=0)))


def average_precision(labels: NDArray[np.bool_], weights: NDArray[Any], reachable: int) -> float:
    """Sum of the precision at every true edge, by falling weight, over the reachable true edges."""
    by_weight = labels[np.argsort(-weights, kind='stable')]
    precision = np.cumsum(by_weight) / np.arange(1, len(by_weight) + 1)
    return float(precision[by_weight].sum() / max(1, reachable))


def _of_graph(graph: LabelledGraph, weights: NDArray[np.float32]) -> tuple[float, ...]:
    reachable = int(
        graph.labels[hungarian_pooling(graph.edges, graph.labels.astype(np.float64))].sum()
    )
    pooled = hungarian_pooling(graph.edges, weights)
    labels, pooled_weights = graph.labels[pooled], weights[pooled]
    confident = labels[pooled_weights >= CONFIDENT]
    return (
        labels.mean(),
        labels.sum() / reachable,
        confident.sum() / max(1, len(confident)),
        confident.sum() / reachable,
        average_precision(labels, pooled_weights, reachable),
    )
