# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What a network learns from: candidate graphs with the truth about every edge."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from gam_relocalizer.matching.bmnet import normalise_points
from gam_relocalizer.matching.candidates import Candidates, knn_ratio

if TYPE_CHECKING:
    from numpy.typing import NDArray

TRUE_ERROR = 0.01 / 1.2
"""Reprojection error below which an edge is true: 1 % of the longer side, normalised."""


class View(Protocol):
    """A query and the retrieved part of a map, as a matcher gets them, and the truth."""

    @property
    def keypoints(self) -> NDArray[np.float32]:
        """[M, 2] normalised keypoints."""

    @property
    def focal_length(self) -> float:
        """In the unit of the keypoints."""

    @property
    def descriptors(self) -> NDArray[np.float32]:
        """[M, D] of the keypoints, unit."""

    @property
    def points(self) -> NDArray[np.float32]:
        """[N, 3] in the frame of a reference camera near the query, any unit."""

    @property
    def point_descriptors(self) -> NDArray[np.float32]:
        """[N, D] of the points, unit."""

    def labels(self, edges: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which of the edges [T, 2] are true."""


@dataclass(frozen=True)
class CandidateRule:
    """How the edges of a training graph are found.

    Attributes:
        neighbours: See `knn_ratio`.
        ratio: See `knn_ratio`.
        mining: Whether false edges are those that kNN ratio matching finds (section 'Negative
            Sample Mining'), and not as many random ones.
    """

    neighbours: int = 3
    ratio: float = 0.7
    mining: bool = True


@dataclass(frozen=True)
class LabelledGraph:
    """Input of a matching network and the labels of its edges.

    Attributes:
        keypoints: [M, 2] normalised, only those with an edge.
        points: [N, 3] normalised, only those with an edge.
        edges: [T, 2] int64.
        distances: [T] float32, between the two unit descriptors of an edge.
        labels: [T] bool.
        focal_length: In the unit of the keypoints.
    """

    keypoints: NDArray[np.float32]
    points: NDArray[np.float32]
    edges: NDArray[np.int64]
    distances: NDArray[np.float32]
    labels: NDArray[np.bool_]
    focal_length: float


def meet(
    edges: NDArray[np.int64], keypoints: NDArray[np.floating], projections: NDArray[np.floating]
) -> NDArray[np.bool_]:
    """Which edges [T, 2] join a keypoint and a point that truly projects there.

    This is the truth that a pose solver sees: a double of the point, or a point that is hidden but
    on the same line of sight, is no error of geometry.
    """
    offsets = keypoints[edges[:, 0]] - projections[edges[:, 1]]
    return np.asarray(np.linalg.norm(offsets, axis=1) < TRUE_ERROR)


def labelled_graph(view: View, rule: CandidateRule, rng: np.random.Generator) -> LabelledGraph:
    """The graph of a view, without the keypoints and points that have no edge."""
    candidates = knn_ratio(view.descriptors, view.point_descriptors, rule.neighbours, rule.ratio)
    labels = view.labels(candidates.edges)
    if not rule.mining:
        candidates = _with_random_negatives(candidates, labels, view, rng)
        labels = view.labels(candidates.edges)
    used_keypoints, rows = np.unique(candidates.edges[:, 0], return_inverse=True)
    used_points, columns = np.unique(candidates.edges[:, 1], return_inverse=True)
    return LabelledGraph(
        keypoints=view.keypoints[used_keypoints],
        points=normalise_points(view.points[used_points]),
        edges=np.stack([rows, columns], axis=1),
        distances=candidates.distances,
        labels=labels,
        focal_length=view.focal_length,
    )


def _with_random_negatives(
    candidates: Candidates, labels: NDArray[np.bool_], view: View, rng: np.random.Generator
) -> Candidates:
    """Candidates whose false edges join any keypoint with any point."""
    edges = candidates.edges.copy()
    sizes = [len(view.keypoints), len(view.points)]
    edges[~labels] = rng.integers(sizes, size=(int((~labels).sum()), 2))
    offsets = view.descriptors[edges[:, 0]] - view.point_descriptors[edges[:, 1]]
    return Candidates(edges, np.linalg.norm(offsets, axis=1).astype(np.float32))


def mirrored(graph: LabelledGraph) -> LabelledGraph:
    """The graph as a mirror shows it: left and right change places in image and scene.

    The mirror image of a scene and of its view is as good a scene, and costs nothing to make.
    """
    return replace(
        graph,
        keypoints=graph.keypoints * np.array([-1, 1], np.float32),
        points=graph.points * np.array([-1, 1, 1], np.float32),
    )
