# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Local features of all images of a folder."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from gam_relocalizer.errors import ImageError
from gam_relocalizer.images import read_image

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from gam_relocalizer.features.local import LocalExtractor, LocalFeatures
    from gam_relocalizer.mapping.progress import Progress


@dataclass(frozen=True)
class MappingImage:
    """An image to be mapped, without its pixels.

    Attributes:
        name: Relative to the folder of images.
        width: Of the image file [px].
        height: Of the image file [px].
        features: Its local features.
    """

    name: str
    width: int
    height: int
    features: LocalFeatures


@dataclass(frozen=True)
class ExtractedImages:
    """What could and what could not be read.

    Attributes:
        images: In the order of the names.
        unreadable: Name to reason.
    """

    images: tuple[MappingImage, ...]
    unreadable: Mapping[str, str]


def extract_images(
    folder: Path, names: Sequence[str], extractor: LocalExtractor, progress: Progress
) -> ExtractedImages:
    """Reads and describes the named images; one that cannot be read is noted and left out."""
    images: list[MappingImage] = []
    unreadable: dict[str, str] = {}
    for done, name in enumerate(names, start=1):
        try:
            pixels = read_image(folder / name)
        except ImageError as err:
            unreadable[name] = str(err)
        else:
            height, width = pixels.shape[:2]
            images.append(MappingImage(name, width, height, extractor.extract(pixels)))
        progress('extract', done, len(names))
    return ExtractedImages(tuple(images), unreadable)
