# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""LGCNet-2D3D, a baseline of the paper: LGC-Net on 2D-3D instead of 2D-2D correspondences.

Yi et al., 'Learning to Find Good Correspondences', CVPR 2018.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import nn
from torch.nn import functional

from gam_relocalizer.matching.bmnet import ContextNorm
from gam_relocalizer.matching.graph import MatchingNetwork

if TYPE_CHECKING:
    from gam_relocalizer.matching.graph import CandidateGraphs


@dataclass(frozen=True)
class LgcNetConfig:
    """Size of the network; the default is the published one.

    Attributes:
        blocks: Residual blocks, of two perceptrons each.
        width: Features per correspondence.
    """

    blocks: int = 12
    width: int = 128


class CorrespondenceEmbedding(nn.Module):
    """A perceptron on (x, y, X, Y, Z) of every edge: the ends of an edge are seen as one."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.linear = nn.Linear(5, width)

    def forward(self, graphs: CandidateGraphs) -> torch.Tensor:
        """[T, B, width]."""
        graph = torch.arange(graphs.edges.shape[1], device=graphs.edges.device)
        keypoints = graphs.keypoints[graphs.edges[..., 0], graph]
        points = graphs.points[graphs.edges[..., 1], graph]
        # bfloat16, where training uses it, is too coarse for coordinates
        with torch.autocast(keypoints.device.type, enabled=False):
            embedded: torch.Tensor = self.linear(torch.cat([keypoints, points], dim=2))
        return embedded


class LgcNet(MatchingNetwork):
    """Residual blocks of perceptrons that know of each other by context normalisation alone."""

    def __init__(self, config: LgcNetConfig | None = None) -> None:
        super().__init__()
        self.config = config or LgcNetConfig()
        self.embedding = CorrespondenceEmbedding(self.config.width)
        self.blocks = nn.Sequential(
            *(_Block(self.config.width) for _ in range(self.config.blocks)),
        )
        self.logit = nn.Linear(self.config.width, 1)

    def forward(self, graphs: CandidateGraphs) -> torch.Tensor:
        """See `MatchingNetwork.forward`."""
        logits: torch.Tensor = self.logit(self.blocks(self.embedding(graphs)))
        return logits[..., 0].float()


class _Block(nn.Module):
    """Two times (linear, context and batch norm, ReLU), with a shortcut around them."""

    def __init__(self, width: int) -> None:
        super().__init__()
        # the norm that follows takes a bias out again
        self.linears = nn.ModuleList(nn.Linear(width, width, bias=False) for _ in range(2))
        self.norms = nn.ModuleList(ContextNorm(width) for _ in range(2))

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """[T, B, width] -> the same."""
        hidden = features
        for linear, norm in zip(self.linears, self.norms, strict=True):
            hidden = functional.relu(norm(linear(hidden)))
        return features + hidden
