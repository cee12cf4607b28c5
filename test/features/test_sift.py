# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from blobs import blob_image

from gam_relocalizer.features.sift import SiftExtractor


def test_centre_of_a_blob_is_found_in_colmap_pixels() -> None:
    y, x = np.mgrid[0:160, 0:200]
    blob = np.exp(-((x - 120) ** 2 + (y - 70) ** 2) / (2 * 6.0**2))
    image = (200 * blob).astype(np.uint8)

    keypoints = SiftExtractor(max_keypoints=5).extract(image).keypoints

    np.testing.assert_allclose(keypoints[0], [120.5, 70.5], atol=0.05)


def test_keypoints_of_a_large_image_are_in_its_own_pixels() -> None:
    small = blob_image(1600, 320)
    large = small.repeat(2, axis=0).repeat(2, axis=1)

    expected = SiftExtractor(max_keypoints=200).extract(small).keypoints
    found = SiftExtractor(max_keypoints=200).extract(large).keypoints

    np.testing.assert_allclose(found, 2.0 * expected, atol=1e-3)


def test_descriptors_have_length_one_and_best_come_first() -> None:
    features = SiftExtractor(max_keypoints=50).extract(blob_image(320, 256))

    assert len(features) == 50
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1.0, atol=1e-5)
    assert (np.diff(features.scores) <= 0).all()


@pytest.mark.parametrize('shape', [(256, 320), (256, 320, 3), (1, 1, 3)])
def test_nothing_to_see_gives_no_features(shape: tuple[int, ...]) -> None:
    features = SiftExtractor(max_keypoints=50).extract(np.zeros(shape, dtype=np.uint8))

    assert features.keypoints.shape == (0, 2)
    assert features.descriptors.shape == (0, 128)
    assert features.scores.shape == (0,)
