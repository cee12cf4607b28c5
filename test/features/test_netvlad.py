# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pickle
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from netvlad_file import (
    CHANNELS,
    CLUSTERS,
    MEAN,
    NO_FEATURES,
    WHITENED,
    cell,
    layer,
    random_layers,
    write_netvlad_file,
)
from scipy.io import loadmat, savemat
from scipy.signal import correlate2d

from gam_relocalizer.errors import WeightsError
from gam_relocalizer.features import netvlad_weights
from gam_relocalizer.features.netvlad import NetVlad, pool
from gam_relocalizer.features.netvlad_weights import read_netvlad_weights
from gam_relocalizer.scene_map import sha256_of

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

POOLED = CHANNELS[-1] * CLUSTERS


@pytest.fixture(scope='module')
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_netvlad_file(tmp_path_factory.mktemp('netvlad') / 'weights.mat')


@pytest.fixture(scope='module')
def net(file: Path) -> NetVlad:
    return NetVlad.load(file)


def picture(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def describe(net: NetVlad, image: np.ndarray) -> np.ndarray:
    return net.describe(image, NO_FEATURES)


def unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def described_by_the_paper(file: Path, image: np.ndarray) -> np.ndarray:
    """NetVLAD as the authors' MATLAB code runs it, layer after layer, read by SciPy."""
    stored = loadmat(file, struct_as_record=False, squeeze_me=True)['net']
    maps = image.astype(np.float64) - stored.meta.normalization.averageImage[0, 0]
    for one in stored.layers:
        if one.type == 'conv' and maps.ndim == 3:
            maps = convolved(maps, one.weights[0]) + one.weights[1]
        elif one.type == 'relu':
            maps = np.maximum(maps, 0)
        elif one.type == 'pool':
            height, width = (side // 2 * 2 for side in maps.shape[:2])
            corners = [maps[y:height:2, x:width:2] for y in (0, 1) for x in (0, 1)]
            maps = np.max(corners, axis=0)
        elif one.type == 'custom' and maps.ndim == 3:
            maps = pooled_by_the_paper(maps.reshape(-1, maps.shape[2]), *one.weights)
        elif one.type == 'conv':
            maps = unit(maps @ one.weights[0] + one.weights[1])
    return maps


def convolved(maps: np.ndarray, kernels: np.ndarray) -> np.ndarray:
    padded = np.pad(maps, ((1, 1), (1, 1), (0, 0)))
    _, _, inputs, outputs = kernels.shape
    return np.stack(
        [
            sum(correlate2d(padded[..., i], kernels[..., i, o], 'valid') for i in range(inputs))
            for o in range(outputs)
        ],
        axis=2,
    )


def pooled_by_the_paper(
    local: np.ndarray, assignment: np.ndarray, negated_centres: np.ndarray
) -> np.ndarray:
    """Equation 4 with the sums written out, then both normalisations; the cluster runs fastest."""
    sums = np.zeros(assignment.shape)
    for descriptor in local:
        descriptor = unit(descriptor)  # noqa: PLW2901 - the layer before
        logits = np.exp(descriptor @ assignment)
        for k, share in enumerate(logits / logits.sum()):
            sums[:, k] += share * (descriptor + negated_centres[:, k])
    return unit((sums / np.linalg.norm(sums, axis=0)).ravel())


@settings(deadline=None)
@given(seed=st.integers(0, 1000), count=st.integers(1, 30))
def test_pooling_is_that_of_the_paper(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    local = rng.normal(size=(count, 7))
    assignment, centres = rng.normal(size=(2, 7, 4))
    unit_columns = (local / np.linalg.norm(local, axis=1, keepdims=True)).T

    found = pool(*(torch.from_numpy(array) for array in (unit_columns, assignment.T, centres.T)))

    expected = pooled_by_the_paper(local, assignment, -centres)
    np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.parametrize('shape', [(48, 64), (49, 67)])
@pytest.mark.parametrize('whitening', [True, False])
def test_descriptor_is_that_of_the_paper(
    tmp_path: Path, shape: tuple[int, int], *, whitening: bool
) -> None:
    file = write_netvlad_file(tmp_path / 'weights.mat', random_layers(whitening=whitening))
    net, image = NetVlad.load(file), picture(*shape)

    expected = described_by_the_paper(file, image)

    assert expected.shape == (net.dimension,) == ((WHITENED if whitening else POOLED),)
    np.testing.assert_allclose(describe(net, image), expected, atol=1e-4)


@settings(max_examples=15, deadline=None)
@given(height=st.integers(16, 90), width=st.integers(16, 90), seed=st.integers(0, 100))
def test_length_is_one(net: NetVlad, height: int, width: int, seed: int) -> None:
    assert np.linalg.norm(describe(net, picture(height, width, seed))) == pytest.approx(1, abs=1e-5)


def test_same_image_same_bytes(file: Path) -> None:
    first, second = (describe(NetVlad.load(file), picture(60, 80)) for _ in range(2))

    assert first.tobytes() == second.tobytes()


def test_grey_is_the_colour_of_equal_channels(net: NetVlad) -> None:
    grey = picture(60, 80)[..., 0]

    coloured = np.stack([grey] * 3, axis=2)

    np.testing.assert_array_equal(describe(net, grey), describe(net, coloured))


def test_large_images_are_shrunk_to_the_size_of_the_paper(net: NetVlad) -> None:
    image = picture(384, 1024)

    enlarged = image.repeat(2, axis=0).repeat(2, axis=1)

    np.testing.assert_allclose(describe(net, enlarged), describe(net, image), atol=1e-6)


@pytest.mark.parametrize('shape', [(15, 400), (1, 1), (20, 4000)])
def test_images_without_a_single_local_descriptor_give_zero(
    net: NetVlad, shape: tuple[int, int]
) -> None:
    np.testing.assert_array_equal(describe(net, picture(*shape)), np.zeros(WHITENED))


def test_nearly_the_same_image_is_nearer_than_another(net: NetVlad) -> None:
    place, other = picture(80, 96, seed=1), picture(80, 96, seed=2)
    noise = np.random.default_rng(3).normal(scale=3, size=place.shape)
    again = np.clip(place + noise, 0, 255).astype(np.uint8)

    same, different = describe(net, again) @ np.stack(
        [describe(net, place), describe(net, other)], axis=1
    )

    assert same > different


def test_weights_are_known_by_the_sum_of_their_file(net: NetVlad, file: Path) -> None:
    assert (net.name, net.weights_sha256) == ('netvlad', sha256_of(file))


def test_the_mean_is_that_of_the_file(file: Path) -> None:
    np.testing.assert_array_equal(read_netvlad_weights(file).mean, np.float32(MEAN))


def test_whole_numbers_stored_as_integers_are_numbers(tmp_path: Path) -> None:
    layers = random_layers()
    layers[0]['weights'] = cell(layers[0]['weights'][0, 0], np.zeros((1, CHANNELS[0]), np.uint8))

    weights = read_netvlad_weights(write_netvlad_file(tmp_path / 'weights.mat', layers))

    np.testing.assert_array_equal(weights.convolutions[0][1], np.zeros(CHANNELS[0]))


def with_weights(index: int, *arrays: np.ndarray) -> Callable[[list[dict]], None]:
    def change(layers: list[dict]) -> None:
        layers[index]['weights'] = cell(*arrays)

    return change


def remove_first(layers: list[dict]) -> None:
    del layers[0]


def add_one_more(layers: list[dict]) -> None:
    layers.append(layer('conv', weights=cell(np.ones((3, 3)), np.ones(3))))


ONES = np.ones(CHANNELS[0], np.float32)


@pytest.mark.parametrize(
    ('change', 'told'),
    [
        (remove_first, r'convolution 1 .* 3 x 3 x 3'),
        (add_one_more, '16 layers'),
        (with_weights(0, np.ones((5, 5, 3, 4)), ONES), 'convolution 1 has 5 x 5 x 3 x 4'),
        (with_weights(0, np.ones((3, 3, 3, 4)), ONES[1:]), 'the bias of convolution 1'),
        (with_weights(2, np.ones((3, 3, 9, 4)), ONES), 'convolution 2 .* 3 x 3 x 4 x any'),
        (with_weights(30, np.ones((9, CLUSTERS)), np.ones((9, CLUSTERS))), 'assignment'),
        (with_weights(30, np.ones((12, CLUSTERS)), np.ones((12, 9))), 'centres'),
        (with_weights(33, np.ones((9, 7)), np.ones(7)), f'whitening .* {POOLED} x any'),
        (with_weights(33, np.ones((POOLED, 7)), np.ones(8)), 'offset of the whitening'),
        (with_weights(30, np.full((12, CLUSTERS), np.nan), np.ones((12, CLUSTERS))), 'finite'),
        (with_weights(30, np.full((12, CLUSTERS), 1e300), np.ones((12, CLUSTERS))), 'finite'),
        (with_weights(30), 'assignment'),
    ],
)
def test_files_of_another_network_are_refused_and_told_what_was_expected(
    tmp_path: Path, change: Callable[[list[dict]], None], told: str
) -> None:
    layers = random_layers()
    change(layers)

    with pytest.raises(WeightsError, match=told):
        read_netvlad_weights(write_netvlad_file(tmp_path / 'weights.mat', layers))


def test_files_of_something_else_are_refused(tmp_path: Path, file: Path) -> None:
    path = tmp_path / 'weights.mat'
    contents = [
        b'',
        b'no weights',
        pickle.dumps({'net': [1, 2, 3]}) * 100,
        file.read_bytes()[:-1],
        file.read_bytes()[:4000],
    ]
    for content in contents:
        path.write_bytes(content)
        with pytest.raises(WeightsError, match=r'weights\.mat'):
            read_netvlad_weights(path)
    for variables in ({'other': 1.0}, {'net': 1.0}, {'net': {'layers': 'text'}}):
        savemat(path, variables)
        with pytest.raises(WeightsError, match='expected'):
            read_netvlad_weights(path)


@pytest.mark.parametrize('name', ['nowhere.mat', '.'])
def test_files_that_are_not_there_are_weights_errors(tmp_path: Path, name: str) -> None:
    with pytest.raises(WeightsError, match='expected'):
        read_netvlad_weights(tmp_path / name)


@pytest.mark.parametrize('compressed', [False, True])
def test_files_that_are_too_large_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, compressed: bool
) -> None:
    """A small file may unpack to a large one."""
    path = tmp_path / 'weights.mat'
    monkeypatch.setattr(netvlad_weights, 'MAX_BYTES', 10_000)
    savemat(path, {'net': np.zeros(100_000)}, do_compression=compressed)
    assert (path.stat().st_size < 10_000) is compressed

    with pytest.raises(WeightsError, match='10000'):
        read_netvlad_weights(path)
