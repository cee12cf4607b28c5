# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What every matching network looks at: bipartite graphs of candidate matches."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from torch import nn

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True)
class CandidateGraphs:
    """B graphs of equal size, side by side; a network treats each by itself.

    Attributes:
        keypoints: [M, B, 2] float32, as `normalise_keypoints` gives them.
        points: [N, B, 3] float32, as `normalise_points` gives them.
        edges: [T, B, 2] int64 (keypoint, point).
        distances: [T, B] float32, Euclidean distance of the two unit descriptors of an edge.
        focal_lengths: [B] float32, in the unit of the keypoints.
    """

    keypoints: torch.Tensor
    points: torch.Tensor
    edges: torch.Tensor
    distances: torch.Tensor
    focal_lengths: torch.Tensor


class MatchingNetwork(nn.Module, ABC):
    """Judges candidate matches.

    Attributes:
        compares_looks: Whether it makes use of the distances, and so is used to an extractor.
        config: Frozen dataclass of its kind and size.
    """

    compares_looks: ClassVar[bool] = False
    config: Any

    @abstractmethod
    def forward(self, graphs: CandidateGraphs) -> torch.Tensor:
        """[T, B] logits; their sigmoid is the probability that an edge is a true match."""
