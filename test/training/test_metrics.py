# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
import torch

from gam_relocalizer.matching.bmnet import BMNet, BMNetConfig
from gam_relocalizer.training.metrics import average_precision, evaluate
from gam_relocalizer.training.synthetic import labelled_graph


def test_average_precision_by_hand() -> None:
    labels = np.array([True, False, True, False])

    assert average_precision(labels, np.array([0.9, 0.8, 0.7, 0.1]), 2) == pytest.approx(5 / 6)
    assert average_precision(labels, np.array([0.9, 0.8, 0.7, 0.1]), 4) == pytest.approx(5 / 12)
    assert average_precision(labels, np.array([0.9, 0.1, 0.8, 0.2]), 2) == 1.0
    assert average_precision(np.zeros(3, dtype=bool), np.ones(3), 0) == 0.0


def test_metrics_of_an_untrained_net_are_shares() -> None:
    torch.manual_seed(0)
    net = BMNet(BMNetConfig(point_blocks=3, edge_blocks=2, point_width=8))
    graphs = [labelled_graph(np.random.default_rng(i), (100, 150), (300, 400)) for i in range(3)]

    metrics = evaluate(net, graphs)

    assert 0 < metrics.precision < 0.7
    assert 0 < metrics.recall <= 1
    assert 0 < metrics.average_precision < metrics.recall
    assert metrics.confident_recall <= metrics.recall
