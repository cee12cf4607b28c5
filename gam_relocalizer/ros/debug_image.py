# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The picture on `~/debug_image`: an image with what an attempt made of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from gam_relocalizer.localization.result import LocalizationResult

GREEN, RED, BLACK = (40, 220, 70), (240, 60, 50), (0, 0, 0)


def draw_attempt(pixels: NDArray[np.uint8], result: LocalizationResult) -> NDArray[np.uint8]:
    """Draws the inliers and the verdict.

    Args:
        pixels: RGB [H,W,3] or grey [H,W]; not changed.
        result: What came of it.

    Returns:
        RGB [H,W,3].
    """
    grey = pixels.ndim == 2
    picture = cv2.cvtColor(pixels, cv2.COLOR_GRAY2RGB) if grey else pixels.copy()
    colour = GREEN if result.accepted else RED
    if result.estimate is not None:
        for x, y in result.estimate.inlier_keypoints:
            # OpenCV has pixel centres at integers
            cv2.circle(picture, (round(float(x) - 0.5), round(float(y) - 0.5)), 3, colour, 1)
    text = f'{result.status.name}  {result.inliers} inliers'
    for shade, thickness in ((BLACK, 3), (colour, 1)):
        cv2.putText(picture, text, (8, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.6, shade, thickness)
    return np.asarray(picture, dtype=np.uint8)
