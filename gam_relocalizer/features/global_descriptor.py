# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The one contract that every global descriptor meets."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from gam_relocalizer.features.local import LocalFeatures


class GlobalDescriptor(Protocol):
    """Describes an image as a whole, so that images of one place are found by their dot product."""

    @property
    def name(self) -> str:
        """What maps and command lines know it by."""

    @property
    def weights_sha256(self) -> str:
        """Sum of its weights file, or empty when it has none."""

    @property
    def dimension(self) -> int:
        """Length G of a global descriptor."""

    def describe(self, image: NDArray[np.uint8], features: LocalFeatures) -> NDArray[np.float32]:
        """Global descriptor of one image.

        Args:
            image: RGB [H,W,3] or grey [H,W].
            features: Its local features.

        Returns:
            [G] of length one, or all zeros for an image that shows too little to be described.
        """
