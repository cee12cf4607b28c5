# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The steps of a map build that take long; what a workspace holds already is not done again.

Matches and geometries are stored for all pairs with the same first image together, each under the
name of the second: a further image adds pairs to what is there.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import groupby
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np
import pycolmap
import scipy
import torch
from numpy.typing import NDArray

from gam_relocalizer import __version__
from gam_relocalizer.cameras import format_camera
from gam_relocalizer.errors import MapBuildError
from gam_relocalizer.features.vlad import Vlad
from gam_relocalizer.mapping.extraction import FEATURES, extract_to
from gam_relocalizer.mapping.matching import match_pairs
from gam_relocalizer.mapping.progress import StepTimer, ignore_progress
from gam_relocalizer.mapping.sfm import (
    MIN_IMAGES,
    map_images,
    numbered_by_sight,
    triangulate,
    verify_pairs,
    write_database,
    write_geometries,
)
from gam_relocalizer.mapping.workspace import key_of
from gam_relocalizer.scene_map import write_model

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from gam_relocalizer.mapping.extraction import Extraction, ExtractionResult, StoredImages
    from gam_relocalizer.mapping.intrinsics import ImageCameras
    from gam_relocalizer.mapping.progress import Progress
    from gam_relocalizer.mapping.sfm import SfmInput
    from gam_relocalizer.mapping.workspace import Workspace

RETRIEVAL, MATCHES, GEOMETRIES, MODELS = 'retrieval', 'matches', 'geometries', 'models'
_FACTS = 'facts.json'
# 50 MB of them; the words of VLAD are learned from fewer still.
_MAX_DESCRIPTORS_IN_MEMORY = 200_000
# Wrong poses triangulate accidental pairs of rays; what exists is seen from three sides and more.
_MIN_MEAN_TRACK_LENGTH = 2.3


@dataclass(frozen=True)
class Retrieval:
    """What images are retrieved by.

    Attributes:
        global_descriptors: [I,G] float32.
        codebook: [W,D] float32, the words of VLAD; W = 0 when images were described as they were
            extracted.
    """

    global_descriptors: NDArray[np.float32]
    codebook: NDArray[np.float32]


@dataclass(frozen=True)
class Model:
    """The outcome of structure from motion.

    Attributes:
        reconstruction: The largest model, its points numbered by sight.
        other_models: Numbers of images of the models that were dropped.
        pairs_verified: Number of image pairs that show the same thing.
    """

    reconstruction: pycolmap.Reconstruction
    other_models: tuple[int, ...]
    pairs_verified: int


@dataclass(frozen=True)
class Matched:
    """Images and which of them are to be compared.

    Attributes:
        images: To be mapped.
        pairs: Their indices, sorted, the smaller one first.
        extractor: Name of what described the keypoints.
    """

    images: StoredImages
    pairs: Sequence[tuple[int, int]]
    extractor: str

    def by_first(self) -> Iterator[tuple[int, list[int]]]:
        """First images, each with all its second ones."""
        for first, group in groupby(self.pairs, key=itemgetter(0)):
            yield first, [second for _, second in group]

    def key(self, first: int) -> str:
        """Of the matches of all pairs with that first image."""
        return key_of(
            image=self.images.keys[first],
            extractor=self.extractor,
            software=[__version__, torch.__version__],
        )


@dataclass(frozen=True)
class Verified:
    """Matched images and the cameras that took them."""

    matched: Matched
    cameras: ImageCameras

    def name(self, index: int) -> str:
        """Of an image as its camera took it."""
        camera = self.cameras.of(index)
        return key_of(
            image=self.matched.images.keys[index],
            camera=[format_camera(camera), camera.has_prior_focal_length],
        )

    def key(self, first: int) -> str:
        """Of the geometries of all pairs with that first image."""
        return key_of(
            image=self.name(first),
            matches=self.matched.key(first),
            software=[__version__, pycolmap.__version__],
        )


