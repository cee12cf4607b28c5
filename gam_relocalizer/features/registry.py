# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Local and global descriptors by the name that maps and command lines know them by."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from gam_relocalizer.errors import MapError, UsageError
from gam_relocalizer.features.vlad import RETRIEVAL_NAME, Vlad

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from gam_relocalizer.features.global_descriptor import GlobalDescriptor
    from gam_relocalizer.features.local import LocalExtractor
    from gam_relocalizer.scene_map import SceneMap

DEFAULT_EXTRACTOR = 'xfeat'
DEFAULT_MAX_KEYPOINTS = 2048
DEFAULT_GLOBAL_DESCRIPTOR = RETRIEVAL_NAME
GLOBAL_DESCRIPTOR_NAMES = (RETRIEVAL_NAME, 'netvlad')


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
    known = _known(name)
    if max_keypoints < 1:
        msg = f'max_keypoints must be at least 1, found {max_keypoints}'
        raise UsageError(msg)
    return known.create(max_keypoints)


def min_similarity_of(name: str) -> float:
    """Least cosine of two descriptors that may be the same point, when a map is built.

    Args:
        name: One of `EXTRACTOR_NAMES`.

    Raises:
        UsageError: Unknown name.
    """
    return _known(name).min_similarity


def load_global_descriptor(name: str, weights: Path | None) -> GlobalDescriptor | None:
    """The global descriptor of that name when it comes with weights of its own.

    Args:
        name: One of `GLOBAL_DESCRIPTOR_NAMES`.
        weights: Its weights file.

    Returns:
        None for VLAD, which is learned from the images of a map and kept in it.

    Raises:
        UsageError: Unknown name, or weights that are missing or not needed.
        WeightsError: The weights file is missing or damaged, or not one of this descriptor.
    """
    if name not in GLOBAL_DESCRIPTOR_NAMES:
        known = ', '.join(GLOBAL_DESCRIPTOR_NAMES)
        msg = f'unknown global descriptor `{name}`; known are {known}'
        raise UsageError(msg)
    if name == RETRIEVAL_NAME:
        if weights is not None:
            msg = (
                f'{weights}: given as weights of the global descriptor, but `{name}` has none; '
                f'leave them out'
            )
            raise UsageError(msg)
        return None
    if weights is None:
        msg = f'the global descriptor `{name}` needs a weights file, and none is given'
        raise UsageError(msg)
    from gam_relocalizer.features.netvlad import NetVlad

    return NetVlad.load(weights)


def global_descriptor_of(scene_map: SceneMap, weights: Path | None = None) -> GlobalDescriptor:
    """What described the reference images of a map; whether it is the same, the caller checks.

    Args:
        scene_map: The map.
        weights: Weights file of its global descriptor, when that has one.

    Raises:
        MapError: The map has an unknown global descriptor, or one with weights and none are given.
        UsageError: Weights are given and not needed.
        WeightsError: The weights file is missing or damaged, or not one of this descriptor.
    """
    manifest = scene_map.manifest
    if manifest.retrieval not in GLOBAL_DESCRIPTOR_NAMES:
        msg = (
            f'{scene_map.path}: made with the global descriptor `{manifest.retrieval}`, known are '
            f'{", ".join(GLOBAL_DESCRIPTOR_NAMES)}; build the map again with one of them'
        )
        raise MapError(msg)
    if manifest.retrieval_weights_sha256 and weights is None:
        msg = (
            f'{scene_map.path}: made with the global descriptor `{manifest.retrieval}`, which '
            f'needs its weights file (sha256 {manifest.retrieval_weights_sha256}): give it with '
            f'--global-weights, or as the parameter `global_weights` of the node'
        )
        raise MapError(msg)
    return load_global_descriptor(manifest.retrieval, weights) or Vlad(scene_map.codebook)


def _xfeat(max_keypoints: int) -> LocalExtractor:
    from gam_relocalizer.features.xfeat import XFeatExtractor

    return XFeatExtractor(max_keypoints)


def _sift(max_keypoints: int) -> LocalExtractor:
    from gam_relocalizer.features.sift import SiftExtractor

    return SiftExtractor(max_keypoints)


@dataclass(frozen=True)
class _Extractor:
    """What there is to know of an extractor before it is made.

    Attributes:
        create: Makes one that keeps the best so many keypoints. Its module is imported on demand:
            torch alone takes seconds.
        min_similarity: Least cosine of two descriptors that may be the same point.
    """

    create: Callable[[int], LocalExtractor]
    min_similarity: float


_EXTRACTORS = {'xfeat': _Extractor(_xfeat, 0.82), 'sift': _Extractor(_sift, 0.80)}
EXTRACTOR_NAMES = tuple(_EXTRACTORS)


def _known(name: str) -> _Extractor:
    if name not in _EXTRACTORS:
        msg = f'unknown extractor `{name}`; known are {", ".join(EXTRACTOR_NAMES)}'
        raise UsageError(msg)
    return _EXTRACTORS[name]
