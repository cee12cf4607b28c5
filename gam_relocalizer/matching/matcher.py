# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What every 2D-3D matcher takes and gives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True)
class Matches:
    """One-to-one 2D-3D matches.

    Attributes:
        keypoint_indices: [K] int64.
        point_indices: [K] int64.
        weights: [K] float32 in [0, 1], the matcher's belief that a match is true.
    """

    keypoint_indices: NDArray[np.int64]
    point_indices: NDArray[np.int64]
    weights: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.weights)

    @staticmethod
    def none() -> Matches:
        """No matches."""
        return Matches(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.float32))


class Matcher(Protocol):
    """Matches the keypoints of an image with the points of a scene."""

    def match(
        self,
        keypoints_normalised: NDArray[Any],
        descriptors: NDArray[Any],
        points: NDArray[Any],
        point_descriptors: NDArray[Any],
    ) -> Matches:
        """Match; what cannot be matched gives no matches, never an exception.

        Args:
            keypoints_normalised: [M, 2] as `normalise_keypoints` gives them.
            descriptors: [M, D] of the keypoints.
            points: [N, 3] in the frame of a reference camera near the query, any unit: the pose
                that is left to find is then small, which is what the network learned.
            point_descriptors: [N, D] of the points.
        """
