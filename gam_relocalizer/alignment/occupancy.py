# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""2D occupancy maps as map_server keeps them: an image, and a YAML file that says where it lies."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import yaml

from gam_relocalizer.errors import UsageError
from gam_relocalizer.images import read_image

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

MAX_YAML_BYTES = 64 * 2**10


@dataclass(frozen=True)
class OccupancyMap:
    """An occupancy map.

    Attributes:
        image: [H,W] uint8 as it is stored, the first row on top.
        resolution: Side of a pixel [m].
        origin: x, y [m] and yaw [rad] in the map frame of the lower left corner of the image.
    """

    image: NDArray[np.uint8]
    resolution: float
    origin: tuple[float, float, float]

    def contains(self, pixel: tuple[float, float]) -> bool:
        """Whether a column and row are in the image."""
        height, width = self.image.shape
        return bool(0.0 <= pixel[0] <= width and 0.0 <= pixel[1] <= height)

    def map_from_pixels(self, pixels: ArrayLike) -> NDArray[np.float64]:
        """x, y [n,2] of columns and rows [n,2]; rows count from the top, y from the bottom."""
        columns_rows = np.asarray(pixels, np.float64)
        right = columns_rows[:, 0] * self.resolution
        up = (self.image.shape[0] - columns_rows[:, 1]) * self.resolution
        x, y, yaw = self.origin
        cosine, sine = math.cos(yaw), math.sin(yaw)
        return np.stack([x + cosine * right - sine * up, y + sine * right + cosine * up], axis=1)

    def pixels_from_map(self, places: ArrayLike) -> NDArray[np.float64]:
        """Columns and rows [n,2] of x, y [n,2]."""
        x, y, yaw = self.origin
        off = np.asarray(places, np.float64) - [x, y]
        cosine, sine = math.cos(yaw), math.sin(yaw)
        right = (cosine * off[:, 0] + sine * off[:, 1]) / self.resolution
        up = (-sine * off[:, 0] + cosine * off[:, 1]) / self.resolution
        return np.stack([right, self.image.shape[0] - up], axis=1)


def read_occupancy_map(path: Path) -> OccupancyMap:
    """Reads `map.yaml` and its image (map_server's format).

    Raises:
        UsageError: Missing, too large, malformed, or numbers that are no map.
        ImageError: The image is missing or damaged.
    """
    if not path.is_file():
        msg = f'{path}: no such file; expected the YAML file of an occupancy map'
        raise UsageError(msg)
    if path.stat().st_size > MAX_YAML_BYTES:
        msg = f'{path}: larger than {MAX_YAML_BYTES} bytes; this is no map.yaml'
        raise UsageError(msg)
    try:
        data = yaml.safe_load(path.read_text(encoding='utf-8'))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as err:
        msg = f'{path}: cannot be read as YAML: {err}'
        raise UsageError(msg) from err
    file, resolution, origin = _fields(data, path)
    image = read_image(path.parent / file)
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
    return OccupancyMap(grey, resolution, origin)


def _fields(data: Any, path: Path) -> tuple[Path, float, tuple[float, float, float]]:  # noqa: ANN401 - any YAML value
    try:
        file, resolution = Path(str(data['image'])), float(data['resolution'])
        x, y, yaw = (float(value) for value in data['origin'])
    except (KeyError, TypeError, ValueError) as err:
        msg = (
            f'{path}: expected `image: FILE`, `resolution: METRES` and `origin: [x, y, yaw]`, as '
            f'map_server has them'
        )
        raise UsageError(msg) from err
    if not all(math.isfinite(value) for value in (resolution, x, y, yaw)) or resolution <= 0.0:
        msg = f'{path}: resolution {resolution:g} and origin {[x, y, yaw]} are no map'
        raise UsageError(msg)
    return file, resolution, (x, y, yaw)