class _StoredMatches(Mapping[tuple[int, int], NDArray[np.integer]]):
    """Matches of pairs of images in a workspace, of which few are in memory at a time."""

    def __init__(self, workspace: Workspace, matched: Matched) -> None:
        self._workspace = workspace
        self._matched = matched
        self._of_first = lru_cache(1)(self._load)

    def __getitem__(self, pair: tuple[int, int]) -> NDArray[np.integer]:
        first, second = pair
        return self._of_first(first)[self._matched.images.keys[second]]

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return iter(self._matched.pairs)

    def __len__(self) -> int:
        return len(self._matched.pairs)

    def _load(self, first: int) -> dict[str, NDArray[Any]]:
        stored = self._workspace.load(MATCHES, self._matched.key(first))
        if stored is None:
            msg = (
                f'{self._workspace.path}: the matches of {self._matched.images.names[first]} were '
                f'removed or damaged while the map was built; start again'
            )
            raise MapBuildError(msg)
        return stored


@dataclass
class Steps:
    """Does the steps of one build.

    Attributes:
        workspace: Where results are.
        progress: Told of every advance.
        timer: Times the steps.
        reused: Step to the number of images, pairs or models that the workspace held already.
        needed: Folder of the workspace to the keys that this build has to do with.
    """

    workspace: Workspace
    progress: Progress
    timer: StepTimer = field(default_factory=StepTimer)
    reused: dict[str, int] = field(default_factory=dict)
    needed: dict[str, set[str]] = field(default_factory=dict)

    def extract(self, folder: Path, names: Sequence[str], how: Extraction) -> ExtractionResult:
        """Local features of images; one that cannot be read is noted and left out."""
        with self.timer.step('extract'):
            result = extract_to(self.workspace, folder, names, how, self.progress)
        self.reused['extract'] = result.num_reused
        self.needed[FEATURES] = set(result.images.keys)
        return result

    def describe(self, images: StoredImages, *, learn_words: bool) -> Retrieval:
        """Images as a whole, by VLAD with words learned from them, or as they were extracted."""
        key = key_of(
            images=images.keys,
            learn_words=learn_words,
            software=[__version__, np.__version__, scipy.__version__],
        )
        self.needed[RETRIEVAL] = {key}
        with self.timer.step('match'):
            arrays = self.workspace.load(RETRIEVAL, key)
            if arrays is None:
                described = _by_words(images) if learn_words else _as_extracted(images)
                arrays = vars(described)
                self.workspace.save(RETRIEVAL, key, arrays)
        return Retrieval(**arrays)

    def reconstruct(self, matched: Matched, sfm_input: SfmInput, mapper: str) -> Model:
        """Matches and verifies pairs of images, and recovers poses and points.

        Raises:
            MapBuildError: The images do not make a map.
        """
        verified = Verified(matched, sfm_input.cameras)
        key = _model_key(verified, sfm_input, mapper)
        firsts = [first for first, _ in matched.by_first()]
        self.needed[MATCHES] = {matched.key(first) for first in firsts}
        self.needed[GEOMETRIES] = {verified.key(first) for first in firsts}
        self.needed[MODELS] = {key}
        if self.workspace.finished(MODELS, key) is None:
            self._match(matched)
            geometries = self._verify(verified)
            matches = _StoredMatches(self.workspace, matched)
            self._map(key, geometries, replace(sfm_input, matches=matches), mapper)
            self.reused['sfm'] = 0
        else:
            self._skip('match', len(matched.pairs))
            self._skip('verify', len(matched.pairs))
            self._skip('sfm', len(matched.images))
        return _read_model(self.workspace.path / MODELS / key)

    def forget_others(self) -> None:
        """Removes results that only builds with other images or options had use for."""
        for folder, keys in self.needed.items():
            self.workspace.keep_only(folder, keys)

    def _match(self, matched: Matched) -> None:
        done = reused = 0
        images = matched.images
        with self.timer.step('match'):
            for first, seconds in matched.by_first():
                key = matched.key(first)
                stored = self.workspace.load(MATCHES, key) or {}
                missing = [second for second in seconds if images.keys[second] not in stored]
                if missing:
                    pairs = [(first, second) for second in missing]
                    found = match_pairs(images, pairs, matched.extractor, ignore_progress)
                    for (_, second), matches in found.items():
                        stored[images.keys[second]] = matches.astype(np.uint32)
                    self.workspace.save(MATCHES, key, stored)
                done += len(seconds)
                reused += len(seconds) - len(missing)
                self.progress('match', done, len(matched.pairs))
        self.reused['match'] = reused

    def _verify(self, verified: Verified) -> dict[tuple[int, int], pycolmap.TwoViewGeometry]:
        matched, geometries, reused = verified.matched, {}, 0
        all_matches = _StoredMatches(self.workspace, matched)
        with self.timer.step('verify'):
            for first, seconds in matched.by_first():
                key = verified.key(first)
                stored = self.workspace.load(GEOMETRIES, key) or {}
                missing = [
                    second for second in seconds if _numbers(verified.name(second)) not in stored
                ]
                if missing:
                    matches = {(first, second): all_matches[first, second] for second in missing}
                    found = verify_pairs(matched.images, verified.cameras, matches)
                    for (_, second), geometry in found.items():
                        stored |= _packed(verified.name(second), geometry)
                    self.workspace.save(GEOMETRIES, key, stored)
                for second in seconds:
                    geometries[first, second] = _unpacked(verified.name(second), stored)
                reused += len(seconds) - len(missing)
                self.progress('verify', len(geometries), len(matched.pairs))
        self.reused['verify'] = reused
        return geometries

    def _map(
        self,
        key: str,
        geometries: dict[tuple[int, int], pycolmap.TwoViewGeometry],
        sfm_input: SfmInput,
        mapper: str,
    ) -> None:
        pairs_verified = sum(len(one.inlier_matches) > 0 for one in geometries.values())
        self.progress('sfm', 0, len(sfm_input.images))
        with self.timer.step('sfm'):
            with self.workspace.scratch() as scratch:
                database = scratch / 'database.db'
                try:
                    write_database(database, sfm_input)
                    write_geometries(database, geometries)
                    models = _models(database, scratch, sfm_input, mapper, self.progress)
                except RuntimeError as err:  # all that COLMAP says of a database it cannot write
                    msg = (
                        f'{self.workspace.path}: structure from motion cannot keep its database '
                        f'there: {err}; make room on the disk and start again: what is finished '
                        f'stays'
                    )
                    raise MapBuildError(msg) from err
            largest = models[0] if models else pycolmap.Reconstruction()
            _check_model(largest, sfm_input, len(geometries), pairs_verified)
            facts = {
                'other_models': [model.num_reg_images() for model in models[1:]],
                'pairs_verified': pairs_verified,
            }
            with self.workspace.writing(MODELS, key) as folder:
                write_model(numbered_by_sight(largest), folder)
                (folder / _FACTS).write_text(json.dumps(facts), encoding='utf-8')
        self.progress('sfm', len(sfm_input.images), len(sfm_input.images))

    def _skip(self, step: str, count: int) -> None:
        with self.timer.step(step):
            self.progress(step, count, count)
        self.reused[step] = count


