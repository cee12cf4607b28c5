# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Hungarian pooling: from many-to-many candidates to a one-to-one matching of greatest weight."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy.sparse import csr_array
from scipy.sparse.csgraph import min_weight_full_bipartite_matching

if TYPE_CHECKING:
    from numpy.typing import NDArray


def hungarian_pooling(edges: NDArray[np.int64], weights: NDArray[Any]) -> NDArray[np.bool_]:
    """Choose the one-to-one subset of the edges with the greatest sum of weights.

    Exact, on the sparse graph: every keypoint gets a column of its own that stands for 'unmatched'
    and weighs nothing, so that a full matching always exists.

    Args:
        edges: [T, 2] (keypoint, point); of a repeated edge at most one is chosen.
        weights: [T] finite weights.

    Returns:
        [T] mask of the chosen edges.
    """
    chosen = np.zeros(len(edges), dtype=bool)
    if not len(edges):
        return chosen
    keypoints, rows = np.unique(edges[:, 0], return_inverse=True)
    points, columns = np.unique(edges[:, 1], return_inverse=True)
    heaviest_first = np.argsort(-np.asarray(weights, np.float64), kind='stable')
    pairs = rows * len(points) + columns
    ordered_pairs, first = np.unique(pairs[heaviest_first], return_index=True)
    edge_of_pair = heaviest_first[first]

    # scipy drops stored zeros, hence the offset that keeps every cost positive
    offset = 1.0 + float(np.abs(weights).max())
    unmatched = np.arange(len(keypoints))
    costs = csr_array(
        (
            np.concatenate(
                [
                    offset - np.asarray(weights, np.float64)[edge_of_pair],
                    np.full(len(keypoints), offset),
                ]
            ),
            (
                np.concatenate([rows[edge_of_pair], unmatched]),
                np.concatenate([columns[edge_of_pair], len(points) + unmatched]),
            ),
        ),
        shape=(len(keypoints), len(points) + len(keypoints)),
    )
    matched_rows, matched_columns = min_weight_full_bipartite_matching(costs)
    real = matched_columns < len(points)
    matched_pairs = matched_rows[real] * np.int64(len(points)) + matched_columns[real]
    chosen[edge_of_pair[np.searchsorted(ordered_pairs, matched_pairs)]] = True
    return chosen


class _HungarianPooling(torch.autograd.Function):
    """The pooling as a layer: weights of the chosen edges pass, the others become zero.

    Back-propagation as in the paper: 1 for the edges of the matching, 0 for all others.
    """

    @staticmethod
    def forward(ctx: Any, weights: torch.Tensor, edges: NDArray[np.int64]) -> torch.Tensor:  # noqa: ANN401
        """Pool `weights` [T] of `edges` [T, 2]."""
        mask = hungarian_pooling(edges, weights.detach().float().cpu().numpy())
        chosen = torch.from_numpy(mask).to(weights.device)
        ctx.save_for_backward(chosen)
        return torch.where(chosen, weights, 0.0)

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor, None]:  # noqa: ANN401
        """Let the gradient through where an edge was chosen."""
        (chosen,) = ctx.saved_tensors
        return gradients[0] * chosen, None


def hungarian_pool(weights: torch.Tensor, edges: NDArray[np.int64]) -> torch.Tensor:
    """The layer: [T] weights of `edges` [T, 2] to the weights of the chosen ones, else 0."""
    pooled: torch.Tensor = _HungarianPooling.apply(weights, edges)  # type: ignore[no-untyped-call]
    return pooled
