# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""NetVLAD: a global descriptor from a network (Arandjelovic et al., CVPR 2016).

VGG16 up to conv5_3 without its ReLU, pooling by soft assignment to clusters, whitening. It is the
global descriptor of the paper; the weights are a file of the user's.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch.nn import functional

from gam_relocalizer.features.netvlad_weights import read_netvlad_weights
from gam_relocalizer.features.resizing import to_working_size

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from gam_relocalizer.features.local import LocalFeatures
    from gam_relocalizer.features.netvlad_weights import NetVladWeights

# The convolutions of VGG16 after which the image is halved.
_HALVED_AFTER = (1, 3, 6, 9)
# Smaller images are halved to nothing.
_MIN_SIDE = 2 ** len(_HALVED_AFTER)
# The paper's.
_MAX_SIDE = 1024


class NetVlad:
    """Describes images by a network, on the GPU when there is one."""

    def __init__(self, weights: NetVladWeights) -> None:
        device = torch.device('cuda' if torch.cuda.is_available() else 'cpu')

        def tensor(array: NDArray[np.float32]) -> torch.Tensor:
            return torch.from_numpy(array).to(device)

        self._mean = tensor(weights.mean)
        self._convolutions = [(tensor(k), tensor(bias)) for k, bias in weights.convolutions]
        self._assignment = tensor(weights.assignment)
        self._centres = tensor(weights.centres)
        self._whitening = None
        if weights.whitening is not None:
            matrix, offset = weights.whitening
            self._whitening = tensor(matrix), tensor(offset)
        self._sha256 = weights.sha256

    @classmethod
    def load(cls, path: Path) -> NetVlad:
        """The network of a weights file.

        Raises:
            WeightsError: The file is missing, damaged, or not of the layout of `netvlad_weights`.
        """
        return cls(read_netvlad_weights(path))

    @property
    def name(self) -> str:
        """What maps and command lines know it by."""
        return 'netvlad'

    @property
    def weights_sha256(self) -> str:
        """Sum of the weights file."""
        return self._sha256

    @property
    def dimension(self) -> int:
        """Length G of a global descriptor."""
        if self._whitening is None:
            return self._centres.numel()
        return len(self._whitening[1])

    def describe(
        self,
        image: NDArray[np.uint8],
        features: LocalFeatures,  # noqa: ARG002 - the contract: others describe by them
    ) -> NDArray[np.float32]:
        """Global descriptor [G] of an RGB [H,W,3] or grey [H,W] image.

        Its longer side is shrunk to 1024 px; all zeros when the shorter one is then below 16 px.
        """
        working, _ = to_working_size(image, _MAX_SIDE)
        if min(working.shape[:2]) < _MIN_SIDE:
            return np.zeros(self.dimension, np.float32)
        rgb = working if working.ndim == 3 else np.repeat(working[..., None], 3, axis=2)
        with torch.inference_mode():
            pixels = torch.from_numpy(rgb.astype(np.float32)).to(self._mean.device)
            local = self._local_descriptors((pixels - self._mean).permute(2, 0, 1))
            described = pool(local, self._assignment, self._centres)
            if self._whitening is not None:
                matrix, offset = self._whitening
                described = functional.normalize(matrix @ described + offset, dim=0)
        return np.asarray(described.cpu().numpy(), np.float32)

    def _local_descriptors(self, pixels: torch.Tensor) -> torch.Tensor:
        """[D,N] of length one, each for a square of 16 px, from [3,H,W]."""
        maps = pixels[None]
        for index, (kernels, bias) in enumerate(self._convolutions):
            if index:
                maps = functional.relu(maps, inplace=True)
            if index - 1 in _HALVED_AFTER:
                maps = functional.max_pool2d(maps, 2)
            maps = functional.conv2d(maps, kernels, bias, padding=1)
        return functional.normalize(maps[0].flatten(1), dim=0)


def pool(local: torch.Tensor, assignment: torch.Tensor, centres: torch.Tensor) -> torch.Tensor:
    """Sums the residuals of local descriptors to clusters, each by how well it fits.

    Args:
        local: [D,N], columns of length one.
        assignment: [K,D]: its products with a descriptor are the logits of the clusters.
        centres: [K,D].

    Returns:
        [D*K] of length one, the cluster running fastest, residuals of each cluster normalised
        before.
    """
    shares = torch.softmax(assignment @ local, dim=0)
    residuals = shares @ local.T - shares.sum(dim=1, keepdim=True) * centres
    within_clusters = functional.normalize(residuals, dim=1)
    return functional.normalize(within_clusters.T.flatten(), dim=0)
