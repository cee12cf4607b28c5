# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Bringing images to an extractor's working size, and keypoints back from it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


def to_working_size(
    image: NDArray[np.uint8], max_side: int, multiple: int = 1
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Shrinks an image to a longer side of at most `max_side` and to sides of whole multiples.

    Args:
        image: [H,W] or [H,W,3], no side below `multiple`.
        max_side: Longest side afterwards [px].
        multiple: Both sides are rounded down to multiples of this.

    Returns:
        The image, and [2] the pixels of the original per pixel of it in x and y: a point (u, v) of
        the small image (COLMAP convention) is (u * x, v * y) in the original, exactly.
    """
    height, width = image.shape[:2]
    shrink = min(1.0, max_side / max(height, width))
    new_width, new_height = (
        max(multiple, int(round(side * shrink, 6)) // multiple * multiple)
        for side in (width, height)
    )
    original_per_working = np.array([width / new_width, height / new_height])
    if (new_width, new_height) == (width, height):
        return image, original_per_working
    resized = cv2.resize(image, (new_width, new_height), interpolation=cv2.INTER_AREA)
    return np.asarray(resized, dtype=np.uint8), original_per_working
