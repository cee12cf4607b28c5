# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""GamNet: the probability of every candidate match, from where it leads and how alike it looks.

It differs from the paper's BMNet in what it is told about an edge. BMNet embeds the keypoint and
the point each by itself, and has to learn what makes the two fit. GamNet is told how the line of
sight turns from the reference camera to the query, which for true matches is a smooth flow, and
how the edge compares in appearance with the others of its keypoint and of its point. The layers
after that are those of BMNet's edge net, half as many and half as wide.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import nn
from torch.nn import functional

from gam_relocalizer.matching.bmnet import Block, ContextNorm
from gam_relocalizer.matching.graph import CandidateGraphs, MatchingNetwork

GEOMETRY = 10
APPEARANCE = 9
# The turn of a line of sight is small beside its direction.
TURN_SCALE = 4.0
NEAREST = 1e-3
GREATEST_INVERSE = 5.0
# An only candidate was so much better than the next that the next is not known.
LONELY_RATIO = 0.6


@dataclass(frozen=True)
class GamNetConfig:
    """Size of the network.

    Attributes:
        blocks: Blocks of two perceptrons.
        width: Features per edge.
    """

    blocks: int = 9
    width: int = 128


class GamNet(MatchingNetwork):
    """Edges that know of each other by context normalisation and by their rivals."""

    compares_looks: ClassVar[bool] = True

    def __init__(self, config: GamNetConfig | None = None) -> None:
        super().__init__()
        self.config = config or GamNetConfig()
        width = self.config.width
        self.embedding = nn.Linear(GEOMETRY + APPEARANCE, width)
        self.edge_net = nn.Sequential(
            nn.ReLU(),
            nn.Linear(width, width),
            *(Block(width, width, perceptrons=2) for _ in range(self.config.blocks)),
            ContextNorm(width),
            nn.ReLU(),
            nn.Linear(width, 1),
        )

    def forward(self, graphs: CandidateGraphs) -> torch.Tensor:
        """See `MatchingNetwork.forward`."""
        # bfloat16, where training uses it, is too coarse for coordinates
        with torch.autocast(graphs.points.device.type, enabled=False):
            told = torch.cat([_geometry(graphs), _appearance(graphs)], dim=2)
            embedded = self.embedding(told)
        logits: torch.Tensor = self.edge_net(embedded)
        return logits[..., 0].float()


def _geometry(graphs: CandidateGraphs) -> torch.Tensor:
    """[T, B, 10]: both lines of sight, the turn from one to the other, the inverse distance."""
    graph = torch.arange(graphs.edges.shape[1], device=graphs.edges.device)
    on_plane = graphs.keypoints / graphs.focal_lengths[:, None]
    sights = functional.normalize(functional.pad(on_plane, (0, 1), value=1.0), dim=2)
    distances = graphs.points.norm(dim=2, keepdim=True).clamp_min(NEAREST)
    references = graphs.points / distances
    of_keypoint = sights[graphs.edges[..., 0], graph]
    of_point = references[graphs.edges[..., 1], graph]
    inverse = (1.0 / distances).clamp_max(GREATEST_INVERSE)[graphs.edges[..., 1], graph]
    turn = TURN_SCALE * (of_keypoint - of_point)
    return torch.cat([of_keypoint, of_point, turn, inverse], dim=2)


def _appearance(graphs: CandidateGraphs) -> torch.Tensor:
    """[T, B, 9]: the distance itself, and how it compares at the keypoint and at the point."""
    distances = graphs.distances.clamp_min(NEAREST)
    at_keypoint = _compared(distances, graphs.edges[..., 0], len(graphs.keypoints))
    at_point = _compared(distances, graphs.edges[..., 1], len(graphs.points))
    return torch.cat([distances[..., None], at_keypoint, at_point], dim=2)


def _compared(distances: torch.Tensor, ends: torch.Tensor, count: int) -> torch.Tensor:
    """[T, B, 4]: an edge among those that share its keypoint or point.

    Best distance over its own, best over second best if it is the best (else 1), whether it is the
    best, and one over their number.
    """
    graphs = distances.shape[1]
    nodes = (ends * graphs + torch.arange(graphs, device=ends.device)).flatten()
    flat = distances.flatten()
    far = torch.full((count * graphs,), torch.inf, device=flat.device)
    best = far.scatter_reduce(0, nodes, flat, 'amin')[nodes]
    is_best = flat <= best
    others = torch.where(is_best, torch.inf, flat)
    second = far.scatter_reduce(0, nodes, others, 'amin')[nodes]
    ratio = torch.where(second.isinf(), LONELY_RATIO, best / second)
    degree = torch.zeros_like(far).index_add(0, nodes, torch.ones_like(flat))[nodes]
    features = [best / flat, torch.where(is_best, ratio, 1.0), is_best.float(), 1.0 / degree]
    return torch.stack(features, dim=1).view(*distances.shape, 4)
