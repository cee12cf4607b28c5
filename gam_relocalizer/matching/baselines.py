# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What GAM is compared with."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from gam_relocalizer.matching.candidates import knn_ratio
from gam_relocalizer.matching.matcher import Matches

if TYPE_CHECKING:
    from numpy.typing import NDArray


class NearestNeighbourRatio:
    """The nearest point of every keypoint, if the second nearest is clearly further (NN+ratio)."""

    def __init__(self, ratio: float = 0.9) -> None:
        """Keep a match when d1 / d2 <= `ratio`; 1 keeps all nearest neighbours."""
        self._ratio = ratio

    def match(
        self,
        keypoints_normalised: NDArray[Any],  # noqa: ARG002 - looks alone decide
        descriptors: NDArray[Any],
        points: NDArray[Any],  # noqa: ARG002
        point_descriptors: NDArray[Any],
    ) -> Matches:
        """See `Matcher.match`; a point keeps its closest keypoint, a weight is 1 - d1 / d2."""
        both = knn_ratio(descriptors, point_descriptors, k=2, ratio=0.0)
        keypoints, first, counts = np.unique(
            both.edges[:, 0], return_index=True, return_counts=True
        )
        has_second = counts == 2
        nearest = both.distances[first]
        second = both.distances[first + has_second]
        with np.errstate(divide='ignore', invalid='ignore'):
            quotient = np.where(has_second & (second > 0), nearest / second, has_second * 1.0)
        closest = _closest_per_point(both.edges[first, 1], nearest)
        kept = (quotient <= self._ratio) & closest
        return Matches(
            keypoints[kept],
            both.edges[first, 1][kept],
            (1.0 - quotient[kept]).astype(np.float32),
        )


def _closest_per_point(
    points: NDArray[np.int64], distances: NDArray[np.float32]
) -> NDArray[np.bool_]:
    order = np.lexsort((distances, points))
    ordered = points[order]
    is_first = np.ones(len(points), dtype=bool)
    is_first[1:] = ordered[1:] != ordered[:-1]
    closest = np.zeros(len(points), dtype=bool)
    closest[order[is_first]] = True
    return closest
