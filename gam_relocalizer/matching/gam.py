# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Geometry-Aided Matching: kNN ratio candidates, a network that judges them, Hungarian pooling."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from gam_relocalizer.matching.bmnet import normalise_points
from gam_relocalizer.matching.candidates import knn_ratio
from gam_relocalizer.matching.graph import CandidateGraphs
from gam_relocalizer.matching.matcher import Matches, have_finite_places
from gam_relocalizer.matching.pooling import hungarian_pooling

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from gam_relocalizer.matching.graph import MatchingNetwork
    from gam_relocalizer.matching.matcher import MatchInput

NEIGHBOURS = 3
RATIO = 0.7


class Gam:
    """The matcher of the paper, for any network; the paper's k = 3 and r = 0.7 by default."""

    def __init__(
        self,
        network: MatchingNetwork,
        neighbours: int = NEIGHBOURS,
        ratio: float = RATIO,
        *,
        pooling: bool = True,
        least_weight: float = 0.0,
        likeness: float = 0.0,
    ) -> None:
        """Match with a network.

        Args:
            network: Judges the candidates.
            neighbours: See `knn_ratio`.
            ratio: See `knn_ratio`.
            pooling: Whether matches are made one-to-one; without it all candidates are matches.
            least_weight: Matches of lower weight are left out.
            likeness: The pooling maximises the weight times this power of the cosine of the
                descriptors. Points in one place are all alike to geometry; among them, looks
                decide. With 0, as in the paper, chance does.
        """
        self._network = network.eval()
        self._neighbours = neighbours
        self._ratio = ratio
        self._pooling = pooling
        self._least_weight = least_weight
        self._likeness = likeness

    def match(self, given: MatchInput) -> Matches:
        """See `Matcher.match`; the weights are the network's probabilities."""
        candidates = knn_ratio(
            given.descriptors, given.point_descriptors, self._neighbours, self._ratio
        )
        placed = have_finite_places(candidates.edges, given)
        edges, distances = candidates.edges[placed], candidates.distances[placed]
        if not len(edges):
            return Matches.none()
        weights = self._weigh(edges, distances, given)
        kept = weights >= self._least_weight
        if self._pooling:
            cosines = np.clip(1.0 - distances**2 / 2.0, 0.0, 1.0)
            kept &= hungarian_pooling(edges, weights * cosines**self._likeness)
        # candidates are sorted by keypoint, then by distance
        nearest = np.diff(edges[:, 0], prepend=-1) > 0
        return Matches(edges[kept, 0], edges[kept, 1], weights[kept], nearest[kept])

    def _weigh(
        self, edges: NDArray[np.int64], distances: NDArray[np.float32], given: MatchInput
    ) -> NDArray[np.float32]:
        """Probabilities [T] of the edges; the network sees nothing that has no edge."""
        used_keypoints, rows = np.unique(edges[:, 0], return_inverse=True)
        used_points, columns = np.unique(edges[:, 1], return_inverse=True)
        keypoints = np.asarray(given.keypoints[used_keypoints], np.float32)
        graph = CandidateGraphs(
            torch.from_numpy(keypoints)[:, None],
            torch.from_numpy(normalise_points(given.points[used_points]))[:, None],
            torch.from_numpy(np.stack([rows, columns], axis=1))[:, None],
            torch.from_numpy(distances)[:, None],
            torch.tensor([given.focal_length], dtype=torch.float32),
        )
        with torch.inference_mode():
            probabilities = torch.sigmoid(self._network(graph)[:, 0]).numpy()
        # finite but absurd coordinates overflow
        return np.asarray(np.nan_to_num(probabilities, nan=0.0), np.float32)
