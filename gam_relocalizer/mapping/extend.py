# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Adds further images to a map, of another day or of a part that was left out.

What is there stays: the poses of the reference images, and with them the frame of the map.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.errors import MapBuildError, MapError
from gam_relocalizer.features.registry import (
    DEFAULT_MAX_KEYPOINTS,
    create_extractor,
    global_descriptor_of,
)
from gam_relocalizer.mapping.build import check_apart, check_names, check_output, save_bundle
from gam_relocalizer.mapping.extraction import extract_images
from gam_relocalizer.mapping.intrinsics import assign_cameras
from gam_relocalizer.mapping.mapped_images import (
    assemble,
    changed_manifest,
    check_no_name_twice,
    content_of,
    joined_cameras,
    read_mapped_images,
    with_prefix,
)
from gam_relocalizer.mapping.matching import match_pairs
from gam_relocalizer.mapping.pairs import choose_pairs, choose_pairs_between
from gam_relocalizer.mapping.progress import StepTimer, ignore_progress
from gam_relocalizer.mapping.report import calibration_warnings
from gam_relocalizer.mapping.sfm import (
    SfmInput,
    add_images,
    numbered_by_sight,
    quiet_colmap,
    verify_pairs,
    write_database,
    write_geometries,
)
from gam_relocalizer.scene_map import load_map

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.features.global_descriptor import GlobalDescriptor
    from gam_relocalizer.features.local import LocalExtractor
    from gam_relocalizer.image_set import ImageSet
    from gam_relocalizer.mapping.extraction import MappingImage
    from gam_relocalizer.mapping.intrinsics import ImageCameras
    from gam_relocalizer.mapping.mapped_images import MappedImages
    from gam_relocalizer.mapping.progress import Progress
    from gam_relocalizer.scene_map import SceneMap


@dataclass(frozen=True)
class ExtendReport:
    """What came of the further images.

    Attributes:
        images_given: Images in the folder.
        registered: Names of those that are in the map now, as they are there.
        unregistered: Names of readable images that found no place.
        unreadable: Name to reason of images that could not be read.
        pairs_matched: Image pairs that were compared.
        pairs_verified: Image pairs whose matches obey one geometry.
        points_before: Points of the map as it was.
        points: Points of the map as it is.
        observations: Their observations.
        mean_reprojection_error: Over all observations [px].
        seconds: Time per step.
        warnings: What to look at before the map is trusted.
    """

    images_given: int
    registered: tuple[str, ...]
    unregistered: tuple[str, ...]
    unreadable: Mapping[str, str]
    pairs_matched: int
    pairs_verified: int
    points_before: int
    points: int
    observations: int
    mean_reprojection_error: float
    seconds: Mapping[str, float]
    warnings: tuple[str, ...] = ()


def extend_map(
    path: Path,
    images: ImageSet,
    out: Path,
    *,
    prefix: str = '',
    global_weights: Path | None = None,
    progress: Progress = ignore_progress,
) -> ExtendReport:
    """Adds images to a map.

    Args:
        path: The map; it is not changed unless `out` is the same.
        images: What is to be added. Cameras that are not given are those of the map's images of
            the same size, where one took them all, and are guessed else. Poses are not used.
        out: The bundle to write.
        prefix: Put in front of the names of the images.
        global_weights: Weights of the map's global descriptor, when it needs any.
        progress: Told of the steps extract, match, verify, sfm and save.

    Raises:
        MapError: The map is damaged, lacks its COLMAP model, or was made by an extractor, weights
            or a global descriptor that are not here; or `out` exists and is no map.
        UsageError: An image is named like one of the map, or in a way that a map cannot hold.
        CameraError: A given camera does not fit.
        MapBuildError: No image finds a place in the map.
    """
    check_output(out)
    check_apart(out, images.folder)
    scene_map = load_map(path)
    names = [f'{prefix}{name}' for name in images.names]
    check_names(names)
    check_no_name_twice(path, scene_map.image_names, names)
    extractor = _extractor_of(scene_map)
    describer = _describer_of(scene_map, global_weights)
    mapped = read_mapped_images(path)
    timer = StepTimer()
    with timer.step('extract'):
        extracted = extract_images(images.folder, images.names, extractor, describer, progress)
    if not any(len(image.features) for image in extracted.images):
        msg = (
            f'{images.folder}: none of its {len(images.names)} images can be used: '
            f'{len(extracted.unreadable)} could not be read, the others show nothing that can be '
            f'recognised'
        )
        raise MapBuildError(msg)
    cameras = assign_cameras(_with_cameras_of(mapped, images, extracted.images), extracted.images)
    joined = _Joined(mapped, with_prefix(extracted.images, prefix), cameras)
    described = np.stack([_described(image) for image in extracted.images])
    with timer.step('match'):
        pairs = _pairs(described, scene_map)
        matches = match_pairs(joined.images, pairs, extractor.identity.name, progress)
    model, verified = _grown(joined, matches, timer, progress)
    registered, unregistered = _by_place(joined.added, model)
    if not registered:
        msg = (
            f'{path}: none of the {len(joined.added)} images of {images.folder} finds a place in '
            f'it: of {len(pairs)} image pairs {verified} show the same thing; expected images that '
            f'overlap with those of the map'
        )
        raise MapBuildError(msg)
    progress('save', 0, 1)
    content = content_of(
        model,
        joined.images,
        np.concatenate([mapped.content.global_descriptors, described]),
        mapped.content.codebook,
    )
    warnings = calibration_warnings(joined.cameras, dict(model.cameras.items()))
    change = {
        'what': 'extend',
        'images': images.source,
        'prefix': prefix,
        'images_given': len(images.names),
        'images_registered': len(registered),
        'warnings': list(warnings),
    }
    save_bundle(out, content, changed_manifest(mapped.manifest, change, model), model)
    progress('save', 1, 1)
    return ExtendReport(
        images_given=len(images.names),
        registered=registered,
        unregistered=unregistered,
        unreadable=dict(extracted.unreadable),
        pairs_matched=len(pairs),
        pairs_verified=verified,
        points_before=len(mapped.points),
        points=len(content.points),
        observations=len(content.observation_points),
        mean_reprojection_error=model.compute_mean_reprojection_error(),
        seconds={step: round(seconds, 2) for step, seconds in timer.seconds.items()},
        warnings=warnings,
    )


