# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Candidate 2D-3D matches by appearance: the kNN ratio matching of the paper."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

if TYPE_CHECKING:
    from numpy.typing import NDArray

BLOCK = 2048
GROUP = 32


@dataclass(frozen=True)
class Candidates:
    """Edges of a bipartite graph between keypoints and points.

    Attributes:
        edges: [T, 2] int64, (keypoint, point), sorted by keypoint, then by distance.
        distances: [T] float32, Euclidean distance of the two unit descriptors.
    """

    edges: NDArray[np.int64]
    distances: NDArray[np.float32]


def knn_ratio(
    descriptors: NDArray[Any],
    point_descriptors: NDArray[Any],
    k: int = 3,
    ratio: float = 0.7,
) -> Candidates:
    """Connect every keypoint with its nearest points (section 'Problem Formulation').

    The nearest point is always a candidate, the j-th one if d1 / dj >= ratio: 1 leaves the nearest
    neighbour (and its exact ties), 0 gives plain k nearest neighbours. Rows that are zero or not
    finite have no direction to compare and take no part. Equal distances go by lower index.

    Args:
        descriptors: [M, D] of the keypoints.
        point_descriptors: [N, D] of the points, float16 or float32, possibly memory-mapped: they
            are read block by block, so that memory does not grow with N.
        k: Neighbours looked at; fewer where there are fewer points.
        ratio: Least ratio of the nearest distance to the candidate's distance, in [0, 1].
    """
    count = min(k, len(point_descriptors))
    queries, keypoints = _usable_directions(descriptors)
    if count < 1 or not len(keypoints):
        return Candidates(np.empty((0, 2), np.int64), np.empty(0, np.float32))
    with torch.inference_mode():
        neighbours = _nearest(queries, point_descriptors, count)
        distances = _exact_distances(queries, point_descriptors, neighbours)
    order = np.argsort(distances, axis=1, kind='stable')
    distances = np.take_along_axis(distances, order, axis=1)
    neighbours = np.take_along_axis(neighbours, order, axis=1)

    ratios = np.ones_like(distances)
    comparable = np.isfinite(distances) & (distances > 0)
    np.divide(distances[:, :1], distances, out=ratios, where=comparable)
    kept = ratios >= ratio
    kept[:, 0] = True
    kept &= np.isfinite(distances)
    rows, columns = np.nonzero(kept)
    edges = np.stack([keypoints[rows], neighbours[rows, columns]], axis=1)
    return Candidates(edges, distances[rows, columns])


def _usable_directions(descriptors: NDArray[Any]) -> tuple[torch.Tensor, NDArray[np.int64]]:
    """Unit rows [Q, D] of the usable descriptors and their indices [Q]."""
    rows = np.asarray(descriptors, dtype=np.float32)
    if not rows.size:
        return torch.empty((0, 0)), np.empty(0, np.int64)
    unit, usable = _unit_rows(rows)
    return unit[usable], np.flatnonzero(usable.numpy())


def _unit_rows(rows: NDArray[np.float32]) -> tuple[torch.Tensor, torch.Tensor]:
    """Unit rows, zero where a row is not usable, and which rows are usable."""
    tensor = torch.tensor(rows)
    norms = tensor.norm(dim=1, keepdim=True)
    usable = torch.isfinite(norms) & (norms > 0)
    unit = torch.where(usable, tensor / norms, 0.0)
    return unit, usable[:, 0]


def _nearest(
    queries: torch.Tensor, point_descriptors: NDArray[Any], count: int
) -> NDArray[np.int64]:
    """Indices [Q, count] of the points with the greatest cosine, greatest first."""
    best = torch.full((len(queries), 0), -torch.inf)
    index = torch.empty((len(queries), 0), dtype=torch.int64)
    for start in range(0, len(point_descriptors), BLOCK):
        block, usable = _unit_rows(np.asarray(point_descriptors[start : start + BLOCK], np.float32))
        block_best, block_index = _greatest_of_block(queries, block, usable, count)
        best = torch.cat([best, block_best], dim=1)
        best, chosen = _greatest(best, min(count, best.shape[1]))
        index = torch.cat([index, block_index + start], dim=1).gather(1, chosen)
    return np.asarray(index.numpy())


def _greatest_of_block(
    queries: torch.Tensor, block: torch.Tensor, usable: torch.Tensor, count: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """The `count` greatest cosines of every query within a block, and their columns.

    They lie in the `count` groups of columns with the greatest maxima, and maxima of groups are
    much cheaper than a selection over whole rows.
    """
    groups = -(-len(block) // GROUP)
    cosines = torch.empty(len(queries), groups * GROUP)
    torch.matmul(queries, block.T, out=cosines[:, : len(block)])
    cosines[:, len(block) :] = -torch.inf
    cosines[:, torch.nonzero(~usable)[:, 0]] = -torch.inf
    grouped = cosines.view(len(queries), groups, GROUP)
    _, best_groups = _greatest(grouped.amax(dim=2), min(count, groups))
    best_groups = best_groups.sort(dim=1).values
    members = grouped.gather(1, best_groups[:, :, None].expand(-1, -1, GROUP)).flatten(1)
    best, chosen = _greatest(members, min(count, len(block)))
    columns = best_groups.gather(1, chosen // GROUP) * GROUP + chosen % GROUP
    # a padded column can only follow when fewer points are usable than asked for
    return best, columns.clamp_(max=len(block) - 1)


def _greatest(values: torch.Tensor, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The `count` greatest entries of every row; unlike topk, equal ones go by lower index."""
    rest = values.clone()
    best, index = [], []
    for _ in range(count):
        greatest, column = rest.max(dim=1, keepdim=True)
        best.append(greatest)
        index.append(column)
        rest.scatter_(1, column, -torch.inf)
    return torch.cat(best, dim=1), torch.cat(index, dim=1)


def _exact_distances(
    queries: torch.Tensor, point_descriptors: NDArray[Any], neighbours: NDArray[np.int64]
) -> NDArray[np.float32]:
    """Distances [Q, k]; infinite for unusable points and for a neighbour listed twice.

    Recomputed from differences, because sqrt(2 - 2 cos) loses half of the digits near zero.
    """
    wanted, position = np.unique(neighbours, return_inverse=True)
    unit, usable = _unit_rows(np.asarray(point_descriptors[wanted], np.float32))
    place = torch.tensor(position.reshape(neighbours.shape))
    distances = (queries[:, None, :] - unit[place]).norm(dim=2)
    distances[~usable[place]] = torch.inf
    for column in range(1, neighbours.shape[1]):
        repeated = (place[:, :column] == place[:, column : column + 1]).any(dim=1)
        distances[repeated, column] = torch.inf
    return np.asarray(distances.numpy(), np.float32)
