# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import torch

from gam_relocalizer.matching.oanet import OaNet, OaNetConfig

SMALL = OaNetConfig(blocks=4, filters=2, width=16, clusters=8)


def _net(config: OaNetConfig = SMALL) -> OaNet:
    torch.manual_seed(0)
    return OaNet(config)


def test_default_is_the_published_size_with_fewer_clusters() -> None:
    net = OaNet()

    assert net.config == OaNetConfig(blocks=12, filters=6, width=128, clusters=128)
    assert len(net.before) == len(net.after) == 6
    assert len(net.filters) == 6


def test_filters_know_the_clusters_apart() -> None:
    """A network on sets alone would give the first cluster the same whatever order the rest has."""
    clusters = torch.randn(8, 1, 16, generator=torch.Generator().manual_seed(0))
    reordered = clusters[[0, 7, 6, 5, 4, 3, 2, 1]]
    filters = _net().filters

    assert not torch.allclose(filters(reordered)[0], filters(clusters)[0], rtol=1e-2, atol=1e-2)
