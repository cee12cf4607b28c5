# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Local features that others extracted: COLMAP's database, and the HDF5 files of hloc.

Both are untrusted: nothing is read before its size is known to fit, and nothing from other files.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING, Any, Protocol

import h5py
import numpy as np

from gam_relocalizer.cameras import PIXEL_CENTRE
from gam_relocalizer.errors import ModelError
from gam_relocalizer.features.local import LocalFeatures

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from gam_relocalizer.mapping.colmap_model import ModelImage

SIFT = 'sift'
_SIFT_DIMENSION = 128
_COLMAP_SIFT_TYPE = 0
# Keypoints of a model and of its features are the same but for printed digits, and in doubt half a
# pixel for where the first one has its centre.
_MAX_OFFSET_PX = 1.0
# The mean number of a SIFT descriptor of length one: square roots (RootSIFT) are flatter. Over
# indoor, outdoor and phone images it is 0.060 to 0.068 with, and 0.045 to 0.052 without them.
_LEAST_ROOT_MEAN = 0.056


class ForeignFeatures(Protocol):
    """Features by name of image."""

    @property
    def extractor(self) -> str:
        """Name of our extractor that finds the same."""

    def of(self, image: ModelImage, dimension: int) -> LocalFeatures:
        """The features of an image, one for each of its keypoints and in their order.

        Args:
            image: Of the model.
            dimension: Length of a descriptor.

        Raises:
            ModelError: There are none, or they are damaged or not those of the model.
        """


class DatabaseFeatures:
    """SIFT features in a database of COLMAP, which is opened for reading alone.

    COLMAP's descriptors have the layout of OpenCV's and the same normalisation (RootSIFT) times
    512, in bytes.
    """

    extractor = SIFT

    def __init__(self, file: Path) -> None:
        if not file.is_file():
            msg = f'{file}: no such database'
            raise ModelError(msg)
        self._file = file

    def of(self, image: ModelImage, dimension: int) -> LocalFeatures:
        """See `ForeignFeatures`."""
        with self._errors_named(), closing(self._open()) as database:
            columns = {row[1] for row in database.execute('PRAGMA table_info(descriptors)')}
            # releases of COLMAP before 4 know SIFT alone, and do not note it
            kind = 'd.type' if 'type' in columns else str(_COLMAP_SIFT_TYPE)
            found = database.execute(
                'SELECT k.rows, k.cols, k.data, d.rows, d.cols, d.data, '  # noqa: S608 - no input
                f'{kind} FROM images i JOIN keypoints k ON k.image_id = i.image_id '
                'JOIN descriptors d ON d.image_id = i.image_id WHERE i.name = ?',
                (image.name,),
            ).fetchone()
        where = f'{self._file}: image `{image.name}`'
        if found is None:
            msg = f'{where}: no features of it; is this the database of the model?'
            raise ModelError(msg)
        *_, descriptor_columns, _, kind_found = found
        if kind_found != _COLMAP_SIFT_TYPE or descriptor_columns != _SIFT_DIMENSION:
            msg = (
                f'{where}: features of type {kind_found} with {descriptor_columns} columns are not '
                f'SIFT; give the images with --images'
            )
            raise ModelError(msg)
        keypoints = _blob(found[2], found[0], found[1], np.dtype('<f4'), where)
        descriptors = _blob(found[5], found[3], found[4], np.dtype('u1'), where)
        return _checked(keypoints, descriptors, image, dimension, where, is_sift=True)

    def _open(self) -> sqlite3.Connection:
        # as a URI, so that SQLite neither creates nor locks nor repairs anything
        return sqlite3.connect(f'{self._file.absolute().as_uri()}?mode=ro&immutable=1', uri=True)

    @contextmanager
    def _errors_named(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, OverflowError, UnicodeError) as err:
            msg = f'{self._file}: cannot be read as a database of COLMAP: {err}'
            raise ModelError(msg) from err


