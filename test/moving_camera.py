# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""A camera that slides over a wall with texture: frames whose motion is known to the pixel."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from gam_relocalizer.capture.keyframes import Frame, KeyframeCounts, select_keyframes

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

WIDTH, HEIGHT = 320, 240
FRAME_NS = 33_000_000


def wall(width: int = 3200, height: int = 360, seed: int = 0) -> NDArray[np.uint8]:
    """Blobs of all sizes, RGB."""
    random = np.random.default_rng(seed)
    texture = np.zeros((height, width, 3), np.float32)
    for size in (1.0, 3.0, 9.0):
        noise = random.normal(size=texture.shape).astype(np.float32)
        texture += size * cv2.GaussianBlur(noise, (0, 0), size)
    scaled = cv2.normalize(texture, None, 20, 235, cv2.NORM_MINMAX)
    return np.asarray(scaled.round(), dtype=np.uint8)


WALL = wall()


def seen_at(x: float, y: float = 60.0) -> NDArray[np.uint8]:
    """What the camera sees with its left upper corner at a place of the wall, RGB [H,W,3]."""
    centre = (x + (WIDTH - 1) / 2.0, y + (HEIGHT - 1) / 2.0)
    return np.asarray(cv2.getRectSubPix(WALL, (WIDTH, HEIGHT), centre), dtype=np.uint8)


def blurred(image: NDArray[np.uint8], sigma: float = 2.5) -> NDArray[np.uint8]:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), dtype=np.uint8)


def frames_of(images: Iterable[NDArray[np.uint8]]) -> list[Frame]:
    """Frames in steady succession; the stamps tell their indices."""
    return [Frame(index * FRAME_NS, image) for index, image in enumerate(images)]


def chosen_of(frames: Iterable[Frame]) -> tuple[list[int], KeyframeCounts]:
    """Indices of the keyframes among `frames_of`, and the counts."""
    kept: list[Frame] = []
    counts = select_keyframes(frames, kept.append)
    return [frame.stamp_ns // FRAME_NS for frame in kept], counts
