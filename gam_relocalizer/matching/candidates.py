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

BLOCK = 2048  # points read at once
TILE = 512  # most keypoints compared at once with a block: the cosines stay in the cache
GROUP = 32
NO_POINT = -1
NO_COSINE = torch.finfo(torch.float32).min  # greater than -inf, which marks what was taken


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
    if count < 1 or not len(descriptors):
        return Candidates(np.empty((0, 2), np.int64), np.empty(0, np.float32))
    with torch.inference_mode():
        directions, usable = _directions(descriptors)
        queries, keypoints = directions[usable], np.flatnonzero(usable.numpy())
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


def _directions(rows: NDArray[Any]) -> tuple[torch.Tensor, torch.Tensor]:
    """Unit rows [S, D] float32, and which of them [S] could be made so; the others are no use."""
    directions = torch.tensor(rows).float()
    norms = directions.norm(dim=1)
    directions /= norms[:, None]
    return directions, torch.isfinite(norms) & (norms > 0)


def _nearest(
    queries: torch.Tensor, point_descriptors: NDArray[Any], count: int
) -> NDArray[np.int64]:
    """Indices [Q, count] of the points with the greatest cosine, greatest first, or `NO_POINT`."""
    parts = queries.tensor_split(len(queries) // TILE + 1)
    tiles = [_NearestGroups(part, count) for part in parts]
    for start in range(0, len(point_descriptors), BLOCK):
        directions, usable = _directions(point_descriptors[start : start + BLOCK])
        for tile in tiles:
            tile.look_at(directions, usable, start)
    return np.asarray(torch.cat([tile.nearest_points() for tile in tiles]).numpy())


class _NearestGroups:
    """The `count` groups of successive points with the greatest cosines to some queries.

    The `count` points with the greatest cosines are among them, and maxima of groups are much
    cheaper than a selection over all points.
    """

    def __init__(self, queries: torch.Tensor, count: int) -> None:
        self._queries = queries
        self._count = count
        self._cosines = torch.full((len(queries), count, GROUP), NO_COSINE)
        self._starts = torch.zeros((len(queries), count), dtype=torch.int64)

    def look_at(self, directions: torch.Tensor, usable: torch.Tensor, start: int) -> None:
        """Take in a block of points, of which `start` is the index of the first."""
        starts = torch.arange(start, start + len(directions), GROUP)
        cosines = torch.empty(len(self._queries), self._count + len(starts), GROUP)
        cosines[:, : self._count] = self._cosines
        block = cosines.flatten(1)[:, self._count * GROUP :]
        torch.matmul(self._queries, directions.T, out=block[:, : len(directions)])
        block[:, len(directions) :] = NO_COSINE
        if not usable.all():
            block[:, torch.nonzero(~usable)[:, 0]] = NO_COSINE

        _, chosen = _greatest(cosines.amax(dim=2), self._count)
        chosen = chosen.sort(dim=1).values
        all_starts = torch.cat([self._starts, starts.expand(len(self._queries), -1)], dim=1)
        self._starts = all_starts.gather(1, chosen)
        self._cosines = cosines.gather(1, chosen[:, :, None].expand(-1, -1, GROUP))

    def nearest_points(self) -> torch.Tensor:
        """[Q, count] indices, greatest cosine first; `NO_POINT` where too few are usable."""
        greatest, member = _greatest(self._cosines.flatten(1), self._count)
        index = self._starts.gather(1, member // GROUP) + member % GROUP
        return torch.where(greatest > NO_COSINE, index, NO_POINT)


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
    """Distances [Q, count], infinite where there is no point.

    Recomputed from differences, because sqrt(2 - 2 cos) loses half of the digits near zero.
    """
    directions, _ = _directions(point_descriptors[neighbours.ravel()])
    differences = queries[:, None, :] - directions.view(*neighbours.shape, directions.shape[1])
    distances = np.asarray(differences.norm(dim=2).numpy())
    distances[neighbours == NO_POINT] = np.inf
    return distances
