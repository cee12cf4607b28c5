# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Features of all images of a folder."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from gam_relocalizer.errors import ImageError
from gam_relocalizer.images import read_image

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from gam_relocalizer.features.global_descriptor import GlobalDescriptor
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
        global_descriptor: [G], where it is computed from the pixels.
    """

    name: str
    width: int
    height: int
    features: LocalFeatures
    global_descriptor: NDArray[np.float32] | None = None


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
    folder: Path,
    names: Sequence[str],
    extractor: LocalExtractor,
    describer: GlobalDescriptor | None,
    progress: Progress,
) -> ExtractedImages:
    """Reads and describes the named images; one that cannot be read is noted and left out.

    Args:
        folder: The folder of images.
        names: Relative to it.
        extractor: Of local features.
        describer: Of images as a whole; None for one that first has to see all local features.
        progress: Told of the step extract.
    """
    images: list[MappingImage] = []
    unreadable: dict[str, str] = {}
    for done, name in enumerate(names, start=1):
        try:
            pixels = read_image(folder / name)
        except ImageError as err:
            unreadable[name] = str(err)
        else:
            height, width = pixels.shape[:2]
            features = extractor.extract(pixels)
            described = None if describer is None else describer.describe(pixels, features)
            images.append(MappingImage(name, width, height, features, described))
        progress('extract', done, len(names))
    return ExtractedImages(tuple(images), unreadable)
