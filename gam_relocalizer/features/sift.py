# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""SIFT (Lowe, 2004) from OpenCV with RootSIFT descriptors (Arandjelovic, Zisserman, 2012)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from gam_relocalizer.cameras import PIXEL_CENTRE
from gam_relocalizer.features.local import LocalFeatures
from gam_relocalizer.features.resizing import to_working_size
from gam_relocalizer.scene_map import ExtractorIdentity

if TYPE_CHECKING:
    from numpy.typing import NDArray

_DIMENSION = 128
# Beyond this SIFT takes seconds and gigabytes, for keypoints that are then cut anyway.
_MAX_SIDE = 1600


class SiftExtractor:
    """SIFT keypoints with RootSIFT descriptors (128-D); needs no weights."""

    def __init__(self, max_keypoints: int) -> None:
        # Without the precise upscale, OpenCV's keypoints lie a quarter of a pixel off.
        self._sift = cv2.SIFT.create(nfeatures=max_keypoints, enable_precise_upscale=True)
        self._max_keypoints = max_keypoints

    @property
    def identity(self) -> ExtractorIdentity:
        """Name and dimension."""
        return ExtractorIdentity('sift', _DIMENSION, '')

    def extract(self, image: NDArray[np.uint8]) -> LocalFeatures:
        """Features of an RGB [H,W,3] or grey [H,W] image."""
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        working, original_per_working = to_working_size(np.asarray(grey, np.uint8), _MAX_SIDE)
        found, raw = self._sift.detectAndCompute(working, None)
        sift = np.zeros((0, _DIMENSION)) if not found else raw
        pixels = np.array([keypoint.pt for keypoint in found]).reshape(-1, 2) + PIXEL_CENTRE
        scores = np.array([keypoint.response for keypoint in found], dtype=np.float32)
        best_first = np.argsort(-scores, kind='stable')[: self._max_keypoints]
        return LocalFeatures(
            keypoints=(pixels * original_per_working).astype(np.float32)[best_first],
            descriptors=_root_sift(np.asarray(sift, dtype=np.float32))[best_first],
            scores=scores[best_first],
        )


def _root_sift(sift: NDArray[np.float32]) -> NDArray[np.float32]:
    sums = np.maximum(sift.sum(axis=1, keepdims=True), np.finfo(np.float32).tiny)
    root: NDArray[np.float32] = np.sqrt(sift / sums)
    return root
