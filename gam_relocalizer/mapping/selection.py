# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Which images and points of a map tell most: greedy orders of which any beginning is a good map.

Both maximise a sum with diminishing returns, so that the greedy order is never far from the best
choice of any size (Nemhauser et al., 1978), and what a candidate would add only has to be looked at
again when it comes to the top (Minoux, 1978). Choosing points so that every image keeps enough of
them goes back to Li et al. (ECCV 2010).
"""

from __future__ import annotations

import heapq
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from numpy.typing import NDArray
    from scipy.sparse import csr_matrix

    from gam_relocalizer.scene_map import SceneMap

# Along each side of an image: its points are to be kept all over it.
_CELLS = 4
# Points beyond these shares of the others would make the cells of the others too large.
_INNER = (1.0, 99.0)
# Nothing can be triangulated from, or its error be known by, fewer images.
MIN_OBSERVERS = 2


def order_images(covisibility: csr_matrix) -> NDArray[np.int64]:
    """Images by what they add to those before them.

    An image stands for another as far as it sees the points of that. What counts is how well each
    image is stood for by the best of those chosen (facility location).

    Args:
        covisibility: [I,I] number of points that two images share.
    """
    own = np.maximum(covisibility.diagonal(), 1)
    shares = (covisibility.astype(np.float64).tocsc().T / own).T.tocsc()
    best = np.zeros(len(own))

    def stood_for(image: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        begin, end = shares.indptr[image : image + 2]
        return shares.indices[begin:end], shares.data[begin:end]

    def gain(image: int) -> float:
        others, share = stood_for(image)
        return float(np.maximum(share - best[others], 0.0).sum())

    def take(image: int) -> None:
        others, share = stood_for(image)
        best[others] = np.maximum(best[others], share)

    return _greedy(range(len(own)), gain, take)


def order_points(scene_map: SceneMap, images: NDArray[np.int64]) -> NDArray[np.int64]:
    """Points by what they add to those before them, for a map of some of its images.

    A point is worth most where few points were chosen before it: each image is divided into cells,
    and the n-th point in a cell is worth 1 / n. So every image keeps points, all over it, and
    points that many images see come first.

    Args:
        scene_map: The map.
        images: Indices of the images that are kept.

    Returns:
        Rows of the points that at least `MIN_OBSERVERS` of these images see.
    """
    offsets, cells = _cells_of_points(scene_map, images)
    chosen = [0] * (len(images) * _CELLS**2)
    seen_in: list[list[int]] = [cells[begin:end].tolist() for begin, end in pairwise(offsets)]

    def gain(point: int) -> float:
        return sum(1.0 / (1 + chosen[cell]) for cell in seen_in[point])

    def take(point: int) -> None:
        for cell in seen_in[point]:
            chosen[cell] += 1

    candidates = [row for row, seen in enumerate(seen_in) if len(seen) >= MIN_OBSERVERS]
    return _greedy(candidates, gain, take)


def _cells_of_points(
    scene_map: SceneMap, images: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """[N+1] offsets into the cells [nnz] that points are seen in, over all images."""
    points, cells = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for index, image in enumerate(images.tolist()):
        seen = scene_map.points_seen_by(image)
        if not len(seen):
            continue
        in_camera = scene_map.camera_from_map[image] * scene_map.positions_of(seen)
        # behind the camera only in a damaged map
        on_plane = in_camera[:, :2] / np.maximum(in_camera[:, 2:], np.finfo(float).tiny)
        low, high = np.percentile(on_plane, _INNER, axis=0)
        place = (on_plane - low) / np.maximum(high - low, np.finfo(float).tiny)
        column, row = np.clip(place * _CELLS, 0, _CELLS - 1).astype(np.int64).T
        points.append(seen.astype(np.int64))
        cells.append((index * _CELLS + column) * _CELLS + row)
    order = np.argsort(np.concatenate(points), kind='stable')
    rows = np.concatenate(points)[order]
    offsets = np.searchsorted(rows, np.arange(scene_map.num_points + 1))
    return offsets, np.concatenate(cells)[order]


def _greedy(
    candidates: Iterable[int], gain: Callable[[int], float], take: Callable[[int], None]
) -> NDArray[np.int64]:
    """All candidates, each time the one that adds most; gains only ever fall.

    Args:
        candidates: To be put in order; of equals the first comes first.
        gain: What a candidate adds to those taken.
        take: Is told which was taken.
    """
    heap = [(-gain(candidate), candidate) for candidate in candidates]
    heapq.heapify(heap)
    order = []
    while heap:
        _, candidate = heapq.heappop(heap)
        now = (-gain(candidate), candidate)
        if heap and now > heap[0]:
            heapq.heappush(heap, now)
        else:
            take(candidate)
            order.append(candidate)
    return np.array(order, np.int64)
