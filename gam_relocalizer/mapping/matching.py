# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Matching the local features of two images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from gam_relocalizer.features.registry import min_similarity_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from gam_relocalizer.mapping.extraction import MappingImage
    from gam_relocalizer.mapping.progress import Progress

# Repeated windows and tiles lead whole images astray; a mild test costs one true match in six.
_MAX_RATIO = 0.95
_BLOCK = 4096


def match_pairs(
    images: Sequence[MappingImage],
    pairs: Sequence[tuple[int, int]],
    extractor: str,
    progress: Progress,
) -> dict[tuple[int, int], NDArray[np.int64]]:
    """Matches of pairs of images, [K,2] indices of keypoints by the indices of the images.

    Args:
        images: With descriptors of one extractor.
        pairs: Indices of images.
        extractor: Its name, which tells how alike descriptors of one thing are.
        progress: Told of the step match.
    """
    min_similarity = min_similarity_of(extractor)
    matches: dict[tuple[int, int], NDArray[np.int64]] = {}
    for done, (first, second) in enumerate(pairs, start=1):
        matches[first, second] = mutual_nearest_neighbours(
            images[first].features.descriptors,
            images[second].features.descriptors,
            min_similarity,
            _MAX_RATIO,
        )
        progress('match', done, len(pairs))
    return matches


def mutual_nearest_neighbours(
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    min_similarity: float,
    max_ratio: float,
) -> NDArray[np.int64]:
    """Pairs of descriptors that are each other's nearest, near enough and distinctive.

    Args:
        first: [A,D], L2-normalised.
        second: [B,D], L2-normalised.
        min_similarity: Least cosine of a pair.
        max_ratio: Greatest distance to the nearest, relative to the second nearest (Lowe, 2004),
            seen from both sides; 1 lets everything pass.

    Returns:
        [K,2] indices into first and second, rising in the first column.
    """
    if not len(first) or not len(second):
        return np.zeros((0, 2), dtype=np.int64)
    forth = _nearest(torch.from_numpy(first), torch.from_numpy(second), max_ratio)
    back = _nearest(torch.from_numpy(second), torch.from_numpy(first), max_ratio)
    rows = np.arange(len(first))
    kept = (
        (back.indices[forth.indices] == rows)
        & (forth.similarities >= min_similarity)
        & forth.distinctive
        & back.distinctive[forth.indices]
    )
    return np.stack([rows[kept], forth.indices[kept]], axis=1)


@dataclass(frozen=True)
class _Nearest:
    """The nearest reference of each query, and whether the second nearest is clearly farther."""

    indices: NDArray[np.int64]
    similarities: NDArray[np.float32]
    distinctive: NDArray[np.bool_]


def _nearest(queries: torch.Tensor, references: torch.Tensor, max_ratio: float) -> _Nearest:
    blocks = [
        _nearest_in_block(block @ references.T, max_ratio) for block in torch.split(queries, _BLOCK)
    ]
    indices, similarities, distinctive = (
        torch.cat(parts).numpy() for parts in zip(*blocks, strict=True)
    )
    return _Nearest(indices, similarities, distinctive)


def _nearest_in_block(
    similarity: torch.Tensor, max_ratio: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Index, cosine and distinctiveness of the largest entry of each row; overwrites its input."""
    nearest = similarity.max(dim=1)
    # Twice the largest is several times faster than torch.topk.
    similarity.scatter_(1, nearest.indices[:, None], -torch.inf)
    second = similarity.max(dim=1).values
    # Squared distances of unit vectors are 2 - 2 cos.
    distinctive = 1.0 - nearest.values <= max_ratio**2 * (1.0 - second)
    return nearest.indices, nearest.values, distinctive
