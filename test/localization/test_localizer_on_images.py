# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The loaded localizer, with its real extractor and matcher, on rendered images."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from gam_relocalizer.errors import UsageError, WeightsError
from gam_relocalizer.geometry import pose_error
from gam_relocalizer.localization.localizer import Localizer, LocalizerOptions
from gam_relocalizer.localization.result import Status
from gam_relocalizer.matching.bmnet import BMNetConfig
from gam_relocalizer.matching.networks import create_config, create_network
from gam_relocalizer.matching.weights import Provenance, save_weights

if TYPE_CHECKING:
    from tiny_place import TinyPlace

    from gam_relocalizer.localization.result import LocalizationResult
    from gam_relocalizer.matching.graph import MatchingNetwork


@pytest.fixture(scope='module')
def localizer(tiny_place: TinyPlace) -> Localizer:
    return Localizer.load(tiny_place.map_path)


def weights_of(path: Path, network: MatchingNetwork, extractor: str = 'xfeat') -> Path:
    save_weights(path, network, Provenance(1, 1, 0, (extractor,), 0.5))
    return path


def localized_first(tiny_place: TinyPlace, options: LocalizerOptions) -> LocalizationResult:
    image, _ = tiny_place.queries[0]
    return Localizer.load(tiny_place.map_path, options).localize(image, tiny_place.camera)


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


def test_matcher_is_the_one_named(tiny_place: TinyPlace) -> None:
    localizer = Localizer.load(tiny_place.map_path, LocalizerOptions(matcher='nn-cross'))
    for image, truth in tiny_place.queries:
        result = localizer.localize(image, tiny_place.camera)
        assert result.accepted
        error = pose_error(result.estimate.camera_from_map, truth)
        assert error.position < 0.05
        assert error.rotation_deg < 1.0


@pytest.mark.parametrize(('logit', 'believes'), [(9.0, True), (-9.0, False)])
def test_weights_are_those_given(
    tiny_place: TinyPlace, tmp_path: Path, *, logit: float, believes: bool
) -> None:
    """A network with one opinion of every candidate, for a matcher that drops what it doubts."""
    network = create_network(BMNetConfig(point_blocks=1, edge_blocks=1, point_width=8))
    with torch.no_grad():
        network.edge_net[-1].weight.zero_()
        network.edge_net[-1].bias.fill_(logit)
    weights = weights_of(tmp_path / 'opinion.npz', network)
    result = localized_first(tiny_place, LocalizerOptions(matcher='plainnet', weights=weights))
    assert (result.matches > 0) is believes
    assert believes or result.status is Status.TOO_FEW_MATCHES


def test_weights_of_a_network_that_looks_at_descriptors_are_bound_to_them(
    tiny_place: TinyPlace, tmp_path: Path
) -> None:
    network = create_network(create_config('gamnet'))
    made_for = {name: weights_of(tmp_path / name, network, name) for name in ('xfeat', 'sift')}
    Localizer.load(tiny_place.map_path, LocalizerOptions(weights=made_for['xfeat']))
    with pytest.raises(WeightsError, match='sift'):
        Localizer.load(tiny_place.map_path, LocalizerOptions(weights=made_for['sift']))


def test_weights_of_a_network_that_sees_geometry_alone_suit_any_descriptors(
    tiny_place: TinyPlace, tmp_path: Path
) -> None:
    network = create_network(create_config('oanet'))
    weights = weights_of(tmp_path / 'oanet.npz', network, 'sift')
    Localizer.load(tiny_place.map_path, LocalizerOptions(matcher='nn-oanet', weights=weights))


@pytest.mark.parametrize(
    ('options', 'error'),
    [
        (LocalizerOptions(matcher='best'), UsageError),
        (LocalizerOptions(matcher='nn-cross', weights=Path('tuned.npz')), UsageError),
        (LocalizerOptions(weights=Path('nowhere.npz')), WeightsError),
    ],
)
def test_matchers_that_cannot_be_had_are_errors(
    tiny_place: TinyPlace, options: LocalizerOptions, error: type[Exception]
) -> None:
    with pytest.raises(error):
        Localizer.load(tiny_place.map_path, options)
