# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""OANet-2D3D, a baseline of the paper: OANet on 2D-3D instead of 2D-2D correspondences.

Zhang et al., 'Learning Two-View Correspondences and Geometry Using Order-Aware Network', ICCV
2019. Its first stage: the second refines with the epipolar residuals of an essential matrix, and
a camera and points have none.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import torch
from torch import nn
from torch.nn import functional

from gam_relocalizer.matching.bmnet import Block, ContextNorm
from gam_relocalizer.matching.graph import MatchingNetwork
from gam_relocalizer.matching.lgcnet import CorrespondenceEmbedding

if TYPE_CHECKING:
    from gam_relocalizer.matching.graph import CandidateGraphs


@dataclass(frozen=True)
class OaNetConfig:
    """Size of the network; the default is the published one but for the clusters.

    Attributes:
        blocks: Blocks on correspondences: one half before the clusters, the other half after.
        filters: Order-aware blocks on clusters.
        width: Features per correspondence and per cluster.
        clusters: Groups that the correspondences are pooled to. As published, about a quarter of
            the correspondences of an image: 500 of 2000 there, 128 of some 500 here.
    """

    blocks: int = 12
    filters: int = 6
    width: int = 128
    clusters: int = 128


class OaNet(MatchingNetwork):
    """Correspondences, pooled to clusters in a learned order and back."""

    def __init__(self, config: OaNetConfig | None = None) -> None:
        super().__init__()
        self.config = config or OaNetConfig()
        width, before = self.config.width, self.config.blocks // 2
        after = self.config.blocks - before
        self.embedding = CorrespondenceEmbedding(width)
        self.before = _blocks([width] * (before + 1))
        self.pool = _Assignment(self.config)
        self.filters = nn.Sequential(*(_Filter(self.config) for _ in range(self.config.filters)))
        self.unpool = _Assignment(self.config)
        self.after = _blocks([2 * width] + [width] * after)
        self.logit = nn.Linear(width, 1)

    def forward(self, graphs: CandidateGraphs) -> torch.Tensor:
        """See `MatchingNetwork.forward`."""
        features = self.before(self.embedding(graphs))
        to_clusters = self.pool(features).softmax(dim=0)
        clusters = self.filters(torch.einsum('tbc,tbw->cbw', to_clusters, features))
        from_clusters = self.unpool(features).softmax(dim=2)
        context = torch.einsum('tbc,cbw->tbw', from_clusters, clusters)
        logits: torch.Tensor = self.logit(self.after(torch.cat([features, context], dim=2)))
        return logits[..., 0].float()


class _Assignment(nn.Module):
    """How much every correspondence has to do with every cluster; no order of edges matters."""

    def __init__(self, config: OaNetConfig) -> None:
        super().__init__()
        self.norm = ContextNorm(config.width)
        self.linear = nn.Linear(config.width, config.clusters)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """[T, B, width] -> [T, B, clusters] before the softmax."""
        scores: torch.Tensor = self.linear(functional.relu(self.norm(features)))
        return scores


class _Filter(nn.Module):
    """A perceptron on clusters, one across them, another on them, each with its norm before it."""

    def __init__(self, config: OaNetConfig) -> None:
        super().__init__()
        self.norms = nn.ModuleList(
            ContextNorm(width) for width in (config.width, config.clusters, config.width)
        )
        self.first = nn.Linear(config.width, config.width, bias=False)
        self.across = nn.Linear(config.clusters, config.clusters)
        self.last = nn.Linear(config.width, config.width, bias=False)

    def forward(self, clusters: torch.Tensor) -> torch.Tensor:
        """[clusters, B, width] -> the same."""
        hidden = self.first(functional.relu(self.norms[0](clusters)))
        # normalised per cluster over its features, for here the clusters are the features
        turned = hidden.transpose(0, 2)
        hidden = hidden + self.across(functional.relu(self.norms[1](turned))).transpose(0, 2)
        shortcut: torch.Tensor = clusters + self.last(functional.relu(self.norms[2](hidden)))
        return shortcut


def _blocks(widths: list[int]) -> nn.Sequential:
    return nn.Sequential(*(Block(a, b, perceptrons=2) for a, b in pairwise(widths)))
