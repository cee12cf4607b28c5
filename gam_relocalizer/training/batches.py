# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Batches of graphs of equal size, so that one pass of the network serves several graphs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from gam_relocalizer.matching.graph import CandidateGraphs

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from gam_relocalizer.training.labelled import LabelledGraph

STRIDE = 64
"""Sizes are multiples of it: matrix kernels are compiled anew for every size."""


@dataclass(frozen=True)
class GraphBatch:
    """B graphs side by side.

    Attributes:
        keypoints: [M, B, 2] normalised.
        points: [N, B, 3] normalised.
        edges: [T, B, 2] int64.
        distances: [T, B].
        labels: [T, B] bool.
        focal_lengths: [B], in the unit of the keypoints.
    """

    keypoints: NDArray[np.float32]
    points: NDArray[np.float32]
    edges: NDArray[np.int64]
    distances: NDArray[np.float32]
    labels: NDArray[np.bool_]
    focal_lengths: NDArray[np.float32]

    def graphs(self) -> CandidateGraphs:
        """What a network gets to see."""
        return CandidateGraphs(
            torch.from_numpy(self.keypoints),
            torch.from_numpy(self.points),
            torch.from_numpy(self.edges),
            torch.from_numpy(self.distances),
            torch.from_numpy(self.focal_lengths),
        )


def stacked(graphs: Sequence[LabelledGraph], rng: np.random.Generator) -> GraphBatch:
    """Bring graphs to one size: leave out random edges, repeat random edges, keypoints and points.

    Args:
        graphs: Their edges are brought to the mean number, rounded.
        rng: Chooses what is left out or repeated.
    """
    keypoints = _round_to_stride(max(len(graph.keypoints) for graph in graphs), up=True)
    points = _round_to_stride(max(len(graph.points) for graph in graphs), up=True)
    edges = _round_to_stride(float(np.mean([len(graph.edges) for graph in graphs])))
    return side_by_side([_resized(graph, keypoints, points, edges, rng) for graph in graphs])


def side_by_side(graphs: Sequence[LabelledGraph]) -> GraphBatch:
    """A batch of graphs that are of one size already."""
    return GraphBatch(
        keypoints=np.stack([graph.keypoints for graph in graphs], axis=1),
        points=np.stack([graph.points for graph in graphs], axis=1),
        edges=np.stack([graph.edges for graph in graphs], axis=1),
        distances=np.stack([graph.distances for graph in graphs], axis=1),
        labels=np.stack([graph.labels for graph in graphs], axis=1),
        focal_lengths=np.array([graph.focal_length for graph in graphs], np.float32),
    )


def _resized(
    graph: LabelledGraph, keypoints: int, points: int, edges: int, rng: np.random.Generator
) -> LabelledGraph:
    kept = _rows(len(graph.edges), edges, rng, shuffle=True)
    return replace(
        graph,
        keypoints=graph.keypoints[_rows(len(graph.keypoints), keypoints, rng)],
        points=graph.points[_rows(len(graph.points), points, rng)],
        edges=graph.edges[kept],
        distances=graph.distances[kept],
        labels=graph.labels[kept],
    )


def _rows(
    available: int, wanted: int, rng: np.random.Generator, *, shuffle: bool = False
) -> NDArray[np.int64]:
    """`wanted` rows: all of them and some twice, or (shuffled) a random part of them."""
    once = rng.permutation(available) if shuffle else np.arange(available)
    again = rng.integers(available, size=max(0, wanted - available))
    return np.concatenate([once[:wanted], again])


def _round_to_stride(number: float, *, up: bool = False) -> int:
    return STRIDE * int(np.ceil(number / STRIDE) if up else max(1, round(number / STRIDE)))
