# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What every 2D-3D matcher takes and gives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from gam_relocalizer.errors import MatchingError

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True)
class MatchInput:
    """What an image and a scene bring to a matcher; the numbers may be anything, even not finite.

    Attributes:
        keypoints: [M, 2] as `normalise_keypoints` gives them.
        focal_length: In the unit of the keypoints, see `normalised_focal_length`.
        descriptors: [M, D] of the keypoints.
        points: [N, 3] in the frame of a reference camera near the query, any unit: the pose that
            is left to find is then small, which is what the networks learned.
        point_descriptors: [N, D] of the points, possibly memory-mapped.

    Raises:
        MatchingError: Arrays have other shapes, or the descriptors are of different extractors.
    """

    keypoints: NDArray[Any]
    focal_length: float
    descriptors: NDArray[Any]
    points: NDArray[Any]
    point_descriptors: NDArray[Any]

    def __post_init__(self) -> None:
        keypoints = ('keypoint', len(self.descriptors))
        scene = ('point', len(self.point_descriptors))
        expected = {
            'keypoints': (self.keypoints, *keypoints, 2),
            'descriptors': (self.descriptors, *keypoints, None),
            'points': (self.points, *scene, 3),
            'point_descriptors': (self.point_descriptors, *scene, None),
        }
        for name, (array, row, rows, columns) in expected.items():
            if array.ndim != 2 or array.shape != (rows, columns or array.shape[1]):
                msg = (
                    f'{name}: shape {array.shape}; expected ({rows}, {columns or "D"}), a row for '
                    f'each {row} that has a descriptor'
                )
                raise MatchingError(msg)
        if self.descriptors.shape[1] != self.point_descriptors.shape[1]:
            msg = (
                f'descriptors of {self.descriptors.shape[1]} numbers in the image and of '
                f'{self.point_descriptors.shape[1]} in the map; use the extractor that made the map'
            )
            raise MatchingError(msg)


@dataclass(frozen=True)
class Matches:
    """2D-3D matches: one-to-one, but for matchers that say otherwise.

    Attributes:
        keypoint_indices: [K] int64.
        point_indices: [K] int64.
        weights: [K] float32 in [0, 1], the matcher's belief that a match is true.
        nearest: [K] bool, whether the keypoint looks like no other point as much as like this one.
            Where several points are in the right place, such a match tells best where exactly.
    """

    keypoint_indices: NDArray[np.int64]
    point_indices: NDArray[np.int64]
    weights: NDArray[np.float32]
    nearest: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.weights)

    @staticmethod
    def none() -> Matches:
        """No matches."""
        nothing = np.empty(0, np.int64)
        return Matches(nothing, nothing, np.empty(0, np.float32), np.empty(0, np.bool_))


class Matcher(Protocol):
    """Matches the keypoints of an image with the points of a scene."""

    def match(self, given: MatchInput) -> Matches:
        """Match; what cannot be matched, numbers that are not finite included, has no match."""


def have_finite_places(edges: NDArray[np.int64], given: MatchInput) -> NDArray[np.bool_]:
    """Which edges [T, 2] join a keypoint and a point whose coordinates are all finite."""
    finite_keypoints = np.isfinite(given.keypoints[edges[:, 0]]).all(axis=1)
    return np.asarray(finite_keypoints & np.isfinite(given.points[edges[:, 1]]).all(axis=1))
