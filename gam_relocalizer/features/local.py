# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The one contract that every local feature extractor meets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from gam_relocalizer.scene_map import ExtractorIdentity


@dataclass(frozen=True)
class LocalFeatures:
    """Local features of one image, best first.

    Attributes:
        keypoints: [M,2] pixels, COLMAP convention (centre of the first pixel at 0.5, 0.5).
        descriptors: [M,D], L2-normalised.
        scores: [M], higher is better.
    """

    keypoints: NDArray[np.float32]
    descriptors: NDArray[np.float32]
    scores: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.keypoints)


class LocalExtractor(Protocol):
    """Finds and describes keypoints."""

    @property
    def identity(self) -> ExtractorIdentity:
        """What a map remembers of its extractor."""

    def extract(self, image: NDArray[np.uint8]) -> LocalFeatures:
        """Features of an RGB [H,W,3] or grey [H,W] image; none is a valid answer."""
