# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Which reference images look like the query: exact search over the global descriptors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from gam_relocalizer.localization.prior import PositionHint
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

    def by_image(self) -> dict[int, float]:
        """The score of each image, in the same order."""
        return dict(zip(self.images.tolist(), self.scores.tolist(), strict=True))


def retrieve(
    global_descriptor: NDArray[np.float32],
    scene_map: SceneMap,
    count: int,
    among: NDArray[np.bool_] | None = None,
) -> Retrieved:
    """The most similar reference images; equal scores go by lower index.

    Args:
        global_descriptor: [G] of the query; a zero descriptor (no features) retrieves nothing.
        scene_map: The map.
        count: Images wanted; fewer come back from a smaller map.
        among: [I] the images to choose from; all by default.
    """
    if not scene_map.num_images or not np.any(global_descriptor):
        return Retrieved(np.empty(0, np.int64), np.empty(0, np.float32))
    scores = scene_map.likeness(global_descriptor)
    images = np.argsort(-scores, kind='stable')
    if among is not None:
        images = images[among[images]]
    images = images[:count]
    return Retrieved(images.astype(np.int64), scores[images])


def images_near(hint: PositionHint, scene_map: SceneMap) -> NDArray[np.bool_]:
    """Reference images taken near a position.

    The radius is counted from the camera nearest to the position. So a hint that is more exact than
    the map is dense still finds the images around it, and a hint outside the map those at its edge.

    Returns:
        [I] bool.
    """
    if not scene_map.num_images:
        return np.zeros(0, np.bool_)
    away = np.linalg.norm(scene_map.camera_positions - hint.position, axis=1)
    return np.asarray(away <= away.min() + hint.radius)
