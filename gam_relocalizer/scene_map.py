# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The map bundle: a directory that holds all a relocalizer needs of a place.

    manifest.yaml             what the bundle is, how it was made, size and sha256 of every file
    images.txt                reference images: `name qw qx qy qz tx ty tz`, camera_from_sfm
    points.npy                [N,3] float32, SfM frame, from the manifest's `points_origin`
    descriptors.npy           [N,D] mean descriptor of each track: float16, or with
                              `descriptor_bits: 8` int8, the largest number of each at +-127
    observation_first.npy     [I] int32: the lowest point that image i sees, -1 if it sees none
    observation_offsets.npy   [I+1] int64: image i has observation_gaps[offsets[i]:offsets[i+1]]
    observation_gaps.npy      uint8: how many points are left out before the next one it sees
    covisibility_offsets.npy  [I+1] int32: image i has covisibility_images[offsets[i]:offsets[i+1]]
    covisibility_images.npy   int32, rising and above i: the images that share points with image i
    covisibility_counts.npy   uint16: how many, at most 65535
    global.npy                [I,ceil(G/2)] uint8: global descriptors, four bits a number, 8 is zero
    global_scales.npy         [I] float32: what the numbers of each image are multiplied with
    codebook.npy              [W,D] float16 words of VLAD; none with another global descriptor
    sfm/                      the COLMAP model (optional at run time)

How gaps and four bits are laid out, `map_encoding.py` says. Lengths of descriptors are not stored:
they are one. Points, descriptors, gaps and global descriptors stay on the disk: what a query looks
at is mapped into memory. Rows of points follow the images that see them first, so that gaps fit
into a byte each and the points of a scene lie together.

A bundle is untrusted input: nothing is unpickled, sizes and sums are compared with the manifest,
and indices are checked, before anything is used.
"""

from __future__ import annotations

import errno
import hashlib
import math
import mmap
import os
import shutil
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property, lru_cache
from pathlib import Path
from tokenize import TokenError
from typing import TYPE_CHECKING, Any

import numpy as np
import pycolmap
import yaml
from scipy.sparse import csc_matrix, csr_matrix, diags_array, triu

from gam_relocalizer.errors import MapError, PosesFileError, UsageError
from gam_relocalizer.geometry import (
    quaternion_wxyz,
    read_poses,
    rigid3d_from,
    write_poses,
    write_text,
)
from gam_relocalizer.map_encoding import (
    IndexSets,
    PackedVectors,
    check_offsets,
    int8_directions,
    unit_rows,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from numpy.typing import NDArray

FORMAT_VERSION = 2
MANIFEST = 'manifest.yaml'
IMAGES = 'images.txt'
SFM = 'sfm'
DESCRIPTOR_BITS = (16, 8)
MAX_MANIFEST_BYTES = 16 * 2**20
_BLOCK = 2**20
# What NumPy raises for headers that are none.
_UNREADABLE = (OSError, ValueError, EOFError, SyntaxError, TypeError, OverflowError, TokenError)
_MOST_COUNTED = np.iinfo(np.uint16).max
# Images of which the points are kept decoded: those around a few scenes.
_IMAGES_AT_HAND = 512


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
        descriptor_bits: For each number of a local descriptor as stored, 16 or 8.
        points_origin: What the stored points count from, SfM frame, so that single precision is
            enough for them; `save_map` chooses it.
        global_dimension: Length of a global descriptor; `save_map` fills it in.
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
    descriptor_bits: int = 16
    points_origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    global_dimension: int = 0

    @property
    def map_id(self) -> str:
        """Short name of exactly this map: it changes with any byte of any file, and the frame."""
        sums = ''.join(f'{name}{entry.sha256}' for name, entry in sorted(self.files.items()))
        frame = f'{self.frame.scale!r}{self.frame.rotation_wxyz!r}{self.frame.translation!r}'
        frame += f'{self.points_origin!r}'
        return hashlib.sha256(f'{sums}{frame}'.encode()).hexdigest()[:12]


@dataclass(frozen=True)
class MapContent:
    """What a map builder hands over to be saved; all in the SfM frame.

    Attributes:
        image_names: I names of the reference images.
        camera_from_sfm: I poses.
        points: [N,3] float64; the bundle is small when they are ordered by the first image that
            sees them.
        descriptors: [N,D], L2-normalised.
        observation_offsets: [I+1] int64: image i sees observation_points[offsets[i]:offsets[i+1]].
        observation_points: [nnz] int32 indices into points.
        global_descriptors: [I,G] float32, L2-normalised.
        codebook: [W,D] float32, the words of VLAD, in numbers that float16 holds; W = 0 with
            another global descriptor.
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
class StoredArrays:
    """The arrays of a bundle as they are stored, each in a file of its name; see the head."""

    points: NDArray[np.float32]
    descriptors: NDArray[np.float16] | NDArray[np.int8]
    observation_first: NDArray[np.int32]
    observation_offsets: NDArray[np.int64]
    observation_gaps: NDArray[np.uint8]
    covisibility_offsets: NDArray[np.int32]
    covisibility_images: NDArray[np.int32]
    covisibility_counts: NDArray[np.uint16]
    global_: NDArray[np.uint8]
    global_scales: NDArray[np.float32]
    codebook: NDArray[np.float16]

    @property
    def observations(self) -> IndexSets:
        """The points that each image sees."""
        return IndexSets(self.observation_first, self.observation_offsets, self.observation_gaps)


