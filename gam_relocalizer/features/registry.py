# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The extractors by the name that maps and command lines know them by."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gam_relocalizer.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Callable

    from gam_relocalizer.features.local import LocalExtractor

DEFAULT_EXTRACTOR = 'xfeat'
DEFAULT_MAX_KEYPOINTS = 2048


def create_extractor(
    name: str = DEFAULT_EXTRACTOR, max_keypoints: int = DEFAULT_MAX_KEYPOINTS
) -> LocalExtractor:
    """The extractor of that name.

    Args:
        name: One of `EXTRACTOR_NAMES`.
        max_keypoints: The best so many keypoints of an image are kept.

    Raises:
        UsageError: Unknown name, or `max_keypoints` below 1.
        WeightsError: The extractor's package or weights are missing or damaged.
    """
    if name not in _FACTORIES:
        msg = f'unknown extractor `{name}`; known are {", ".join(EXTRACTOR_NAMES)}'
        raise UsageError(msg)
    if max_keypoints < 1:
        msg = f'max_keypoints must be at least 1, found {max_keypoints}'
        raise UsageError(msg)
    return _FACTORIES[name](max_keypoints)


def _xfeat(max_keypoints: int) -> LocalExtractor:
    from gam_relocalizer.features.xfeat import XFeatExtractor

    return XFeatExtractor(max_keypoints)


def _sift(max_keypoints: int) -> LocalExtractor:
    from gam_relocalizer.features.sift import SiftExtractor

    return SiftExtractor(max_keypoints)


# Imported on demand: torch alone takes seconds.
_FACTORIES: dict[str, Callable[[int], LocalExtractor]] = {'xfeat': _xfeat, 'sift': _sift}
EXTRACTOR_NAMES = tuple(_FACTORIES)
