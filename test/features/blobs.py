# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


def blob_image(
    width: int, height: int, *, offset: int = 0, count: int = 60, seed: int = 0
) -> NDArray[np.uint8]:
    """Rectangles and discs in the middle of a black image, moved by an offset in x and y."""
    rng = np.random.default_rng(seed)
    image = np.zeros((height, width, 3), dtype=np.uint8)
    for _ in range(count):
        x, y = (int(rng.integers(64, side - 96)) + offset for side in (width, height))
        colour = tuple(int(value) for value in rng.integers(40, 256, 3))
        if rng.random() < 0.5:
            cv2.circle(image, (x, y), int(rng.integers(3, 12)), colour, -1)
        else:
            far = (x + int(rng.integers(4, 24)), y + int(rng.integers(4, 24)))
            cv2.rectangle(image, (x, y), far, colour, -1)
    return image
