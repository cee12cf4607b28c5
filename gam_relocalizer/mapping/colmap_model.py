# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Reads COLMAP models of others, text or binary, as untrusted input.

COLMAP's own reader does not come back from a frames.bin that was cut short, and trusts counts and
indices. What is needed here is in cameras, images and points3D alone: images hold their poses in
models with rigs, too.
"""

from __future__ import annotations

import math
import struct
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import numpy as np
import pycolmap

from gam_relocalizer.cameras import parse_camera
from gam_relocalizer.errors import CameraError, ModelError
from gam_relocalizer.geometry import rigid3d_from

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from typing import Any

    from numpy.typing import NDArray

NO_POINT = -1
"""In place of a point, for a keypoint that observes none."""

_FILES = ('cameras', 'images', 'points3D')
_SUFFIXES = ('.bin', '.txt')
_ROTATION_TOLERANCE = 1e-2
# Further out than the Moon: a number that was damaged.
_MAX_COORDINATE = 1e9
_CAMERA, _IMAGE, _POINT = struct.Struct('<iiQQ'), struct.Struct('<I7dI'), struct.Struct('<Q3d3BdQ')
_COUNT = struct.Struct('<Q')
_TRACK_ELEMENT_BYTES = 8
_POINT2D = np.dtype([('xy', '<f8', 2), ('point', '<i8')])


@dataclass(frozen=True)
class ModelImage:
    """An image that a model knows the pose of.

    Attributes:
        name: As in the model.
        camera_id: Of the camera that took it.
        camera_from_world: Its pose.
        keypoints: [M,2] pixels, COLMAP convention.
        points: [M] int64, rows of the model's points, or `NO_POINT`.
    """

    name: str
    camera_id: int
    camera_from_world: pycolmap.Rigid3d
    keypoints: NDArray[np.float64]
    points: NDArray[np.int64]


@dataclass(frozen=True)
class ColmapModel:
    """A model as its files have it.

    Attributes:
        folder: Where it is.
        cameras: By id.
        images: Sorted by name.
        points: [N,3] float64, sorted by id.
        errors: [N] mean reprojection errors [px]; negative where nobody computed them.
    """

    folder: Path
    cameras: Mapping[int, pycolmap.Camera]
    images: tuple[ModelImage, ...]
    points: NDArray[np.float64]
    errors: NDArray[np.float64]

    @property
    def mean_reprojection_error(self) -> float | None:
        """Over the points, as the model says [px]; None when it does not say."""
        known = self.errors[self.errors >= 0]
        return float(known.mean()) if len(known) else None


def is_colmap_model(folder: Path) -> bool:
    """Whether a folder has files of a COLMAP model; they may be damaged."""
    return any((folder / f'images{suffix}').is_file() for suffix in _SUFFIXES)


def read_colmap_model(folder: Path) -> ColmapModel:
    """Reads a model; binary files are preferred when text is there as well.

    Raises:
        ModelError: Files that are missing, damaged or do not fit together, or no images; the
            message names the file and, for text, the line.
    """
    suffix = next((one for one in _SUFFIXES if _is_complete(folder, one)), None)
    if suffix is None:
        raise ModelError(_missing(folder))
    cameras_file, images_file, points_file = (folder / f'{name}{suffix}' for name in _FILES)
    read_cameras, read_images, read_points = _READERS[suffix]
    cameras = _unique(read_cameras(cameras_file), cameras_file)
    point_ids, points, errors = _sorted_points(list(read_points(points_file)), points_file)
    images = [
        _image(record, cameras, point_ids, images_file) for record in read_images(images_file)
    ]
    names = {image.name for image in images}
    if not images or len(names) != len(images):
        found = 'an image twice' if images else 'no images'
        msg = f'{images_file}: {found}; expected a model of images with poses'
        raise ModelError(msg)
    return ColmapModel(
        folder, cameras, tuple(sorted(images, key=lambda one: one.name)), points, errors
    )


@dataclass(frozen=True)
class _ImageRecord:
    where: str
    name: str
    camera_id: int
    pose: Sequence[float]
    keypoints: NDArray[np.float64]
    point_ids: NDArray[np.int64]


@dataclass(frozen=True)
class _PointRecord:
    point_id: int
    xyz: Sequence[float]
    error: float


def _is_complete(folder: Path, suffix: str) -> bool:
    return all((folder / f'{name}{suffix}').is_file() for name in _FILES)


def _missing(folder: Path) -> str:
    names = ', '.join(f'{name}.bin' for name in _FILES)
    below = sorted(
        {file.parent for file in folder.glob('*/*/images.*')}
        | {file.parent for file in folder.glob('*/images.*')}
    )
    hint = ''
    if below:
        hint = f'; is it {" or ".join(str(one.relative_to(folder)) for one in below[:5])}?'
    return f'{folder}: no complete COLMAP model: expected {names}, or all three as .txt{hint}'


def _unique(
    records: Iterator[tuple[int, pycolmap.Camera]], file: Path
) -> dict[int, pycolmap.Camera]:
    cameras: dict[int, pycolmap.Camera] = {}
    for camera_id, camera in records:
        if camera_id in cameras:
            msg = f'{file}: camera {camera_id} is there twice'
            raise ModelError(msg)
        cameras[camera_id] = camera
    return cameras


def _sorted_points(
    records: Sequence[_PointRecord], file: Path
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    ids = np.array([record.point_id for record in records], dtype=np.uint64).view(np.int64)
    xyz = np.array([record.xyz for record in records], dtype=np.float64).reshape(-1, 3)
    errors = np.array([record.error for record in records], dtype=np.float64)
    wrong = ~(np.abs(xyz) < _MAX_COORDINATE).all(axis=1)
    if wrong.any():
        first = int(np.flatnonzero(wrong)[0])
        msg = f'{file}: point {ids[first]} lies at {xyz[first].tolist()}'
        raise ModelError(msg)
    order = np.argsort(ids, kind='stable')
    if (np.diff(ids[order]) == 0).any() or (ids < 0).any():
        msg = f'{file}: the ids of points are not all different and positive'
        raise ModelError(msg)
    return ids[order], xyz[order], errors[order]


def _image(
    record: _ImageRecord,
    cameras: Mapping[int, pycolmap.Camera],
    point_ids: NDArray[np.int64],
    file: Path,
) -> ModelImage:
    path = PurePosixPath(record.name)
    if not record.name or path.is_absolute() or '..' in path.parts:
        msg = f'{record.where}: the name {record.name!r} is not relative to a folder of images'
        raise ModelError(msg)
    if record.camera_id not in cameras:
        msg = f'{record.where}: taken by camera {record.camera_id}, which {file.parent} has not'
        raise ModelError(msg)
    length = math.hypot(*record.pose[:4])
    in_reach = all(abs(value) < _MAX_COORDINATE for value in record.pose)
    if not in_reach or abs(length - 1.0) > _ROTATION_TOLERANCE:
        msg = f'{record.where}: {list(record.pose)} is no pose `qw qx qy qz tx ty tz`'
        raise ModelError(msg)
    if not np.isfinite(record.keypoints).all():
        msg = f'{record.where}: keypoints that are not finite'
        raise ModelError(msg)
    return ModelImage(
        name=record.name,
        camera_id=record.camera_id,
        camera_from_world=rigid3d_from(record.pose[:4], record.pose[4:]),
        keypoints=record.keypoints,
        points=_rows_of(record, point_ids),
    )


def _rows_of(record: _ImageRecord, point_ids: NDArray[np.int64]) -> NDArray[np.int64]:
    seen = record.point_ids != NO_POINT
    rows = np.full(len(seen), NO_POINT, dtype=np.int64)
    rows[seen] = np.searchsorted(point_ids, record.point_ids[seen])
    known = np.append(point_ids, NO_POINT)[rows[seen]] == record.point_ids[seen]
    if not known.all():
        unknown = record.point_ids[seen][~known][0]
        msg = f'{record.where}: sees point {unknown}, which points3D has not'
        raise ModelError(msg)
    return rows


def _camera(model: str, size: Sequence[object], params: Sequence[object], where: str) -> Any:  # noqa: ANN401
    try:
        return parse_camera(' '.join(str(word) for word in (model, *size, *params)))
    except CameraError as err:
        msg = f'{where}: {err}'
        raise ModelError(msg) from err


def _text_lines(file: Path) -> Iterator[tuple[str, str]]:
    """`file:line` and text of every line, empty ones too."""
    try:
        with file.open(encoding='utf-8') as stream:
            for number, text in enumerate(stream, start=1):
                yield f'{file}:{number}', text.strip()
    except (OSError, UnicodeDecodeError) as err:
        msg = f'{file}: cannot be read as a text: {err}'
        raise ModelError(msg) from err


def _records(file: Path) -> Iterator[tuple[str, str]]:
    return ((where, text) for where, text in _text_lines(file) if text and text[0] != '#')


def _text_cameras(file: Path) -> Iterator[tuple[int, pycolmap.Camera]]:
    for where, text in _records(file):
        words = text.split()
        with _expecting(where, 'CAMERA_ID MODEL WIDTH HEIGHT PARAMS...'):
            camera_id, model, size = int(words[0]), words[1], (int(words[2]), int(words[3]))
        yield camera_id, _camera(model, size, words[4:], where)


def _text_images(file: Path) -> Iterator[_ImageRecord]:
    lines = _text_lines(file)
    for where, text in lines:
        if not text or text[0] == '#':
            continue
        words = text.split(maxsplit=9)
        with _expecting(where, 'IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME'):
            pose, camera_id, name = [float(one) for one in words[1:8]], int(words[8]), words[9]
        # the line of keypoints is there even when it is empty
        keypoints_where, keypoints = next(lines, (where, ''))
        with _expecting(keypoints_where, 'X Y POINT3D_ID ...'):
            numbers = np.array(keypoints.split(), dtype=np.float64).reshape(-1, 3)
            ids = np.array([int(one) for one in numbers[:, 2]], dtype=np.int64)
        yield _ImageRecord(where, name, camera_id, pose, numbers[:, :2], ids)


def _text_points(file: Path) -> Iterator[_PointRecord]:
    for where, text in _records(file):
        words = text.split(maxsplit=8)
        with _expecting(where, 'POINT3D_ID X Y Z R G B ERROR TRACK...'):
            point_id = int(words[0])
            if not 0 <= point_id < 2**63:
                raise ValueError(words[0])
            xyz, error = [float(one) for one in words[1:4]], float(words[7])
        yield _PointRecord(point_id, xyz, error)


@contextmanager
def _expecting(where: str, expected: str) -> Iterator[None]:
    """Turns what goes wrong with the words of a line into an error that names it."""
    try:
        yield
    except (ValueError, IndexError, OverflowError) as err:
        msg = f'{where}: expected `{expected}`: {err}'
        raise ModelError(msg) from err


class _Cursor:
    """Walks through the bytes of a file and never beyond their end."""

    def __init__(self, file: Path) -> None:
        try:
            self._data = file.read_bytes()
        except OSError as err:
            msg = f'{file}: cannot be read: {err}'
            raise ModelError(msg) from err
        self._file = file
        self._at = 0

    def take(self, layout: struct.Struct) -> tuple[Any, ...]:
        """The next numbers."""
        return layout.unpack_from(self._data, self._advance(layout.size))

    def array(self, dtype: np.dtype[Any], count: int) -> NDArray[Any]:
        """The next numbers of one kind."""
        return np.frombuffer(self._data, dtype, count, self._advance(dtype.itemsize * count))

    def count(self, least_bytes: int) -> int:
        """The number of records that follow, of at least so many bytes each."""
        (count,) = self.take(_COUNT)
        if count * least_bytes > len(self._data) - self._at:
            msg = (
                f'{self._file}: announces {count} records at byte {self._at}, of which not all '
                f'can follow; it is truncated or damaged'
            )
            raise ModelError(msg)
        return int(count)

    def skip(self, size: int) -> None:
        """Leaves bytes out."""
        self._advance(size)

    def text(self) -> str:
        """The text up to the next zero."""
        end = self._data.find(b'\0', self._at)
        try:
            text = self._data[self._at : end].decode('utf-8') if end >= 0 else None
        except UnicodeDecodeError:
            text = None
        if text is None:
            msg = f'{self._file}: no name at byte {self._at}; it is truncated or damaged'
            raise ModelError(msg)
        self._at = end + 1
        return text

    def finish(self) -> None:
        """Refuses what is left over."""
        if self._at != len(self._data):
            msg = f'{self._file}: {len(self._data) - self._at} bytes too many; it is damaged'
            raise ModelError(msg)

    def _advance(self, size: int) -> int:
        before, self._at = self._at, self._at + size
        if self._at > len(self._data):
            msg = f'{self._file}: ends at byte {len(self._data)}, in the middle of a record'
            raise ModelError(msg)
        return before


def _binary_cameras(file: Path) -> Iterator[tuple[int, pycolmap.Camera]]:
    cursor = _Cursor(file)
    for _ in range(cursor.count(_CAMERA.size)):
        camera_id, model_id, width, height = cursor.take(_CAMERA)
        where = f'{file}: camera {camera_id}'
        name = _MODEL_NAMES.get(model_id)
        if name is None:
            msg = f'{where} is of the unknown model {model_id}'
            raise ModelError(msg)
        template = pycolmap.Camera.create_from_model_name(1, name, 1.0, 1, 1)
        params = cursor.array(np.dtype('<f8'), len(template.params)).tolist()
        yield camera_id, _camera(name, (width, height), [repr(one) for one in params], where)
    cursor.finish()


def _binary_images(file: Path) -> Iterator[_ImageRecord]:
    cursor = _Cursor(file)
    for _ in range(cursor.count(_IMAGE.size)):
        image_id, *pose, camera_id = cursor.take(_IMAGE)
        name = cursor.text()
        points = cursor.array(_POINT2D, cursor.count(_POINT2D.itemsize))
        keypoints = np.array(points['xy'], dtype=np.float64)
        ids = np.array(points['point'], dtype=np.int64)
        yield _ImageRecord(f'{file}: image {image_id}', name, camera_id, pose, keypoints, ids)
    cursor.finish()


def _binary_points(file: Path) -> Iterator[_PointRecord]:
    cursor = _Cursor(file)
    for _ in range(cursor.count(_POINT.size)):
        point_id, x, y, z, _, _, _, error, track_length = cursor.take(_POINT)
        cursor.skip(track_length * _TRACK_ELEMENT_BYTES)
        yield _PointRecord(point_id, (x, y, z), error)
    cursor.finish()


_MODEL_NAMES = {
    model.value: name
    for name, model in pycolmap.CameraModelId.__members__.items()
    if name != 'INVALID'
}
_READERS = {
    '.bin': (_binary_cameras, _binary_images, _binary_points),
    '.txt': (_text_cameras, _text_images, _text_points),
}
