# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Geometry-Aided Matching: kNN ratio candidates, BMNet, Hungarian pooling."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from gam_relocalizer.matching.bmnet import normalise_points
from gam_relocalizer.matching.candidates import knn_ratio
from gam_relocalizer.matching.matcher import Matches
from gam_relocalizer.matching.pooling import hungarian_pooling
from gam_relocalizer.matching.weights import load_weights

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from gam_relocalizer.matching.bmnet import BMNet

NEIGHBOURS = 3
RATIO = 0.7


class Gam:
    """The matcher of the paper, with its default k = 3 and r = 0.7."""

    def __init__(self, net: BMNet, neighbours: int = NEIGHBOURS, ratio: float = RATIO) -> None:
        """Match with a network; `neighbours` and `ratio` are those of `knn_ratio`."""
        self._net = net.eval()
        self._neighbours = neighbours
        self._ratio = ratio

    @classmethod
    def load(cls, weights: Path | None = None) -> Gam:
        """Load a weights file, the shipped one if no path is given.

        Raises:
            WeightsError: The file is missing, damaged or does not fit.
        """
        net, _ = load_weights(weights)
        return cls(net)

    def match(
        self,
        keypoints_normalised: NDArray[Any],
        descriptors: NDArray[Any],
        points: NDArray[Any],
        point_descriptors: NDArray[Any],
    ) -> Matches:
        """See `Matcher.match`; the weights are BMNet's probabilities.

        The pooling maximises probability times cosine of the descriptors, not probability alone.
        """
        candidates = knn_ratio(descriptors, point_descriptors, self._neighbours, self._ratio)
        usable = _have_finite_places(candidates.edges, keypoints_normalised, points)
        edges = candidates.edges[usable]
        if not len(edges):
            return Matches.none()
        weights = self._weigh(edges, keypoints_normalised, points)
        # points near one line of sight are all alike to the network: among them, looks decide
        cosines = 1.0 - candidates.distances[usable] ** 2 / 2.0
        pooled = hungarian_pooling(edges, weights * cosines)
        return Matches(edges[pooled, 0], edges[pooled, 1], weights[pooled])

    def _weigh(
        self, edges: NDArray[np.int64], keypoints: NDArray[Any], points: NDArray[Any]
    ) -> NDArray[np.float32]:
        """Probabilities [T] of the edges; the network sees nothing that has no edge."""
        used_keypoints, rows = np.unique(edges[:, 0], return_inverse=True)
        used_points, columns = np.unique(edges[:, 1], return_inverse=True)
        with torch.inference_mode():
            logits = self._net(
                torch.from_numpy(np.asarray(keypoints[used_keypoints], np.float32))[:, None],
                torch.from_numpy(normalise_points(points[used_points]))[:, None],
                torch.from_numpy(np.stack([rows, columns], axis=1))[:, None],
            )
            return np.asarray(torch.sigmoid(logits[:, 0]).numpy(), np.float32)


def _have_finite_places(
    edges: NDArray[np.int64], keypoints: NDArray[Any], points: NDArray[Any]
) -> NDArray[np.bool_]:
    finite_keypoints = np.isfinite(keypoints[edges[:, 0]]).all(axis=1)
    return np.asarray(finite_keypoints & np.isfinite(points[edges[:, 1]]).all(axis=1))