def _by_words(images: StoredImages) -> Retrieval:
    share = -(-_MAX_DESCRIPTORS_IN_MEMORY // len(images))
    rng = np.random.default_rng(0)
    trained = Vlad.train(
        np.concatenate([_some_rows(one.features.descriptors, share, rng) for one in images])
    )
    # as a map keeps its words: queries are described by these
    vlad = Vlad(trained.codebook.astype(np.float16).astype(np.float32))
    described = [vlad.aggregate(one.features.descriptors) for one in images]
    return Retrieval(np.stack(described), vlad.codebook)


def _some_rows(
    descriptors: NDArray[np.float32], count: int, rng: np.random.Generator
) -> NDArray[np.float32]:
    if len(descriptors) <= count:
        return descriptors
    return descriptors[np.sort(rng.choice(len(descriptors), count, replace=False))]


def _as_extracted(images: StoredImages) -> Retrieval:
    described = [one.global_descriptor for one in images if one.global_descriptor is not None]
    dimension = images[0].features.descriptors.shape[1]
    return Retrieval(np.stack(described), np.zeros((0, dimension), np.float32))


def _model_key(verified: Verified, sfm_input: SfmInput, mapper: str) -> str:
    matched, poses = verified.matched, sfm_input.camera_from_sfm
    return key_of(
        names=matched.images.names,
        images=[verified.name(index) for index in range(len(matched.images))],
        camera_of_image=verified.cameras.of_image,
        constant_cameras=sorted(sfm_input.constant_cameras),
        pairs=matched.pairs,
        extractor=matched.extractor,
        mapper=None if poses is not None else mapper,
        poses=None
        if poses is None
        else [poses[name].matrix().tolist() for name in matched.images.names],
        software=[__version__, np.__version__, torch.__version__, pycolmap.__version__],
    )


def _models(
    database: Path, scratch: Path, sfm_input: SfmInput, mapper: str, progress: Progress
) -> list[pycolmap.Reconstruction]:
    if sfm_input.camera_from_sfm is None:
        return map_images(database, scratch, sfm_input, mapper, progress)
    return [triangulate(database, scratch, sfm_input, sfm_input.camera_from_sfm)]


def _check_model(
    model: pycolmap.Reconstruction, sfm_input: SfmInput, pairs: int, pairs_verified: int
) -> None:
    """Refuses what is no map, with what to do about it.

    Raises:
        MapBuildError: Too few images found a place, or their points agree by chance alone.
    """
    placed = sum(image.has_pose and image.num_points3D > 0 for image in model.images.values())
    if placed < MIN_IMAGES:
        found = f'{placed} images could be placed (needed: {MIN_IMAGES})'
    elif model.compute_mean_track_length() < _MIN_MEAN_TRACK_LENGTH:
        found = f'its points agree in {model.compute_mean_track_length():.1f} images, as by chance'
    else:
        return
    advice = (
        'take more images, overlapping by two thirds, from different positions, of surfaces with '
        'texture'
        if sfm_input.camera_from_sfm is None
        else 'check the camera, and that the poses are camera_from_world as COLMAP has it'
    )
    msg = (
        f'{len(sfm_input.images)} images do not make a map: of {pairs} image pairs '
        f'{pairs_verified} show the same thing, and {found}; {advice}'
    )
    raise MapBuildError(msg)


def _read_model(folder: Path) -> Model:
    facts = json.loads((folder / _FACTS).read_text(encoding='utf-8'))
    return Model(
        reconstruction=pycolmap.Reconstruction(folder),
        other_models=tuple(facts['other_models']),
        pairs_verified=facts['pairs_verified'],
    )


def _numbers(name: str) -> str:
    return f'{name}.numbers'


def _matches(name: str) -> str:
    return f'{name}.matches'


def _packed(name: str, geometry: pycolmap.TwoViewGeometry) -> dict[str, NDArray[Any]]:
    """A geometry as two arrays; NaN stands for what it lacks."""
    pose = geometry.cam2_from_cam1
    parts = [
        np.array([int(geometry.config), geometry.tri_angle]),
        *(np.full(9, np.nan) if one is None else np.ravel(one) for one in _matrices_of(geometry)),
        np.full(7, np.nan) if pose is None else np.r_[pose.rotation.quat, pose.translation],
    ]
    return {_numbers(name): np.concatenate(parts), _matches(name): geometry.inlier_matches}


def _matrices_of(geometry: pycolmap.TwoViewGeometry) -> tuple[NDArray[np.float64] | None, ...]:
    return geometry.E, geometry.F, geometry.H


def _unpacked(name: str, stored: dict[str, NDArray[Any]]) -> pycolmap.TwoViewGeometry:
    numbers = stored[_numbers(name)]
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = pycolmap.TwoViewGeometryConfiguration(int(numbers[0]))
    geometry.tri_angle = numbers[1]
    essential, fundamental, homography = (
        None if np.isnan(one).any() else one.reshape(3, 3) for one in np.split(numbers[2:29], 3)
    )
    geometry.E, geometry.F, geometry.H = essential, fundamental, homography
    if not np.isnan(numbers[29:]).any():
        geometry.cam2_from_cam1 = pycolmap.Rigid3d(
            pycolmap.Rotation3d(numbers[29:33]), numbers[33:]
        )
    geometry.inlier_matches = stored[_matches(name)].astype(np.uint32).reshape(-1, 2)
    return geometry
