# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""VLAD: one global descriptor from the local ones (Jegou et al., CVPR 2010).

With intra-normalisation (Arandjelovic and Zisserman, CVPR 2013), so that no word that happens to
be seen often drowns the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.cluster.vq import kmeans2

from gam_relocalizer.errors import MapBuildError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from gam_relocalizer.features.local import LocalFeatures

RETRIEVAL_NAME = 'vlad'
# Some 400 per word; k-means++ takes seconds on many more.
_MAX_TRAINING_DESCRIPTORS = 25_000
_ITERATIONS = 20


@dataclass(frozen=True)
class Vlad:
    """Describes images by the residuals of their local descriptors to a few words.

    Attributes:
        codebook: [W,D] float32, the words.
    """

    codebook: NDArray[np.float32]

    @property
    def name(self) -> str:
        """What maps and command lines know it by."""
        return RETRIEVAL_NAME

    @property
    def weights_sha256(self) -> str:
        """Empty: its words are in the map."""
        return ''

    @property
    def dimension(self) -> int:
        """Length G of a global descriptor."""
        return int(self.codebook.size)

    @staticmethod
    def train(descriptors: NDArray[np.float32], words: int = 64, seed: int = 0) -> Vlad:
        """Learns the words by k-means.

        Args:
            descriptors: [N,D] local descriptors of many images.
            words: Size of the codebook; fewer when there are fewer descriptors.
            seed: Of the subsample and of k-means.

        Raises:
            MapBuildError: There are no descriptors.
        """
        if not len(descriptors):
            msg = 'no local features at all: a global descriptor cannot be learned from nothing'
            raise MapBuildError(msg)
        rng = np.random.default_rng(seed)
        if len(descriptors) > _MAX_TRAINING_DESCRIPTORS:
            chosen = rng.choice(len(descriptors), _MAX_TRAINING_DESCRIPTORS, replace=False)
            descriptors = descriptors[np.sort(chosen)]
        words = min(words, len(descriptors))
        centres, _ = kmeans2(
            descriptors.astype(np.float64), words, iter=_ITERATIONS, minit='++', rng=rng
        )
        # a map keeps them like this, and describes queries with them
        return Vlad(centres.astype(np.float16).astype(np.float32))

    def describe(
        self,
        image: NDArray[np.uint8],  # noqa: ARG002 - the contract: others describe by the pixels
        features: LocalFeatures,
    ) -> NDArray[np.float32]:
        """Global descriptor [G] of one image, by its local features; see `aggregate`."""
        return self.aggregate(features.descriptors)

    def aggregate(self, descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
        """Global descriptor of the image that local descriptors are of.

        Args:
            descriptors: [M,D] its local descriptors.

        Returns:
            [G] of length one, or all zeros when nothing is left of it (no descriptors).
        """
        half_squares = 0.5 * (self.codebook**2).sum(axis=1)
        nearest = (descriptors @ self.codebook.T - half_squares).argmax(axis=1)
        residuals = np.zeros_like(self.codebook)
        np.add.at(residuals, nearest, descriptors - self.codebook[nearest])
        return _normalised(_normalised(residuals).ravel())


def _normalised(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    unit: NDArray[np.float32] = vectors / np.maximum(lengths, np.finfo(np.float32).tiny)
    return unit
