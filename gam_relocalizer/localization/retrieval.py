# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Which reference images look like the query: exact search over the global descriptors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from gam_relocalizer.scene_map import SceneMap


@dataclass(frozen=True)
class Retrieved:
    """Reference images by descending similarity to the query.

    Attributes:
        images: [R] int64 indices of reference images.
        scores: [R] float32 dot products of the global descriptors.
    """

    images: NDArray[np.int64]
    scores: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.images)


def retrieve(global_descriptor: NDArray[np.float32], scene_map: SceneMap, count: int) -> Retrieved:
    """The most similar reference images; equal scores go by lower index.

    Args:
        global_descriptor: [G] of the query; a zero descriptor (no features) retrieves nothing.
        scene_map: The map.
        count: Images wanted; fewer come back from a smaller map.
    """
    if not scene_map.num_images or not np.any(global_descriptor):
        return Retrieved(np.empty(0, np.int64), np.empty(0, np.float32))
    scores = np.asarray(scene_map.global_descriptors @ global_descriptor, np.float32)
    images = np.argsort(-scores, kind='stable')[:count]
    return Retrieved(images.astype(np.int64), scores[images])