@dataclass(frozen=True)
class _Joined:
    """The images of a map, and those to be added."""

    mapped: MappedImages
    added: tuple[MappingImage, ...]
    added_cameras: ImageCameras

    @property
    def images(self) -> tuple[MappingImage, ...]:
        return (*self.mapped.images, *self.added)

    @property
    def cameras(self) -> ImageCameras:
        return joined_cameras(self.mapped.cameras, self.added_cameras)


def _extractor_of(scene_map: SceneMap) -> LocalExtractor:
    """What made the map, with as many features of an image as then if that is known.

    Raises:
        MapError: The extractor here is another one.
    """
    manifest = scene_map.manifest
    options = manifest.build.get('options')
    wanted = options.get('max_keypoints') if isinstance(options, dict) else None
    extractor = create_extractor(
        manifest.extractor.name, wanted if isinstance(wanted, int) else DEFAULT_MAX_KEYPOINTS
    )
    if extractor.identity != manifest.extractor:
        msg = (
            f'{scene_map.path}: made with {manifest.extractor}, here is {extractor.identity}; '
            f'descriptors of different extractors cannot be compared: build the map again'
        )
        raise MapError(msg)
    return extractor


def _describer_of(scene_map: SceneMap, weights: Path | None) -> GlobalDescriptor:
    """What described the map's images.

    Raises:
        MapError: The weights given are others.
    """
    describer = global_descriptor_of(scene_map, weights)
    if describer.weights_sha256 != scene_map.manifest.retrieval_weights_sha256:
        msg = (
            f'{weights}: sha256 {describer.weights_sha256}, {scene_map.path} was made with the '
            f'weights of sha256 {scene_map.manifest.retrieval_weights_sha256}; give those'
        )
        raise MapError(msg)
    return describer


def _with_cameras_of(
    mapped: MappedImages, images: ImageSet, extracted: Sequence[MappingImage]
) -> ImageSet:
    """The images with the camera of the map's images of their size, where none is given."""
    by_size: dict[tuple[int, int], list[pycolmap.Camera]] = {}
    for camera in mapped.cameras.cameras:
        by_size.setdefault((camera.width, camera.height), []).append(camera)
    known = {
        image.name: by_size[image.width, image.height][0]
        for image in extracted
        if len(by_size.get((image.width, image.height), [])) == 1
    }
    return replace(images, cameras={**known, **images.cameras})


def _described(image: MappingImage) -> NDArray[np.float32]:
    if image.global_descriptor is None:  # extraction was given what describes
        msg = f'{image.name}: has no global descriptor'
        raise TypeError(msg)
    return image.global_descriptor


def _pairs(described: NDArray[np.float32], scene_map: SceneMap) -> list[tuple[int, int]]:
    """Which images to match: the added ones, which follow, with the map's and with each other."""
    offset = scene_map.num_images
    likeness = np.stack([scene_map.likeness(one) for one in described])
    across = [(old, offset + new) for new, old in choose_pairs_between(likeness)]
    among = [(offset + first, offset + second) for first, second in choose_pairs(described)]
    return sorted(across + among)


def _grown(
    joined: _Joined,
    matches: Mapping[tuple[int, int], NDArray[np.int64]],
    timer: StepTimer,
    progress: Progress,
) -> tuple[pycolmap.Reconstruction, int]:
    """The model with those images that find a place, and the number of verified pairs."""
    mapped, cameras = joined.mapped, joined.cameras
    constant = mapped.cameras.given | cameras.given
    sfm_input = SfmInput(joined.images, cameras, constant, matches)
    start = assemble(
        mapped.cameras,
        mapped.images,
        mapped.camera_from_sfm,
        mapped.points,
        mapped.point_of_keypoint,
    )
    progress('verify', 0, 1)
    with timer.step('verify'):
        geometries = verify_pairs(joined.images, cameras, matches)
    progress('verify', 1, 1)
    progress('sfm', 0, len(joined.added))
    with (
        timer.step('sfm'),
        tempfile.TemporaryDirectory(prefix='map_extend_') as folder,
        quiet_colmap(),
    ):
        work = Path(folder)
        write_database(work / 'database.db', sfm_input)
        write_geometries(work / 'database.db', geometries)
        model = add_images(work / 'database.db', work, sfm_input, start, progress)
    progress('sfm', len(joined.added), len(joined.added))
    verified = sum(len(geometry.inlier_matches) > 0 for geometry in geometries.values())
    return numbered_by_sight(model), verified


def _by_place(
    images: Sequence[MappingImage], model: pycolmap.Reconstruction
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the images that are in a model and see points, and of the others."""
    placed = {one.name for one in model.images.values() if one.has_pose and one.num_points3D}
    names = [image.name for image in images]
    return (
        tuple(name for name in names if name in placed),
        tuple(name for name in names if name not in placed),
    )
