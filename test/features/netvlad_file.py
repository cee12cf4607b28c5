# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Weights files of NetVLAD in the layout of its authors, narrow and random."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.io import savemat

from gam_relocalizer.features.local import LocalFeatures

if TYPE_CHECKING:
    from pathlib import Path

CHANNELS = (4, 4, 6, 6, 8, 8, 8, 12, 12, 12, 12, 12, 12)
CLUSTERS = 5
WHITENED = 16
MEAN = (123.0, 117.0, 104.0)
# NetVLAD looks at the pixels alone.
NO_FEATURES = LocalFeatures(*(np.zeros(shape, np.float32) for shape in ((0, 2), (0, 4), (0,))))
# The layers of VGG16 that halve the image, counted among its convolutions.
_POOLED_AFTER = (2, 4, 7, 10)


def random_layers(*, whitening: bool = True, seed: int = 0) -> list[dict[str, Any]]:
    """The layers of the file from the first convolution to the last normalisation."""
    rng = np.random.default_rng(seed)

    def numbers(*shape: int, scale: float = 1.0) -> np.ndarray:
        return (scale * rng.normal(size=shape)).astype(np.float32)

    layers: list[dict[str, Any]] = []
    inputs = (3, *CHANNELS[:-1])
    for number, (channels_in, channels) in enumerate(zip(inputs, CHANNELS, strict=True), start=1):
        kernels = numbers(3, 3, channels_in, channels, scale=(2 / (9 * channels_in)) ** 0.5)
        layers.append(layer('conv', weights=cell(kernels, numbers(channels, 1))))
        if number < len(CHANNELS):
            layers.append(layer('relu', leak=0.0))
        if number in _POOLED_AFTER:
            layers.append(layer('pool', pool=[2, 2]))
    layers.append(layer('normalize', param=[2 * CHANNELS[-1], 1e-12, 1, 0.5]))
    pooling = [numbers(1, 1, CHANNELS[-1], CLUSTERS, scale=scale) for scale in (5.0, 0.3)]
    layers.append(layer('custom', weights=cell(*pooling), K=CLUSTERS, D=CHANNELS[-1]))
    layers += [layer('custom', weights=cell()), layer('custom')]
    if whitening:
        pooled = CHANNELS[-1] * CLUSTERS
        pair = cell(numbers(1, 1, pooled, WHITENED), numbers(WHITENED, 1, scale=0.1))
        layers += [layer('conv', weights=pair), layer('custom')]
    return layers


def layer(kind: str, **fields: object) -> dict[str, Any]:
    return {'type': kind, 'name': kind, **fields}


def cell(*arrays: np.ndarray) -> np.ndarray:
    """A row of a MATLAB cell array."""
    stored = np.empty((1, len(arrays)), dtype=object)
    for index, array in enumerate(arrays):
        stored[0, index] = array
    return stored


def write_netvlad_file(path: Path, layers: list[dict[str, Any]] | None = None) -> Path:
    """A file with those layers, random ones with whitening if there are none."""
    average = np.broadcast_to(np.float32(MEAN), (4, 4, 3))
    net = {
        'layers': cell(*(random_layers() if layers is None else layers)),
        'meta': {'normalization': {'averageImage': average}},
    }
    savemat(path, {'net': net}, do_compression=True)
    return path
