# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The weights file of NetVLAD: the MATLAB file of its authors, with structs instead of objects.

MATLAB's format 5 (versions 5 to 7), with one variable `net`. MATLAB's axes:

    net.layers{..}.weights   cells of two arrays, of the layers that have weights, in this order:
        13 convolutions      [3,3,IN,OUT] and [OUT]: VGG16 up to conv5_3, ending with D channels
        NetVLAD              [D,K] of the assignment, [D,K] the centres times -1
        whitening            [D*K,G], the cluster running faster than the channel, and [G];
                             missing in files without whitening
    net.meta.normalization.averageImage   [H,W,3], its first pixel is the mean colour (RGB, 0..255)

Axes of length one do not count, names and other fields neither. All sizes but those of the
trunk's kernels are the file's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.errors import WeightsError
from gam_relocalizer.features.matlab import read_matlab_variable
from gam_relocalizer.scene_map import sha256_of

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from gam_relocalizer.features.matlab import Value

CONVOLUTIONS = 13
# The weights that are around have 0.5 GB, and 0.6 GB unpacked.
MAX_BYTES = 2_000_000_000

_EXPECTED = (
    "expected NetVLAD on VGG16 as in its authors' MATLAB file, exported with structs instead of "
    'objects'
)


@dataclass(frozen=True)
class NetVladWeights:
    """What NetVLAD has learned.

    Attributes:
        mean: [3] colour taken off every pixel, RGB from 0 to 255.
        convolutions: 13 pairs of kernels [OUT,IN,3,3] and biases [OUT]; the last has D channels.
        assignment: [K,D], local descriptors to clusters.
        centres: [K,D] of the clusters.
        whitening: [G,D*K] and the offset [G], or None.
        sha256: Sum of the file.
    """

    mean: NDArray[np.float32]
    convolutions: tuple[tuple[NDArray[np.float32], NDArray[np.float32]], ...]
    assignment: NDArray[np.float32]
    centres: NDArray[np.float32]
    whitening: tuple[NDArray[np.float32], NDArray[np.float32]] | None
    sha256: str


def read_netvlad_weights(path: Path) -> NetVladWeights:
    """Reads a weights file; nothing in it is ever run.

    Raises:
        WeightsError: The file is missing, too large, damaged, or not of this layout.
    """
    try:
        if (size := path.stat().st_size) > MAX_BYTES:
            msg = f'the weights file {path} has {size} bytes, at most {MAX_BYTES} are read'
            raise WeightsError(msg)
        net = read_matlab_variable(path, 'net', MAX_BYTES)
        sha256 = sha256_of(path)
    except FileNotFoundError as err:
        msg = f'there is no weights file at {path}; {_EXPECTED}'
        raise WeightsError(msg) from err
    except (OSError, ValueError) as err:
        msg = f'the weights file {path} cannot be read: {err}; {_EXPECTED}'
        raise WeightsError(msg) from err
    return _weights_from(net, path, sha256)


def _weights_from(net: Value, path: Path, sha256: str) -> NetVladWeights:
    pairs = _pairs_of_weights(net)
    if len(pairs) not in (CONVOLUTIONS + 1, CONVOLUTIONS + 2):
        msg = (
            f'{path} has {len(pairs)} layers with readable weights, expected {CONVOLUTIONS} '
            f'convolutions, NetVLAD and perhaps whitening; {_EXPECTED}'
        )
        raise WeightsError(msg)
    convolutions = _convolutions(pairs[:CONVOLUTIONS], path)
    channels = len(convolutions[-1][1])
    assignment, negated_centres = pairs[CONVOLUTIONS]
    assignment = _array(path, 'the assignment of NetVLAD', assignment, channels, None)
    clusters = assignment.shape[1]
    negated_centres = _array(path, 'centres of NetVLAD', negated_centres, channels, clusters)
    return NetVladWeights(
        mean=_mean_colour(net, path),
        convolutions=convolutions,
        assignment=np.ascontiguousarray(assignment.T),
        centres=np.ascontiguousarray(-negated_centres.T),
        whitening=_whitening(pairs[CONVOLUTIONS + 1 :], channels * clusters, path),
        sha256=sha256,
    )


def _pairs_of_weights(net: Value) -> list[Sequence[Value]]:
    layers = _field(net, 'layers')
    weights = [_field(layer, 'weights') for layer in layers] if isinstance(layers, list) else []
    return [pair for pair in weights if isinstance(pair, list) and len(pair) == 2]


def _convolutions(
    pairs: Sequence[Sequence[Value]], path: Path
) -> tuple[tuple[NDArray[np.float32], NDArray[np.float32]], ...]:
    convolutions = []
    channels = 3
    for number, (kernels, bias) in enumerate(pairs, start=1):
        kernels_in_file = _array(path, f'convolution {number}', kernels, 3, 3, channels, None)
        channels = kernels_in_file.shape[3]
        convolutions.append(
            (
                np.ascontiguousarray(kernels_in_file.transpose(3, 2, 0, 1)),
                _array(path, f'the bias of convolution {number}', bias, channels),
            )
        )
    return tuple(convolutions)


def _whitening(
    pairs: Sequence[Sequence[Value]], pooled: int, path: Path
) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
    if not pairs:
        return None
    ((matrix, offset),) = pairs
    matrix = _array(path, 'the whitening', matrix, pooled, None)
    offset = _array(path, 'the offset of the whitening', offset, matrix.shape[1])
    return np.ascontiguousarray(matrix.T), offset


def _mean_colour(net: Value, path: Path) -> NDArray[np.float32]:
    average = _field(_field(_field(net, 'meta'), 'normalization'), 'averageImage')
    pixel = average[:1, :1] if isinstance(average, np.ndarray) and average.ndim == 3 else average
    return _array(path, 'the colour of averageImage', pixel, 3)


def _field(value: Value, name: str) -> Value:
    return value.get(name) if isinstance(value, dict) else None


def _array(path: Path, what: str, value: Value, *shape: int | None) -> NDArray[np.float32]:
    """Numbers of that shape but for axes of length one; `None` stands for any size above."""
    array = np.squeeze(value) if isinstance(value, np.ndarray) else np.array(None)
    fits = array.ndim == len(shape) and all(
        want in (None, have) for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits or not array.size:
        expected = ' x '.join('any' if size is None else str(size) for size in shape)
        found = ' x '.join(map(str, array.shape)) or 'none'
        msg = f'{path}: {what} has {found} numbers, expected {expected}; {_EXPECTED}'
        raise WeightsError(msg)
    with np.errstate(over='ignore'):
        numbers = array.astype(np.float32, copy=False)
    if not np.isfinite(numbers).all():
        msg = f'{path}: {what} holds numbers that are not finite: fetch the file again'
        raise WeightsError(msg)
    return numbers
