# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The hand-crafted matchers that GAM is compared with (section '2D-3D Matching').

Each takes the nearest point of every keypoint in the space of descriptors and rejects by its own
rule. In the paper several keypoints may keep the same point; at most one of them is right, so here
only the closest does.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from gam_relocalizer.matching.candidates import knn_ratio
from gam_relocalizer.matching.matcher import Matches, MatchInput, have_finite_places

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from gam_relocalizer.matching.candidates import Candidates

GREATEST_DISTANCE = 2.0  # of two unit descriptors


class NearestNeighbourRatio:
    """The nearest point of every keypoint, if the second nearest is clearly further (NN+ratio)."""

    def __init__(self, ratio: float = 0.9) -> None:
        """Keep a match when d1 / d2 <= `ratio`; 1 keeps all nearest neighbours."""
        self._ratio = ratio

    def match(self, given: MatchInput) -> Matches:
        """See `Matcher.match`; a weight is 1 - d1 / d2."""
        both = knn_ratio(given.descriptors, given.point_descriptors, k=2, ratio=0.0)
        _, first, counts = np.unique(both.edges[:, 0], return_index=True, return_counts=True)
        has_second = counts == 2
        nearest = both.distances[first]
        second = both.distances[first + has_second]
        with np.errstate(divide='ignore', invalid='ignore'):
            quotient = np.where(has_second & (second > 0), nearest / second, has_second * 1.0)
        edges = both.edges[first]
        kept = quotient <= self._ratio
        kept &= _closest_of_point(edges, nearest)
        kept &= have_finite_places(edges, given)
        return _matches(edges[kept], 1.0 - quotient[kept])


class NearestNeighbourCross:
    """Keypoints and points that are the nearest of each other (NN+cross)."""

    def match(self, given: MatchInput) -> Matches:
        """See `Matcher.match`; a weight falls with the distance, from 1 to 0 for opposite ones."""
        nearest = _nearest(given.descriptors, given.point_descriptors)
        # only points that are some keypoint's nearest can be in a pair: memory stays small
        found, position = np.unique(nearest.edges[:, 1], return_inverse=True)
        nearest_of_found = _nearest(given.point_descriptors[found], given.descriptors).edges[:, 1]
        kept = nearest_of_found[position] == nearest.edges[:, 0]
        kept &= have_finite_places(nearest.edges, given)
        return _matches(nearest.edges[kept], 1.0 - nearest.distances[kept] / GREATEST_DISTANCE)


class NearestNeighbourDistance:
    """The nearest point of every keypoint, if it is near enough (NN+distance)."""

    def __init__(self, threshold: float = 0.6) -> None:
        """Keep a match of two unit descriptors that are at most `threshold` apart.

        The default suits XFeat: it rejects hardly a true match (half a point of recall) for five
        points of precision; at the 0.7 that is common for SuperPoint little is rejected at all.
        """
        self._threshold = threshold

    def match(self, given: MatchInput) -> Matches:
        """See `Matcher.match`; a weight falls with the distance, from 1 to 0 for opposite ones."""
        nearest = _nearest(given.descriptors, given.point_descriptors)
        kept = nearest.distances <= self._threshold
        kept &= _closest_of_point(nearest.edges, nearest.distances)
        kept &= have_finite_places(nearest.edges, given)
        return _matches(nearest.edges[kept], 1.0 - nearest.distances[kept] / GREATEST_DISTANCE)


def _nearest(descriptors: NDArray[Any], among: NDArray[Any]) -> Candidates:
    return knn_ratio(descriptors, among, k=1, ratio=1.0)


def _closest_of_point(
    edges: NDArray[np.int64], distances: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Which edges are the shortest of their point; among equal ones the first."""
    shortest_first = np.argsort(distances, kind='stable')
    _, first = np.unique(edges[shortest_first, 1], return_index=True)
    closest = np.zeros(len(edges), dtype=bool)
    closest[shortest_first[first]] = True
    return closest


def _matches(edges: NDArray[np.int64], weights: NDArray[np.floating]) -> Matches:
    in_range = np.clip(weights, 0.0, 1.0).astype(np.float32)
    return Matches(edges[:, 0], edges[:, 1], in_range, np.ones(len(edges), np.bool_))
