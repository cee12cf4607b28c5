# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Which images are worth matching: all of them in a small set, else neighbours and look-alikes."""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

# 780 pairs: half a minute on one core, and nothing can be missed.
EXHAUSTIVE_UP_TO = 40
SEQUENTIAL_NEIGHBOURS = 5
RETRIEVED_NEIGHBOURS = 20


def choose_pairs(global_descriptors: NDArray[np.float32]) -> list[tuple[int, int]]:
    """Pairs of images to match.

    Args:
        global_descriptors: [I,G], in the order of the names: files of a video come in order, so
            that neighbours in the list are likely to overlap.

    Returns:
        Sorted pairs of image indices, the smaller one first.
    """
    count = len(global_descriptors)
    if count <= EXHAUSTIVE_UP_TO:
        return list(combinations(range(count), 2))
    similarity = global_descriptors @ global_descriptors.T
    positions = np.arange(count)
    # Neighbours are matched anyway: retrieval is to find the other passes by the same place.
    neighbours = np.abs(positions[:, None] - positions[None, :]) <= SEQUENTIAL_NEIGHBOURS
    similarity[neighbours] = -np.inf
    similar = np.argsort(-similarity, axis=1, kind='stable')[:, :RETRIEVED_NEIGHBOURS]
    pairs = set(zip(*(index.tolist() for index in np.nonzero(np.triu(neighbours, 1))), strict=True))
    for image, others in enumerate(similar.tolist()):
        pairs.update((min(image, other), max(image, other)) for other in others)
    return sorted((first, second) for first, second in pairs if first != second)


def choose_pairs_between(likeness: NDArray[np.float32]) -> list[tuple[int, int]]:
    """Pairs of images of two sets to match.

    Args:
        likeness: [A,B] how much each image of the one set looks like each of the other.

    Returns:
        Sorted pairs of indices: all of them in small sets, else the most alike for each of the A.
    """
    if sum(likeness.shape) <= EXHAUSTIVE_UP_TO:
        return [(int(one), int(other)) for one, other in np.ndindex(likeness.shape)]
    similar = np.argsort(-likeness, axis=1, kind='stable')[:, :RETRIEVED_NEIGHBOURS]
    return sorted((one, other) for one, others in enumerate(similar.tolist()) for other in others)
