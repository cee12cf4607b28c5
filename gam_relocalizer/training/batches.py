# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Batches of graphs of equal size, so that one pass of the network serves several graphs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.training.synthetic import LabelledGraph, labelled_graph

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

EDGES_PER_KEYPOINT = 2.75
STRIDE = 64
"""Sizes are multiples of it: matrix kernels are compiled anew for every size."""


@dataclass(frozen=True)
class GraphBatch:
    """B graphs side by side.

    Attributes:
        keypoints: [M, B, 2] normalised.
        points: [N, B, 3] normalised.
        edges: [T, B, 2] int64.
        labels: [T, B] bool.
    """

    keypoints: NDArray[np.float32]
    points: NDArray[np.float32]
    edges: NDArray[np.int64]
    labels: NDArray[np.bool_]


def random_batch(
    rng: np.random.Generator, graphs: int, keypoints: tuple[int, int], points: tuple[int, int]
) -> GraphBatch:
    """Draw `graphs` graphs; every second one is the mirror image of the one before.

    The mirror image of a scene and of its view is as good a scene, and costs nothing to make.
    """
    count = max(STRIDE, _round_to_stride(np.exp(rng.uniform(*np.log(keypoints)))))
    drawn: list[LabelledGraph] = []
    while len(drawn) < graphs:
        graph = labelled_graph(rng, (count, count), points)
        drawn += [graph, mirrored(graph)]
    return stacked(drawn[:graphs], count, rng)


def mirrored(graph: LabelledGraph) -> LabelledGraph:
    """The graph as a mirror shows it: left and right change places in image and scene."""
    return replace(
        graph,
        keypoints=graph.keypoints * np.array([-1, 1], np.float32),
        points=graph.points * np.array([-1, 1, 1], np.float32),
    )


def stacked(
    graphs: Sequence[LabelledGraph], keypoints: int, rng: np.random.Generator
) -> GraphBatch:
    """Bring graphs to one size: leave out random edges, repeat random edges, keypoints and points.

    Args:
        graphs: Each with at most `keypoints` keypoints.
        keypoints: M of the batch; it has 2.75 edges for each.
        rng: Chooses what is left out or repeated.
    """
    points = _round_to_stride(max(len(graph.points) for graph in graphs), up=True)
    edges = _round_to_stride(EDGES_PER_KEYPOINT * keypoints)
    rows_of_keypoints = [_rows(len(graph.keypoints), keypoints, rng) for graph in graphs]
    rows_of_points = [_rows(len(graph.points), points, rng) for graph in graphs]
    rows_of_edges = [_rows(len(graph.edges), edges, rng, shuffle=True) for graph in graphs]
    pick = zip(graphs, rows_of_keypoints, rows_of_points, rows_of_edges, strict=True)
    parts = [(g.keypoints[k], g.points[p], g.edges[e], g.labels[e]) for g, k, p, e in pick]
    return GraphBatch(*(np.stack(part, axis=1) for part in zip(*parts, strict=True)))


def _rows(
    available: int, wanted: int, rng: np.random.Generator, *, shuffle: bool = False
) -> NDArray[np.int64]:
    """`wanted` rows: all of them and some twice, or (shuffled) a random part of them."""
    once = rng.permutation(available) if shuffle else np.arange(available)
    again = rng.integers(available, size=max(0, wanted - available))
    return np.concatenate([once[:wanted], again])


def _round_to_stride(number: float, *, up: bool = False) -> int:
    return STRIDE * int(np.ceil(number / STRIDE) if up else max(1, round(number / STRIDE)))
