# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import torch

from gam_relocalizer.matching.graph import CandidateGraphs
from gam_relocalizer.matching.lgcnet import LgcNet, LgcNetConfig

SMALL = LgcNetConfig(blocks=3, width=16)


def _net(config: LgcNetConfig = SMALL) -> LgcNet:
    torch.manual_seed(0)
    return LgcNet(config)


def test_default_is_the_published_size() -> None:
    net = LgcNet()

    assert net.config == LgcNetConfig(blocks=12, width=128)
    assert sum(weights.numel() for weights in net.parameters() if weights.ndim == 2) == (
        5 * 128 + 12 * 2 * 128 * 128 + 128
    )


def test_close_coordinates_are_told_apart_in_bfloat16() -> None:
    # 1 and 1.001 are the same number in bfloat16
    keypoints = torch.tensor([[1.0, 1.0], [1.001, 1.0], [0.0, 0.5], [0.3, 0.0]])[:, None]
    edges = torch.arange(4)[:, None, None].expand(4, 1, 2)
    graphs = CandidateGraphs(
        keypoints, torch.zeros(4, 1, 3), edges, torch.zeros(4, 1), torch.ones(1)
    )
    net = _net()

    with torch.autocast('cpu', torch.bfloat16):
        embedded = net.embedding(graphs)

    assert not torch.equal(embedded[0], embedded[1])