FILE_OF_ARRAY = {one.name: f'{one.name.rstrip("_")}.npy' for one in fields(StoredArrays)}
"""File of each of the `StoredArrays`."""
RUN_TIME_FILES = (IMAGES, *FILE_OF_ARRAY.values())
_COVISIBILITY_FILES = tuple(file for file in RUN_TIME_FILES if file.startswith('covisibility'))


@dataclass(frozen=True)
class SceneMap:
    """A loaded map. Points and poses are in the map frame (map_from_sfm applied).

    A query asks for what it needs of the points (`positions_of`, `descriptors_of`), so that its
    memory does not depend on the size of the map; `points` and `observations` are for tools.

    Attributes:
        path: The bundle's directory.
        manifest: What manifest.yaml says.
        image_names: I names of the reference images.
        camera_from_map: I poses of the reference images.
        num_points_seen: [I] int64, how many points each reference image observes.
        stored: What is in the files.
    """

    path: Path
    manifest: Manifest
    image_names: tuple[str, ...]
    camera_from_map: tuple[pycolmap.Rigid3d, ...]
    num_points_seen: NDArray[np.int64]
    stored: StoredArrays

    @property
    def num_images(self) -> int:
        """Number of reference images."""
        return len(self.image_names)

    @property
    def num_points(self) -> int:
        """Number of points."""
        return len(self.stored.points)

    @property
    def points(self) -> NDArray[np.float64]:
        """[N,3] all points, map frame; computed each time."""
        return self._in_map_frame(_copied(self.stored.points, slice(None)))

    def positions_of(self, points: NDArray[np.integer]) -> NDArray[np.float64]:
        """[K,3] places of some points [K], map frame."""
        return self._in_map_frame(_copied(self.stored.points, points))

    def some_points(self, count: int) -> NDArray[np.float64]:
        """[K,3] places of at most so many points, evenly among all, map frame: to be shown."""
        step = max(1, -(-self.num_points // count))
        return self._in_map_frame(_copied(self.stored.points, slice(None, None, step)))

    def descriptors_of(self, points: NDArray[np.integer]) -> NDArray[np.float32]:
        """[K,D] mean descriptors of some points [K], of length one."""
        return unit_rows(_copied(self.stored.descriptors, points))

    def points_seen_by(self, image: int) -> NDArray[np.int32]:
        """Points that a reference image observes, rising (the paper's meta scene); not writable."""
        return self._seen_by(int(image))

    def observations(self) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """Offsets [I+1] and points: image i observes points[offsets[i]:offsets[i+1]], rising."""
        return _unpacked(self.stored.observations)

    def observers_of(self, points: NDArray[np.integer], images: NDArray[np.integer]) -> csr_matrix:
        """[K,m] int32: 1 where one of some reference images [m] observes one of some points [K]."""
        rising, rows = np.unique(points, return_inverse=True)
        seen = [self.points_seen_by(image) for image in images]
        offsets = np.cumsum([0, *map(len, seen)])
        everything = np.concatenate([np.empty(0, np.int32), *seen])
        places = np.searchsorted(rising, everything)
        found = np.append(rising, -1)[places] == everything
        kept_before = np.concatenate([[0], np.cumsum(found)])
        observers = csc_matrix(
            (np.ones(kept_before[-1], np.int32), places[found], kept_before[offsets]),
            shape=(len(rising), len(images)),
        )
        return csr_matrix(observers)[rows]

    def covisible_with(self, images: NDArray[np.integer]) -> NDArray[np.int64]:
        """Reference images that share a point with any of some [m], rising; these as well.

        Whoever observes a point that one of these images sees is among them.
        """
        return np.union1d(images, self.covisibility[images].indices).astype(np.int64)

    def likeness(self, global_descriptor: NDArray[np.float32]) -> NDArray[np.float32]:
        """[I] how much each reference image looks like a query [G]: the cosine of the two."""
        likeness = self._global_descriptors.products(global_descriptor)
        _give_back(self.stored.global_)
        return likeness

    def global_descriptor_of(self, image: int) -> NDArray[np.float32]:
        """[G] of a reference image."""
        return self._global_descriptors[image]

    @cached_property
    def codebook(self) -> NDArray[np.float32]:
        """[W,D] the words of VLAD; W = 0 with another global descriptor."""
        return self.stored.codebook.astype(np.float32)

    @cached_property
    def camera_positions(self) -> NDArray[np.float64]:
        """[I,3] where the reference images were taken, map frame."""
        positions = [pose.tgt_origin_in_src() for pose in self.camera_from_map]
        return np.array(positions, np.float64).reshape(-1, 3)

    @cached_property
    def covisibility(self) -> csr_matrix:
        """[I,I] int32: number of points that two reference images share (beta in the paper)."""
        stored = self.stored
        above = csr_matrix(
            (
                stored.covisibility_counts.astype(np.int32),
                stored.covisibility_images,
                stored.covisibility_offsets,
            ),
            shape=(self.num_images, self.num_images),
        )
        return _symmetric(above, self.num_points_seen)

    @property
    def _global_descriptors(self) -> PackedVectors:
        return PackedVectors(
            self.stored.global_, self.stored.global_scales, self.manifest.global_dimension
        )

    @cached_property
    def _seen_by(self) -> Callable[[int], NDArray[np.int32]]:
        observations = self.stored.observations

        # holds no reference to the map, which would keep it from being freed
        @lru_cache(_IMAGES_AT_HAND)
        def seen_by(image: int) -> NDArray[np.int32]:
            seen = observations[image]
            seen.setflags(write=False)
            return seen

        return seen_by

    def _in_map_frame(self, stored: NDArray[np.float32]) -> NDArray[np.float64]:
        in_sfm = _in_sfm_frame(stored, self.manifest)
        if not len(in_sfm):
            return in_sfm
        return np.asarray(self.manifest.frame.map_from_sfm * in_sfm, np.float64)


def covisibility_of(
    offsets: NDArray[np.int64], points: NDArray[np.int32], num_points: int
) -> csr_matrix:
    """[I,I] int32: number of points that two images share, from `SceneMap.observations`."""
    ones = np.ones(len(points), np.int32)
    observed = csr_matrix((ones, points, offsets), shape=(len(offsets) - 1, num_points))
    shared = csr_matrix(observed @ observed.T)
    shared.sort_indices()
    return shared


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
        manifest: Everything but `counts`, `files`, `points_origin` and `global_dimension`, which
            are filled in here.
        sfm: The COLMAP model to keep beside the arrays.

    Returns:
        The manifest as written.

    Raises:
        MapError: `path` exists and is not a map bundle.
        UsageError: Descriptors cannot be stored in so many bits.
        OSError: The disk is full, or the folder cannot be written to.
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
    """Loads and validates a bundle; what is large stays memory-mapped.

    Raises:
        MapError: Anything missing, damaged, inconsistent or of another version; the message names
            the file, what was expected and what was found.
    """
    return _scene_map(path, _read_bundle(path))


def map_in_memory(path: Path, content: MapContent, manifest: Manifest) -> SceneMap:
    """The map that saving and loading would make, without any file: to look at what may be kept.

    Args:
        path: What the map says of itself.
        content: Arrays, in the SfM frame.
        manifest: See `save_map`; its files stay as they are.
    """
    stored, manifest = _stored(content, manifest)
    seen = stored.observations.checked_sizes(len(stored.points))
    return _scene_map(
        path, _Bundle(manifest, content.image_names, content.camera_from_sfm, seen, stored)
    )


def load_content(path: Path) -> tuple[Manifest, MapContent]:
    """All that `save_map` wants of a bundle, in its SfM frame: to write a changed one.

    Raises:
        MapError: As `load_map`.
    """
    bundle = _read_bundle(path)
    manifest, stored = bundle.manifest, bundle.stored
    offsets, points = _unpacked(stored.observations)
    described = PackedVectors(stored.global_, stored.global_scales, manifest.global_dimension)
    return manifest, MapContent(
        image_names=bundle.image_names,
        camera_from_sfm=bundle.camera_from_sfm,
        points=_in_sfm_frame(stored.points, manifest),
        descriptors=unit_rows(stored.descriptors),
        observation_offsets=offsets,
        observation_points=points,
        global_descriptors=np.concatenate(
            [
                np.empty((0, manifest.global_dimension), np.float32),
                *(described[image][None] for image in range(len(bundle.image_names))),
            ]
        ),
        codebook=stored.codebook.astype(np.float32),
    )


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
            f'build the map again from its images with `map build`'
        )
        raise MapError(msg)
    try:
        return _manifest_from(data)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as err:
        msg = f'{file}: incomplete or malformed: {err!r}; rebuild the map with `map build`'
        raise MapError(msg) from err


def write_model(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Writes COLMAP's binary files; unlike COLMAP itself, it notices when the disk is full.

    Raises:
        OSError: The disk is full.
    """
    model.write_binary(folder)
    last = folder / 'points3D.bin'
    expected = 8 + 51 * model.num_points3D() + 8 * model.compute_num_observations()
    if last.stat().st_size != expected:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(last))


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
        write_model(sfm, folder / SFM)
    poses = dict(zip(content.image_names, content.camera_from_sfm, strict=True))
    write_poses(folder / IMAGES, poses)
    stored, manifest = _stored(content, manifest)
    for name, file in FILE_OF_ARRAY.items():
        np.save(folder / file, np.ascontiguousarray(getattr(stored, name)))
    complete = replace(
        manifest,
        files={
            file.relative_to(folder).as_posix(): FileEntry(file.stat().st_size, sha256_of(file))
            for file in sorted(folder.rglob('*'))
            if file.is_file()
        },
    )
    _write_manifest(folder, complete)
    return complete


def _stored(content: MapContent, manifest: Manifest) -> tuple[StoredArrays, Manifest]:
    """The arrays as they are stored, and what the manifest says of them."""
    if manifest.descriptor_bits not in DESCRIPTOR_BITS:
        msg = f'descriptors of {manifest.descriptor_bits} bits: expected one of {DESCRIPTOR_BITS}'
        raise UsageError(msg)
    offsets, points = content.observation_offsets, content.observation_points
    observations = IndexSets.of(np.split(points, offsets[1:-1]) if len(offsets) > 1 else [])
    offsets, points = _unpacked(observations)
    covisibility = covisibility_of(offsets, points, len(content.points))
    above = csr_matrix(triu(covisibility, k=1))
    described = PackedVectors.of(content.global_descriptors)
    manifest = replace(
        manifest,
        counts={
            'images': len(content.image_names),
            'points': len(content.points),
            'observations': len(points),
        },
        points_origin=_origin_of(content.points),
        global_dimension=described.dimension,
    )
    stored = StoredArrays(
        points=(content.points - manifest.points_origin).astype(np.float32),
        descriptors=(
            int8_directions(content.descriptors)
            if manifest.descriptor_bits == 8
            else content.descriptors.astype(np.float16)
        ),
        observation_first=observations.first,
        observation_offsets=observations.offsets,
        observation_gaps=observations.gaps,
        covisibility_offsets=above.indptr.astype(np.int32),
        covisibility_images=above.indices.astype(np.int32),
        covisibility_counts=np.minimum(above.data, _MOST_COUNTED).astype(np.uint16),
        global_=described.nibbles,
        global_scales=described.scales,
        codebook=content.codebook.astype(np.float16),
    )
    return stored, manifest


def _origin_of(points: NDArray[np.float64]) -> tuple[float, float, float]:
    """The middle of points [N,3], in whole units: zero for a map that lies around its origin.

    Single precision is a tenth of a millimetre per kilometre, but half a metre where coordinates
    count from the equator.
    """
    if not len(points):
        return (0.0, 0.0, 0.0)
    x, y, z = np.rint(np.median(points, axis=0)).tolist()
    return (x + 0.0, y + 0.0, z + 0.0)


def _copied(array: NDArray[Any], rows: NDArray[np.integer] | slice) -> NDArray[Any]:
    """Some rows of an array that may be mapped: only the copy stays in memory."""
    copy = np.array(array[rows])
    _give_back(array)
    return copy


def _give_back(array: NDArray[Any]) -> None:
    """Frees what was mapped into memory of a file; it comes back when it is asked for again."""
    mapping: object = array.base
    if isinstance(mapping, mmap.mmap):
        mapping.madvise(mmap.MADV_DONTNEED)


def _in_sfm_frame(stored: NDArray[np.float32], manifest: Manifest) -> NDArray[np.float64]:
    return np.asarray(stored, np.float64) + manifest.points_origin


def _symmetric(above: csr_matrix, diagonal: NDArray[np.int64]) -> csr_matrix:
    """A matrix from what is above its diagonal, and this."""
    whole = csr_matrix(above + above.T + diags_array(diagonal, dtype=np.int32))
    whole.eliminate_zeros()
    whole.sort_indices()
    return whole


def _unpacked(observations: IndexSets) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    seen = [observations[image] for image in range(len(observations))]
    offsets = np.cumsum([0, *map(len, seen)], dtype=np.int64)
    return offsets, np.concatenate([np.empty(0, np.int32), *seen])


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
    bits, global_dimension = int(data['descriptor_bits']), int(data['global_dimension'])
    if bits not in DESCRIPTOR_BITS or global_dimension < 0:
        msg = f'descriptors of {bits} bits, global ones of length {global_dimension}'
        raise ValueError(msg)
    x, y, z = (float(value) for value in data['points_origin'])
    if not all(math.isfinite(value) for value in (x, y, z)):
        msg = f'points count from {(x, y, z)}'
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
        retrieval_weights_sha256=str(data['retrieval_weights_sha256']),
        alignment=dict(data['alignment']),
        descriptor_bits=bits,
        points_origin=(x, y, z),
        global_dimension=global_dimension,
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


@dataclass(frozen=True)
class _Bundle:
    """What is in the files of a bundle."""

    manifest: Manifest
    image_names: tuple[str, ...]
    camera_from_sfm: tuple[pycolmap.Rigid3d, ...]
    num_points_seen: NDArray[np.int64]
    stored: StoredArrays


def _scene_map(path: Path, bundle: _Bundle) -> SceneMap:
    map_from_sfm = bundle.manifest.frame.map_from_sfm
    return SceneMap(
        path=path,
        manifest=bundle.manifest,
        image_names=bundle.image_names,
        camera_from_map=tuple(
            map_from_sfm.transform_camera_world(transform) for transform in bundle.camera_from_sfm
        ),
        num_points_seen=bundle.num_points_seen,
        stored=bundle.stored,
    )


def _read_bundle(path: Path) -> _Bundle:
    manifest = read_manifest(path)
    verify_files(path, manifest, (name for name in manifest.files if not _is_sfm(name)))
    names, camera_from_sfm = _read_images(path / IMAGES, manifest.counts['images'])
    stored = _read_arrays(path, manifest)
    seen = _checked_observations(path, stored, manifest)
    _check_covisibility(path, stored, seen)
    return _Bundle(manifest, names, camera_from_sfm, seen, stored)


def _read_images(file: Path, count: int) -> tuple[tuple[str, ...], tuple[pycolmap.Rigid3d, ...]]:
    try:
        poses = read_poses(file)
    except PosesFileError as err:
        raise MapError(str(err)) from err
    if len(poses) != count:
        msg = f'{file}: {len(poses)} images, the manifest says {count}'
        raise MapError(msg)
    return tuple(poses), tuple(poses.values())


def _read_arrays(path: Path, manifest: Manifest) -> StoredArrays:
    images, points = manifest.counts['images'], manifest.counts['points']
    dimension, bits = manifest.extractor.dimension, manifest.descriptor_bits

    def mapped(name: str, dtype: type[np.generic], *shape: int | None) -> NDArray[Any]:
        return _map_array(path / FILE_OF_ARRAY[name], dtype, shape)

    def read(name: str, dtype: type[np.generic], *shape: int | None) -> NDArray[Any]:
        return np.array(mapped(name, dtype, *shape))

    return StoredArrays(
        points=mapped('points', np.float32, points, 3),
        descriptors=mapped('descriptors', np.int8 if bits == 8 else np.float16, points, dimension),
        observation_first=read('observation_first', np.int32, images),
        observation_offsets=read('observation_offsets', np.int64, images + 1),
        observation_gaps=mapped('observation_gaps', np.uint8, None),
        covisibility_offsets=read('covisibility_offsets', np.int32, images + 1),
        covisibility_images=read('covisibility_images', np.int32, None),
        covisibility_counts=read('covisibility_counts', np.uint16, None),
        global_=mapped('global_', np.uint8, images, -(-manifest.global_dimension // 2)),
        global_scales=read('global_scales', np.float32, images),
        codebook=read('codebook', np.float16, None, dimension),
    )


def _map_array(file: Path, dtype: type[np.generic], shape: tuple[int | None, ...]) -> NDArray[Any]:
    """Maps one array of finite numbers; `None` in the shape stands for any size."""
    try:
        array: NDArray[Any] = np.load(file, mmap_mode='r', allow_pickle=False)
    except _UNREADABLE as err:
        msg = f'{file}: cannot be read as a NumPy array: {err}'
        raise MapError(msg) from err
    fits = array.ndim == len(shape) and all(
        want is None or want == have for want, have in zip(shape, array.shape, strict=True)
    )
    if array.dtype != dtype or not fits:
        expected = f'{np.dtype(dtype).name} {tuple("any" if n is None else n for n in shape)}'
        msg = f'{file}: expected {expected}, found {array.dtype.name} {array.shape}'
        raise MapError(msg)
    if array.dtype.kind == 'f' and not all(
        np.isfinite(some).all() for some in _blocks_of(file, array)
    ):
        msg = f'{file}: holds numbers that are not finite'
        raise MapError(msg)
    return array


def _blocks_of(file: Path, array: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """All numbers of a mapped array, read past its mapping: that would stay in memory."""
    with file.open('rb') as stream:
        stream.seek(file.stat().st_size - array.nbytes)
        for begin in range(0, array.size, _BLOCK):
            yield np.fromfile(stream, array.dtype, min(_BLOCK, array.size - begin))


def _checked_observations(
    path: Path, stored: StoredArrays, manifest: Manifest
) -> NDArray[np.int64]:
    """How many points each image sees."""
    file = path / FILE_OF_ARRAY['observation_gaps']
    gaps = np.concatenate([np.empty(0, np.uint8), *_blocks_of(file, stored.observation_gaps)])
    try:
        seen = replace(stored.observations, gaps=gaps).checked_sizes(len(stored.points))
    except ValueError as err:
        msg = f'{file}, or one of its offsets and first points: {err}'
        raise MapError(msg) from err
    if seen.sum() != manifest.counts['observations']:
        msg = f'{file}: {seen.sum()} observations, expected {manifest.counts["observations"]}'
        raise MapError(msg)
    return seen


def _check_covisibility(path: Path, stored: StoredArrays, seen: NDArray[np.int64]) -> None:
    offsets, images = stored.covisibility_offsets, stored.covisibility_images
    counts = stored.covisibility_counts
    try:
        check_offsets(offsets, len(images))
        if len(counts) != len(images):
            msg = f'{len(counts)} counts for {len(images)} pairs of images'
            raise ValueError(msg)
        rows = np.repeat(np.arange(len(seen)), np.diff(offsets))
        rises = np.diff(images) > 0
        if len(images) and (
            (images <= rows).any()
            or images.max() >= len(seen)
            or not (rises | (np.diff(rows) > 0)).all()
        ):
            msg = 'images are not rising, and not between that of their row and the last one'
            raise ValueError(msg)
        if (counts < 1).any() or (counts > np.minimum(seen[rows], seen[images])).any():
            msg = 'two images share more points than one of them sees, or none'
            raise ValueError(msg)
    except ValueError as err:
        msg = f'{path}: {", ".join(_COVISIBILITY_FILES)}: {err}'
        raise MapError(msg) from err


def _is_sfm(name: str) -> bool:
    return name.startswith(f'{SFM}/')


def sha256_of(file: Path) -> str:
    """Sum of a file's bytes, as `sha256sum` prints it."""
    digest = hashlib.sha256()
    with file.open('rb') as stream:
        while block := stream.read(_BLOCK):
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
