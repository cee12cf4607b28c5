# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The map bundle: a directory that holds all a relocalizer needs of a place.

    manifest.yaml             what the bundle is, how it was made, size and sha256 of every file
    images.txt                reference images: `name qw qx qy qz tx ty tz`, camera_from_sfm
    points.npy                [N,3] float64, SfM frame
    descriptors.npy           [N,D] float16, mean descriptor of each track
    observation_offsets.npy   [I+1] int64: image i sees observation_points[offsets[i]:offsets[i+1]]
    observation_points.npy    int32 indices into points
    global.npy                [I,G] float32 global descriptors of the reference images
    codebook.npy              [W,D] float32 words of VLAD; none with another global descriptor
    sfm/                      the COLMAP model (optional at run time)

A bundle is untrusted input: nothing is unpickled, sizes and sums are compared with the manifest,
and indices are checked, before anything is used.
"""

from __future__ import annotations

import hashlib
import math
import shutil
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pycolmap
import yaml
from scipy.sparse import csr_matrix

from gam_relocalizer.errors import MapError, PosesFileError
from gam_relocalizer.geometry import (
    quaternion_wxyz,
    read_poses,
    rigid3d_from,
    write_poses,
    write_text,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from numpy.typing import NDArray

FORMAT_VERSION = 1
MANIFEST = 'manifest.yaml'
IMAGES = 'images.txt'
SFM = 'sfm'
RUN_TIME_FILES = (
    IMAGES,
    'points.npy',
    'descriptors.npy',
    'observation_offsets.npy',
    'observation_points.npy',
    'global.npy',
    'codebook.npy',
)
MAX_MANIFEST_BYTES = 16 * 2**20
_HASH_BLOCK = 2**20


@dataclass(frozen=True)
class ExtractorIdentity:
    """What made the local descriptors; a map refuses queries of another one.

    Attributes:
        name: Name of the extractor, for example `xfeat`.
        dimension: Length of a descriptor.
        weights_sha256: Sum of the network's weights, or empty when it has none.
    """

    name: str
    dimension: int
    weights_sha256: str


@dataclass(frozen=True)
class MapFrame:
    """How the SfM frame lies in the map frame.

    Attributes:
        scale: Metres (when metric) per SfM unit.
        rotation_wxyz: Unit quaternion of map_from_sfm.
        translation: Translation of map_from_sfm [map units].
        metric: Whether a map unit is a metre.
        source: Where scale and orientation come from, in words.
    """

    scale: float = 1.0
    rotation_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    metric: bool = False
    source: str = 'structure from motion: arbitrary origin, orientation and scale'

    @property
    def map_from_sfm(self) -> pycolmap.Sim3d:
        """The similarity that takes SfM coordinates to map coordinates."""
        rigid = rigid3d_from(self.rotation_wxyz, self.translation)
        return pycolmap.Sim3d(
            scale=self.scale, rotation=rigid.rotation, translation=rigid.translation
        )


@dataclass(frozen=True)
class FileEntry:
    """Size and sum of one file of the bundle."""

    size: int
    sha256: str


@dataclass(frozen=True)
class Manifest:
    """The contents of manifest.yaml.

    Attributes:
        extractor: What made the local descriptors.
        retrieval: Name of the global descriptor.
        frame: Scale and alignment.
        counts: Numbers of images, points and observations.
        build: Inputs, options, software versions and results of the build.
        files: Every file of the bundle but the manifest itself, by relative name.
        format_version: Version of this layout.
        retrieval_weights_sha256: Sum of the weights of the global descriptor, or empty when it has
            none.
        alignment: How the frame was found and how well it fits; empty when nobody aligned the map.
    """

    extractor: ExtractorIdentity
    retrieval: str
    frame: MapFrame
    counts: Mapping[str, int]
    build: Mapping[str, Any] = field(default_factory=dict)
    files: Mapping[str, FileEntry] = field(default_factory=dict)
    format_version: int = FORMAT_VERSION
    retrieval_weights_sha256: str = ''
    alignment: Mapping[str, Any] = field(default_factory=dict)

    @property
    def map_id(self) -> str:
        """Short name of exactly this map: it changes with any byte of any file, and the frame."""
        sums = ''.join(f'{name}{entry.sha256}' for name, entry in sorted(self.files.items()))
        frame = f'{self.frame.scale!r}{self.frame.rotation_wxyz!r}{self.frame.translation!r}'
        return hashlib.sha256(f'{sums}{frame}'.encode()).hexdigest()[:12]


@dataclass(frozen=True)
class MapContent:
    """What a map builder hands over to be saved; all in the SfM frame.

    Attributes:
        image_names: I names of the reference images.
        camera_from_sfm: I poses.
        points: [N,3] float64.
        descriptors: [N,D], L2-normalised; stored as float16.
        observation_offsets: [I+1] int64.
        observation_points: [nnz] int32.
        global_descriptors: [I,G] float32.
        codebook: [W,D] float32, the words of VLAD; W = 0 with another global descriptor.
    """

    image_names: tuple[str, ...]
    camera_from_sfm: tuple[pycolmap.Rigid3d, ...]
    points: NDArray[np.float64]
    descriptors: NDArray[np.floating[Any]]
    observation_offsets: NDArray[np.int64]
    observation_points: NDArray[np.int32]
    global_descriptors: NDArray[np.float32]
    codebook: NDArray[np.float32]


@dataclass(frozen=True)
class SceneMap:
    """A loaded map. Points and poses are in the map frame (map_from_sfm applied).

    Attributes:
        path: The bundle's directory.
        manifest: What manifest.yaml says.
        image_names: I names of the reference images.
        camera_from_map: I poses of the reference images.
        points: [N,3] float64.
        descriptors: [N,D] float16, memory-mapped.
        observation_offsets: [I+1] int64.
        observation_points: [nnz] int32.
        global_descriptors: [I,G] float32.
        codebook: [W,D] float32, the words of VLAD; W = 0 with another global descriptor.
    """

    path: Path
    manifest: Manifest
    image_names: tuple[str, ...]
    camera_from_map: tuple[pycolmap.Rigid3d, ...]
    points: NDArray[np.float64]
    descriptors: NDArray[np.float16]
    observation_offsets: NDArray[np.int64]
    observation_points: NDArray[np.int32]
    global_descriptors: NDArray[np.float32]
    codebook: NDArray[np.float32]

    @property
    def num_images(self) -> int:
        """Number of reference images."""
        return len(self.image_names)

    def points_seen_by(self, image: int) -> NDArray[np.int32]:
        """Indices of the points that a reference image observes (the paper's meta scene)."""
        begin, end = self.observation_offsets[image : image + 2]
        return self.observation_points[begin:end]

    def positions_of(self, points: NDArray[np.integer]) -> NDArray[np.float64]:
        """[K,3] places of some points [K], map frame."""
        return np.asarray(self.points[points], np.float64)

    def descriptors_of(self, points: NDArray[np.integer]) -> NDArray[np.float32]:
        """[K,D] mean descriptors of some points [K], of length one."""
        return np.asarray(self.descriptors[points], np.float32)

    def likeness(self, global_descriptor: NDArray[np.float32]) -> NDArray[np.float32]:
        """[I] how much each reference image looks like a query [G]: the cosine of the two."""
        return np.asarray(self.global_descriptors @ global_descriptor, np.float32)

    @cached_property
    def camera_positions(self) -> NDArray[np.float64]:
        """[I,3] where the reference images were taken, map frame."""
        positions = [pose.tgt_origin_in_src() for pose in self.camera_from_map]
        return np.array(positions, np.float64).reshape(-1, 3)

    @cached_property
    def covisibility(self) -> csr_matrix:
        """[I,I] int32: number of points that two reference images share (beta in the paper)."""
        return csr_matrix(self._observed @ self._observed.T)

    @cached_property
    def observers(self) -> csr_matrix:
        """[N,I] int32: 1 where a reference image (column) observes a point (row)."""
        return csr_matrix(self._observed.T)

    @property
    def _observed(self) -> csr_matrix:
        """[I,N] int32: 1 where a reference image (row) observes a point (column)."""
        ones = np.ones(len(self.observation_points), dtype=np.int32)
        return csr_matrix(
            (ones, self.observation_points, self.observation_offsets),
            shape=(self.num_images, len(self.points)),
        )


def save_map(
    path: Path,
    content: MapContent,
    manifest: Manifest,
    sfm: pycolmap.Reconstruction | None,
) -> Manifest:
    """Writes a bundle, replacing one that is there; a failure leaves nothing half-written.

    Args:
        path: The bundle's directory.
        content: Arrays, in the SfM frame.
        manifest: Everything but `counts` and `files`, which are filled in here.
        sfm: The COLMAP model to keep beside the arrays.

    Returns:
        The manifest as written.

    Raises:
        MapError: `path` exists and is not a map bundle.
    """
    if path.exists() and not (path / MANIFEST).is_file():
        msg = f'{path}: exists and is not a map bundle (no {MANIFEST}); choose another name'
        raise MapError(msg)
    temporary = path.with_name(f'.{path.name}.part')
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    try:
        complete = _write_bundle(temporary, content, manifest, sfm)
        _replace_directory(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return complete


def load_map(path: Path) -> SceneMap:
    """Loads and validates a bundle; descriptors stay memory-mapped.

    Raises:
        MapError: Anything missing, damaged, inconsistent or of another version; the message names
            the file, what was expected and what was found.
    """
    manifest = read_manifest(path)
    verify_files(path, manifest, (name for name in manifest.files if not _is_sfm(name)))
    images, points = manifest.counts['images'], manifest.counts['points']
    observations = manifest.counts['observations']
    dimension = manifest.extractor.dimension
    sfm_points = _read_array(path / 'points.npy', np.float64, (points, 3))
    names, camera_from_sfm = _read_images(path / IMAGES, images)
    map_from_sfm = manifest.frame.map_from_sfm
    scene_map = SceneMap(
        path=path,
        manifest=manifest,
        image_names=names,
        camera_from_map=tuple(
            map_from_sfm.transform_camera_world(transform) for transform in camera_from_sfm
        ),
        points=map_from_sfm * sfm_points if points else sfm_points,
        descriptors=_read_array(
            path / 'descriptors.npy', np.float16, (points, dimension), mapped=True
        ),
        observation_offsets=_read_array(path / 'observation_offsets.npy', np.int64, (images + 1,)),
        observation_points=_read_array(path / 'observation_points.npy', np.int32, (observations,)),
        global_descriptors=_read_array(path / 'global.npy', np.float32, (images, None)),
        codebook=_read_array(path / 'codebook.npy', np.float32, (None, dimension)),
    )
    _check_observations(scene_map)
    return scene_map


def load_content(path: Path) -> tuple[Manifest, MapContent]:
    """All that `save_map` wants of a bundle, in its SfM frame: to write a changed one.

    Raises:
        MapError: As `load_map`.
    """
    scene_map = load_map(path)
    sfm_from_map = scene_map.manifest.frame.map_from_sfm.inverse()
    content = MapContent(
        image_names=scene_map.image_names,
        camera_from_sfm=tuple(
            sfm_from_map.transform_camera_world(pose) for pose in scene_map.camera_from_map
        ),
        points=np.asarray(sfm_from_map * scene_map.points, np.float64),
        descriptors=np.asarray(scene_map.descriptors, np.float32),
        observation_offsets=scene_map.observation_offsets,
        observation_points=scene_map.observation_points,
        global_descriptors=scene_map.global_descriptors,
        codebook=scene_map.codebook,
    )
    return scene_map.manifest, content


def save_frame(path: Path, frame: MapFrame, alignment: Mapping[str, Any]) -> Manifest:
    """Lays a bundle into another frame; nothing but its manifest is written.

    Raises:
        MapError: As `read_manifest`.
    """
    manifest = replace(read_manifest(path), frame=frame, alignment=alignment)
    _write_manifest(path, manifest)
    return manifest


def read_manifest(path: Path) -> Manifest:
    """Reads and checks manifest.yaml alone.

    Raises:
        MapError: No bundle there, or a manifest that is damaged or of another version.
    """
    file = path / MANIFEST
    if not file.is_file():
        msg = f'{path}: not a map bundle: there is no {MANIFEST}; build one with `map build`'
        raise MapError(msg)
    if file.stat().st_size > MAX_MANIFEST_BYTES:
        msg = f'{file}: larger than {MAX_MANIFEST_BYTES} bytes; this is no manifest'
        raise MapError(msg)
    try:
        data = yaml.safe_load(file.read_text(encoding='utf-8'))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as err:
        msg = f'{file}: cannot be read as YAML: {err}'
        raise MapError(msg) from err
    version = data.get('format_version') if isinstance(data, dict) else None
    if version != FORMAT_VERSION:
        msg = (
            f'{file}: format version is {version!r}, this program reads {FORMAT_VERSION}; '
            f'rebuild the map with `map build`'
        )
        raise MapError(msg)
    try:
        return _manifest_from(data)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as err:
        msg = f'{file}: incomplete or malformed: {err!r}; rebuild the map with `map build`'
        raise MapError(msg) from err


def verify_files(path: Path, manifest: Manifest, names: Iterator[str]) -> None:
    """Compares size and sha256 of the named files with the manifest.

    Raises:
        MapError: The first file that differs, with what was expected and found.
    """
    for name in names:
        expected, file = manifest.files[name], path / name
        if not file.is_file():
            msg = f'{file}: missing; the manifest lists it with {expected.size} bytes'
            raise MapError(msg)
        size = file.stat().st_size
        if size != expected.size:
            msg = f'{file}: {size} bytes, expected {expected.size}; it is truncated or changed'
            raise MapError(msg)
        if sha256_of(file) != expected.sha256:
            msg = f'{file}: its contents differ from what was built (sha256); copy the map again'
            raise MapError(msg)


def _write_bundle(
    folder: Path,
    content: MapContent,
    manifest: Manifest,
    sfm: pycolmap.Reconstruction | None,
) -> Manifest:
    if sfm is not None:
        (folder / SFM).mkdir()
        sfm.write_binary(folder / SFM)
    poses = dict(zip(content.image_names, content.camera_from_sfm, strict=True))
    write_poses(folder / IMAGES, poses)
    arrays: dict[str, tuple[NDArray[Any], type]] = {
        'points': (content.points, np.float64),
        'descriptors': (content.descriptors, np.float16),
        'observation_offsets': (content.observation_offsets, np.int64),
        'observation_points': (content.observation_points, np.int32),
        'global': (content.global_descriptors, np.float32),
        'codebook': (content.codebook, np.float32),
    }
    for name, (array, dtype) in arrays.items():
        np.save(folder / f'{name}.npy', np.ascontiguousarray(array, dtype=dtype))
    complete = replace(
        manifest,
        counts={
            'images': len(content.image_names),
            'points': len(content.points),
            'observations': len(content.observation_points),
        },
        files={
            file.relative_to(folder).as_posix(): FileEntry(file.stat().st_size, sha256_of(file))
            for file in sorted(folder.rglob('*'))
            if file.is_file()
        },
    )
    _write_manifest(folder, complete)
    return complete


def _write_manifest(folder: Path, manifest: Manifest) -> None:
    write_text(folder / MANIFEST, yaml.safe_dump(_plain(asdict(manifest)), sort_keys=False))


def _replace_directory(source: Path, target: Path) -> None:
    """Renames a directory over another; a rename cannot replace a directory with files in it."""
    if not target.exists():
        source.rename(target)
        return
    retired = target.with_name(f'.{target.name}.old')
    shutil.rmtree(retired, ignore_errors=True)
    target.rename(retired)
    source.rename(target)
    shutil.rmtree(retired)


def _manifest_from(data: Mapping[str, Any]) -> Manifest:
    frame = data['frame']
    extractor = data['extractor']
    counts = {name: int(data['counts'][name]) for name in ('images', 'points', 'observations')}
    if min(counts.values()) < 0 or int(extractor['dimension']) <= 0:
        msg = f'negative counts {counts}'
        raise ValueError(msg)
    files = {
        str(name): FileEntry(int(entry['size']), str(entry['sha256']))
        for name, entry in data['files'].items()
    }
    missing = [name for name in RUN_TIME_FILES if name not in files]
    if missing:
        msg = f'files that are not listed, so that nothing vouches for them: {missing}'
        raise ValueError(msg)
    outside = [name for name in files if Path(name).is_absolute() or '..' in Path(name).parts]
    if outside:
        msg = f'file names that leave the bundle: {outside}'
        raise ValueError(msg)
    return Manifest(
        extractor=ExtractorIdentity(
            str(extractor['name']), int(extractor['dimension']), str(extractor['weights_sha256'])
        ),
        retrieval=str(data['retrieval']),
        frame=_frame_from(frame),
        counts=counts,
        build=dict(data['build']),
        files=files,
        # maps of releases that knew VLAD alone do not have it
        retrieval_weights_sha256=str(data.get('retrieval_weights_sha256', '')),
        alignment=dict(data.get('alignment', {})),
    )


def _frame_from(frame: Mapping[str, Any]) -> MapFrame:
    w, x, y, z = (float(value) for value in frame['rotation_wxyz'])
    tx, ty, tz = (float(value) for value in frame['translation'])
    scale = float(frame['scale'])
    numbers_ok = all(math.isfinite(v) for v in (scale, w, x, y, z, tx, ty, tz))
    if not numbers_ok or scale <= 0 or abs(math.hypot(w, x, y, z) - 1.0) > 1e-6:
        msg = f'map_from_sfm is no similarity: scale {scale}, rotation {(w, x, y, z)}'
        raise ValueError(msg)
    return MapFrame(scale, (w, x, y, z), (tx, ty, tz), bool(frame['metric']), str(frame['source']))


def _read_images(file: Path, count: int) -> tuple[tuple[str, ...], tuple[pycolmap.Rigid3d, ...]]:
    try:
        poses = read_poses(file)
    except PosesFileError as err:
        raise MapError(str(err)) from err
    if len(poses) != count:
        msg = f'{file}: {len(poses)} images, the manifest says {count}'
        raise MapError(msg)
    return tuple(poses), tuple(poses.values())


def _read_array(
    file: Path,
    dtype: type[np.generic],
    shape: tuple[int | None, ...],
    *,
    mapped: bool = False,
) -> NDArray[Any]:
    """Loads one array; `None` in the shape stands for any size."""
    try:
        # Mapped in any case: a header may claim more numbers than there is memory.
        array: NDArray[Any] = np.load(file, mmap_mode='r', allow_pickle=False)
    except (OSError, ValueError, EOFError) as err:
        msg = f'{file}: cannot be read as a NumPy array: {err}'
        raise MapError(msg) from err
    fits = array.ndim == len(shape) and all(
        want is None or want == have for want, have in zip(shape, array.shape, strict=True)
    )
    if array.dtype != dtype or not fits:
        expected = f'{np.dtype(dtype).name} {tuple("any" if n is None else n for n in shape)}'
        msg = f'{file}: expected {expected}, found {array.dtype.name} {array.shape}'
        raise MapError(msg)
    if mapped:
        return array
    if array.dtype.kind == 'f' and not np.isfinite(array).all():
        msg = f'{file}: holds numbers that are not finite'
        raise MapError(msg)
    return np.array(array)


def _check_observations(scene_map: SceneMap) -> None:
    offsets, seen = scene_map.observation_offsets, scene_map.observation_points
    if offsets[0] != 0 or offsets[-1] != len(seen) or (offsets[1:] < offsets[:-1]).any():
        msg = (
            f'{scene_map.path / "observation_offsets.npy"}: offsets must rise from 0 to '
            f'{len(seen)}, found {offsets[0]} to {offsets[-1]}'
        )
        raise MapError(msg)
    if len(seen) and (seen.min() < 0 or seen.max() >= len(scene_map.points)):
        msg = (
            f'{scene_map.path / "observation_points.npy"}: indices {seen.min()} to {seen.max()} '
            f'are not all between 0 and {len(scene_map.points) - 1}'
        )
        raise MapError(msg)


def _is_sfm(name: str) -> bool:
    return name.startswith(f'{SFM}/')


def sha256_of(file: Path) -> str:
    """Sum of a file's bytes, as `sha256sum` prints it."""
    digest = hashlib.sha256()
    with file.open('rb') as stream:
        while block := stream.read(_HASH_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def _plain(value: Any) -> Any:  # noqa: ANN401 - any YAML value
    """Tuples and mappings as the lists and dicts that YAML's safe writer knows."""
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    return value


def frame_from_sim3d(map_from_sfm: pycolmap.Sim3d, *, metric: bool, source: str) -> MapFrame:
    """The manifest's form of a similarity."""
    rigid = pycolmap.Rigid3d(rotation=map_from_sfm.rotation, translation=map_from_sfm.translation)
    w, x, y, z = (float(value) for value in quaternion_wxyz(rigid))
    tx, ty, tz = (float(value) for value in map_from_sfm.translation)
    return MapFrame(float(map_from_sfm.scale), (w, x, y, z), (tx, ty, tz), metric, source)
