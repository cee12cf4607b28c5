# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import astuple
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from gam_relocalizer.matching.bmnet import BMNet, BMNetConfig
from gam_relocalizer.matching.graph import CandidateGraphs, MatchingNetwork
from gam_relocalizer.training.labelled import CandidateRule, LabelledGraph
from gam_relocalizer.training.metrics import average_precision, evaluate
from gam_relocalizer.training.sources import GraphSource

if TYPE_CHECKING:
    from collections.abc import Sequence


class Told(MatchingNetwork):
    """Answers what it is told."""

    def __init__(self, weights: Sequence[float]) -> None:
        super().__init__()
        self._logits = torch.logit(torch.tensor(weights))

    def forward(self, graphs: CandidateGraphs) -> torch.Tensor:
        return self._logits.expand(graphs.edges.shape[1], -1).T


def _graph(edges: list[tuple[int, int]], labels: list[bool]) -> LabelledGraph:
    count = 1 + max(max(edge) for edge in edges)
    return LabelledGraph(
        keypoints=np.zeros((count, 2), np.float32),
        points=np.ones((count, 3), np.float32),
        edges=np.array(edges),
        distances=np.ones(len(edges), np.float32),
        labels=np.array(labels),
        focal_length=1.0,
    )


def test_average_precision_by_hand() -> None:
    labels = np.array([True, False, True, False])

    assert average_precision(labels, np.array([0.9, 0.8, 0.7, 0.1]), 2) == pytest.approx(5 / 6)
    assert average_precision(labels, np.array([0.9, 0.8, 0.7, 0.1]), 4) == pytest.approx(5 / 12)
    assert average_precision(labels, np.array([0.9, 0.1, 0.8, 0.2]), 2) == 1.0
    assert average_precision(np.zeros(3, dtype=bool), np.ones(3), 0) == 0.0


def test_metrics_by_hand() -> None:
    # pooling takes the first, the third and the fourth; of two true edges that exclude each other
    # one is out of reach
    graph = _graph(
        [(0, 0), (0, 1), (1, 1), (2, 2), (3, 3), (4, 3)], [True, False, False, True, True, True]
    )

    metrics = evaluate(Told([0.9, 0.6, 0.7, 0.3, 0.8, 0.2]), [graph])

    assert metrics.precision == pytest.approx(3 / 4)
    assert metrics.recall == pytest.approx(1.0)
    assert metrics.confident_precision == pytest.approx(2 / 3)
    assert metrics.confident_recall == pytest.approx(2 / 3)
    assert metrics.average_precision == pytest.approx((1 + 1 + 3 / 4) / 3)


def test_metrics_are_means_over_graphs() -> None:
    graphs = [_graph([(0, 0)], [True]), _graph([(0, 0)], [True])]
    good, bad = Told([0.9]), Told([0.1])

    assert astuple(evaluate(good, graphs)) == (1, 1, 1, 1, 1)
    assert astuple(evaluate(bad, graphs)) == (1, 1, 0, 0, 1)


def test_metrics_of_an_untrained_net_are_shares() -> None:
    torch.manual_seed(0)
    net = BMNet(BMNetConfig(point_blocks=3, edge_blocks=2, point_width=8))
    graphs = GraphSource(CandidateRule(), (100, 150), (300, 400)).validation(3)

    metrics = evaluate(net, graphs)

    assert 0 < metrics.precision < 0.7
    assert 0 < metrics.recall <= 1
    assert 0 < metrics.average_precision < metrics.recall
    assert metrics.confident_recall <= metrics.recall
