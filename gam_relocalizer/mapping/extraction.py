# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Features of all images of a folder, and all else that is to be known of their files."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, overload

import cv2
import numpy as np
import pycolmap
import torch

from gam_relocalizer import __version__
from gam_relocalizer.cameras import format_camera, parse_camera
from gam_relocalizer.errors import ImageError, MapBuildError
from gam_relocalizer.features.local import LocalFeatures
from gam_relocalizer.images import decode_compressed, read_encoded
from gam_relocalizer.mapping.workspace import key_of

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from gam_relocalizer.features.global_descriptor import GlobalDescriptor
    from gam_relocalizer.features.local import LocalExtractor
    from gam_relocalizer.mapping.progress import Progress
    from gam_relocalizer.mapping.workspace import Workspace

FEATURES = 'features'
# Half a megabyte each. Images are matched with neighbours and with those of other passes.
_IMAGES_IN_MEMORY = 64


@dataclass(frozen=True)
class MappingImage:
    """An image to be mapped, without its pixels.

    Attributes:
        name: Relative to the folder of images.
        width: Of the image file [px].
        height: Of the image file [px].
        features: Its local features.
        global_descriptor: [G], where it is computed from the pixels.
        exif_camera: With the focal length that the file states; None when it states none.
    """

    name: str
    width: int
    height: int
    features: LocalFeatures
    global_descriptor: NDArray[np.float32] | None = None
    exif_camera: pycolmap.Camera | None = None


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
            encoded = read_encoded(folder / name)
            images.append(_extract(folder, name, encoded, extractor, describer))
        except ImageError as err:
            unreadable[name] = str(err)
        progress('extract', done, len(names))
    return ExtractedImages(tuple(images), unreadable)


class StoredImages(Sequence[MappingImage]):
    """Images in a workspace, of which only some are in memory at a time."""

    def __init__(self, workspace: Workspace, names: Sequence[str], keys: Sequence[str]) -> None:
        self._workspace = workspace
        self._names = tuple(names)
        self._keys = tuple(keys)
        self._load = lru_cache(_IMAGES_IN_MEMORY)(self._read)

    @property
    def names(self) -> tuple[str, ...]:
        """Relative to the folder of images."""
        return self._names

    @property
    def keys(self) -> tuple[str, ...]:
        """Of the results in the workspace: equal images have equal keys."""
        return self._keys

    def __len__(self) -> int:
        return len(self._names)

    @overload
    def __getitem__(self, index: int) -> MappingImage: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[MappingImage]: ...

    def __getitem__(self, index: int | slice) -> MappingImage | Sequence[MappingImage]:
        if isinstance(index, slice):
            return StoredImages(self._workspace, self._names[index], self._keys[index])
        return self._load(range(len(self))[index])

    def _read(self, index: int) -> MappingImage:
        arrays = self._workspace.load(FEATURES, self._keys[index])
        if arrays is None:
            msg = (
                f'{self._workspace.path}: the features of {self._names[index]} were removed or '
                f'damaged while the map was built; start again'
            )
            raise MapBuildError(msg)
        return _image_of(self._names[index], arrays)


@dataclass(frozen=True)
class ExtractionResult:
    """What could and what could not be read.

    Attributes:
        images: In the order of the names.
        num_usable: Number of those with any features.
        num_reused: Number of those that were in the workspace before.
        unreadable: Name to reason.
    """

    images: StoredImages
    num_usable: int
    num_reused: int
    unreadable: Mapping[str, str]


@dataclass(frozen=True)
class Extraction:
    """How images are described.

    Attributes:
        extractor: Of local features.
        max_keypoints: That the extractor keeps.
        describer: Of images as a whole; None for one that first has to see all local features.
    """

    extractor: LocalExtractor
    max_keypoints: int
    describer: GlobalDescriptor | None

    def key(self, encoded: NDArray[np.uint8]) -> str:
        """The name of what is extracted from an image file of these bytes."""
        identity, describer = self.extractor.identity, self.describer
        return key_of(
            image=hashlib.sha256(encoded.data).hexdigest(),
            extractor=[identity.name, identity.dimension, identity.weights_sha256],
            max_keypoints=self.max_keypoints,
            describer=[describer.name, describer.weights_sha256] if describer else None,
            device='cuda' if torch.cuda.is_available() else 'cpu',
            software=[
                __version__,
                np.__version__,
                torch.__version__,
                cv2.__version__,
                pycolmap.__version__,
            ],
        )


def extract_to(
    workspace: Workspace,
    folder: Path,
    names: Sequence[str],
    extraction: Extraction,
    progress: Progress,
) -> ExtractionResult:
    """As `extract_images`, to a workspace; what is there already is not extracted again."""
    read: list[tuple[str, str]] = []
    unreadable: dict[str, str] = {}
    num_usable = num_reused = 0
    for done, name in enumerate(names, start=1):
        try:
            encoded = read_encoded(folder / name)
            key = extraction.key(encoded)
            arrays = workspace.load(FEATURES, key)
            num_reused += arrays is not None
            if arrays is None:
                arrays = _arrays_of(
                    _extract(folder, name, encoded, extraction.extractor, extraction.describer)
                )
                workspace.save(FEATURES, key, arrays)
            num_usable += len(arrays['keypoints']) > 0
            read.append((name, key))
        except ImageError as err:
            unreadable[name] = str(err)
        progress('extract', done, len(names))
    images = StoredImages(workspace, [name for name, _ in read], [key for _, key in read])
    return ExtractionResult(images, num_usable, num_reused, unreadable)


def _extract(
    folder: Path,
    name: str,
    encoded: NDArray[np.uint8],
    extractor: LocalExtractor,
    describer: GlobalDescriptor | None,
) -> MappingImage:
    pixels = decode_compressed(encoded, str(folder / name))
    height, width = pixels.shape[:2]
    features = extractor.extract(pixels)
    described = None if describer is None else describer.describe(pixels, features)
    camera = _exif_camera(folder / name, width, height)
    return MappingImage(name, width, height, features, described, camera)


def _exif_camera(path: Path, width: int, height: int) -> pycolmap.Camera | None:
    try:
        camera = pycolmap.infer_camera_from_image(path)
    except (ValueError, RuntimeError):  # a format that OpenCV reads and COLMAP does not
        return None
    fits = (camera.width, camera.height) == (width, height)
    return camera if fits and camera.has_prior_focal_length else None


def _arrays_of(image: MappingImage) -> dict[str, NDArray[Any]]:
    camera = '' if image.exif_camera is None else format_camera(image.exif_camera)
    described = image.global_descriptor
    return {
        'size': np.array([image.width, image.height]),
        'keypoints': image.features.keypoints,
        'descriptors': image.features.descriptors,
        'scores': image.features.scores,
        'exif_camera': np.array(camera),
        **({} if described is None else {'global_descriptor': described}),
    }


def _image_of(name: str, arrays: Mapping[str, NDArray[Any]]) -> MappingImage:
    width, height = arrays['size'].tolist()
    camera = str(arrays['exif_camera'])
    return MappingImage(
        name=name,
        width=width,
        height=height,
        features=LocalFeatures(arrays['keypoints'], arrays['descriptors'], arrays['scores']),
        global_descriptor=arrays.get('global_descriptor'),
        exif_camera=parse_camera(camera) if camera else None,
    )
