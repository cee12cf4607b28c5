# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The loaded localizer, with its real extractor and matcher, on rendered images."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from gam_relocalizer.geometry import pose_error
from gam_relocalizer.localization.localizer import Localizer
from gam_relocalizer.localization.result import Status

if TYPE_CHECKING:
    from tiny_place import TinyPlace


@pytest.fixture(scope='module')
def localizer(tiny_place: TinyPlace) -> Localizer:
    return Localizer.load(tiny_place.map_path)


def test_queries_are_accepted_near_the_truth(localizer: Localizer, tiny_place: TinyPlace) -> None:
    errors = []
    for image, truth in tiny_place.queries:
        result = localizer.localize(image, tiny_place.camera)
        if result.accepted:
            errors.append(pose_error(result.estimate.camera_from_map, truth))
    assert len(errors) >= 0.95 * len(tiny_place.queries)
    assert np.median([error.position for error in errors]) < 0.05
    assert np.median([error.rotation_deg for error in errors]) < 1.0
    assert max(error.position for error in errors) < 0.3


def test_grey_images_are_as_good(localizer: Localizer, tiny_place: TinyPlace) -> None:
    image, truth = tiny_place.queries[0]
    grey = np.round(image @ [0.299, 0.587, 0.114]).astype(np.uint8)
    result = localizer.localize(grey, tiny_place.camera)
    assert result.accepted
    assert pose_error(result.estimate.camera_from_map, truth).position < 0.1


def test_same_image_gives_the_same_bytes(tiny_place: TinyPlace) -> None:
    image, _ = tiny_place.queries[0]
    first, second = (
        Localizer.load(tiny_place.map_path).localize(image, tiny_place.camera) for _ in range(2)
    )
    for part in ('camera_from_map', 'covariance'):
        values = [getattr(result.estimate, part) for result in (first, second)]
        arrays = [value.matrix() if part == 'camera_from_map' else value for value in values]
        assert arrays[0].tobytes() == arrays[1].tobytes()
    assert first.reason == second.reason


def test_images_of_nothing_are_refused(localizer: Localizer, tiny_place: TinyPlace) -> None:
    shape = (tiny_place.camera.height, tiny_place.camera.width)
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, (*shape, 3), dtype=np.uint8)
    stripes = np.tile(np.arange(shape[1]) // 16 % 2 * 255, (shape[0], 1)).astype(np.uint8)
    for image in (np.zeros(shape, np.uint8), np.full(shape, 255, np.uint8), noise, stripes):
        result = localizer.localize(image, tiny_place.camera)
        assert not result.accepted
        assert result.reason
    black = localizer.localize(np.zeros(shape, np.uint8), tiny_place.camera)
    assert black.status is Status.TOO_FEW_FEATURES


def test_a_scrambled_image_is_refused(localizer: Localizer, tiny_place: TinyPlace) -> None:
    """Right features at wrong places: only geometry can tell."""
    image, _ = tiny_place.queries[0]
    tile = 80
    rows, columns = image.shape[0] // tile, image.shape[1] // tile
    tiles = [
        image[r * tile : (r + 1) * tile, c * tile : (c + 1) * tile]
        for r in range(rows)
        for c in range(columns)
    ]
    scrambled = np.zeros_like(image)
    for place, index in enumerate(np.random.default_rng(1).permutation(len(tiles))):
        r, c = divmod(place, columns)
        scrambled[r * tile : (r + 1) * tile, c * tile : (c + 1) * tile] = tiles[index]
    assert not localizer.localize(scrambled, tiny_place.camera).accepted