class HlocFeatures:
    """Features in an HDF5 file of hloc: a group per image, nested where its name has slashes.

    `keypoints` [M,2] have pixel centres at integers, `descriptors` are [D,M].
    """

    def __init__(self, file: Path, extractor: str) -> None:
        if not file.is_file():
            msg = f'{file}: no such file of features'
            raise ModelError(msg)
        self._file = file
        self._extractor = extractor

    @property
    def extractor(self) -> str:
        """See `ForeignFeatures`."""
        return self._extractor

    def of(self, image: ModelImage, dimension: int) -> LocalFeatures:
        """See `ForeignFeatures`."""
        where = f'{self._file}: image `{image.name}`'
        count = len(image.keypoints)
        try:
            with h5py.File(self._file, 'r') as file:
                group = _group(file, image.name, where)
                keypoints = _dataset(group, 'keypoints', (count, 2), where)
                descriptors = _dataset(group, 'descriptors', (dimension, count), where)
        except (OSError, RuntimeError, ValueError, KeyError, TypeError) as err:
            msg = f'{where}: cannot be read: {err}'
            raise ModelError(msg) from err
        return _checked(
            keypoints + PIXEL_CENTRE,
            descriptors.T,
            image,
            dimension,
            where,
            is_sift=self._extractor == SIFT,
        )


def _blob(data: object, rows: int, columns: int, dtype: np.dtype[Any], where: str) -> NDArray[Any]:
    """[rows,columns] of a database; an image without features has no bytes."""
    stored = data if isinstance(data, bytes) else b''
    sizes_fit = isinstance(rows, int) and isinstance(columns, int) and rows >= 0 < columns
    if not sizes_fit or rows * columns * dtype.itemsize != len(stored):
        msg = f'{where}: {len(stored)} bytes for {rows} x {columns} numbers; it is damaged'
        raise ModelError(msg)
    return np.frombuffer(stored, dtype).reshape(rows, columns)


def _group(file: h5py.File, name: str, where: str) -> h5py.Group:
    group: h5py.Group = file
    for part in name.split('/'):
        link = group.get(part, getlink=True)
        # others lead to other files, or around in circles
        found = group[part] if isinstance(link, h5py.HardLink) else None
        if not isinstance(found, h5py.Group):
            msg = f'{where}: no features of it; are these the features of the model?'
            raise ModelError(msg)
        group = found
    return group


def _dataset(
    group: h5py.Group, name: str, shape: tuple[int, int], where: str
) -> NDArray[np.float32]:
    link = group.get(name, getlink=True)
    found = group[name] if isinstance(link, h5py.HardLink) else None
    if not isinstance(found, h5py.Dataset) or found.is_virtual or found.external:
        msg = f'{where}: no `{name}` in the file itself'
        raise ModelError(msg)
    if found.shape != shape or found.dtype.kind not in 'fiu':
        msg = (
            f'{where}: `{name}` is {found.dtype} {found.shape}, expected numbers {shape}: one for '
            f'each keypoint of the model, of the length of the extractor; with other features give '
            f'the images with --images'
        )
        raise ModelError(msg)
    return np.asarray(found[()], dtype=np.float32)


def _checked(
    keypoints: NDArray[Any],
    descriptors: NDArray[Any],
    image: ModelImage,
    dimension: int,
    where: str,
    *,
    is_sift: bool,
) -> LocalFeatures:
    count = len(image.keypoints)
    if len(keypoints) != count or descriptors.shape != (count, dimension):
        msg = (
            f'{where}: {len(keypoints)} keypoints and descriptors {descriptors.shape}; the model '
            f'has {count} keypoints, and a descriptor has {dimension} numbers; with other features '
            f'give the images with --images'
        )
        raise ModelError(msg)
    offset = np.abs(keypoints[:, :2].astype(np.float64) - image.keypoints).max(initial=0.0)
    if not (offset < _MAX_OFFSET_PX and np.isfinite(descriptors).all()):
        msg = (
            f'{where}: its keypoints are not where the model has them (up to {offset:.1f} px off), '
            f'or its descriptors are not finite; are these the features of the model?'
        )
        raise ModelError(msg)
    unit = _unit(descriptors.astype(np.float32))
    return LocalFeatures(
        keypoints=image.keypoints.astype(np.float32),
        descriptors=_as_root_sift(unit) if is_sift else unit,
        scores=np.zeros(count, np.float32),
    )


def _unit(descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Of length one, or zero where there is nothing."""
    lengths = np.linalg.norm(descriptors, axis=1, keepdims=True)
    unit: NDArray[np.float32] = descriptors / np.maximum(lengths, np.finfo(np.float32).tiny)
    return unit


def _as_root_sift(unit: NDArray[np.float32]) -> NDArray[np.float32]:
    """SIFT descriptors of length one, which may be RootSIFT already (COLMAP's default)."""
    if not len(unit) or unit.mean() > _LEAST_ROOT_MEAN:
        return unit
    sums = np.maximum(unit.sum(axis=1, keepdims=True), np.finfo(np.float32).tiny)
    root: NDArray[np.float32] = np.sqrt(np.maximum(unit, 0.0) / sums)
    return root
