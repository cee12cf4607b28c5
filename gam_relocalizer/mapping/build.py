# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""From a folder of images to a map bundle."""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pycolmap

from gam_relocalizer import __version__
from gam_relocalizer.cameras import format_camera
from gam_relocalizer.errors import MapBuildError, MapError, PosesFileError, UsageError
from gam_relocalizer.features.registry import (
    DEFAULT_EXTRACTOR,
    DEFAULT_GLOBAL_DESCRIPTOR,
    DEFAULT_MAX_KEYPOINTS,
    create_extractor,
    load_global_descriptor,
)
from gam_relocalizer.features.vlad import Vlad
from gam_relocalizer.mapping.descriptors import describe_points
from gam_relocalizer.mapping.extraction import extract_images
from gam_relocalizer.mapping.intrinsics import assign_cameras
from gam_relocalizer.mapping.matching import mutual_nearest_neighbours
from gam_relocalizer.mapping.pairs import choose_pairs
from gam_relocalizer.mapping.progress import StepTimer, ignore_progress
from gam_relocalizer.mapping.report import BuildReport
from gam_relocalizer.mapping.sfm import (
    MIN_IMAGES,
    SfmInput,
    image_id_of,
    map_images,
    quiet_colmap,
    triangulate,
    verify_geometry,
    write_database,
)
from gam_relocalizer.scene_map import MANIFEST, Manifest, MapContent, MapFrame, save_map

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from gam_relocalizer.features.global_descriptor import GlobalDescriptor
    from gam_relocalizer.features.local import LocalExtractor
    from gam_relocalizer.image_set import ImageSet
    from gam_relocalizer.mapping.extraction import ExtractedImages, MappingImage
    from gam_relocalizer.mapping.progress import Progress

MAPPERS = ('incremental', 'global')
# Least cosine of two descriptors that may be the same point.
_MIN_SIMILARITY = {'xfeat': 0.82, 'sift': 0.80}
# Repeated windows and tiles lead whole images astray; a mild test costs one true match in six.
_MAX_RATIO = 0.95
_EXAMPLES = 3
# Wrong poses triangulate accidental pairs of rays; what exists is seen from three sides and more.
_MIN_MEAN_TRACK_LENGTH = 2.3


@dataclass(frozen=True)
class MapBuildOptions:
    """What a build can be told.

    Attributes:
        refine_camera: Refine the given cameras as well.
        extractor: Name of the local features.
        max_keypoints: Features per image.
        mapper: `incremental` or `global` structure from motion; unused with poses.
        global_descriptor: Name of what images are retrieved by.
        global_weights: Weights file of the global descriptor, when it needs one.
    """

    refine_camera: bool = False
    extractor: str = DEFAULT_EXTRACTOR
    max_keypoints: int = DEFAULT_MAX_KEYPOINTS
    mapper: str = 'incremental'
    global_descriptor: str = DEFAULT_GLOBAL_DESCRIPTOR
    global_weights: Path | None = None


@dataclass(frozen=True)
class _Model:
    """The outcome of structure from motion."""

    reconstruction: pycolmap.Reconstruction
    other_models: tuple[int, ...]
    pairs_matched: int
    pairs_verified: int


@dataclass(frozen=True)
class _Retrieval:
    """Global descriptors of the images, and what made them; a codebook if it was learned here."""

    describer: GlobalDescriptor
    global_descriptors: NDArray[np.float32]
    codebook: NDArray[np.float32]


def build_map(
    images: ImageSet,
    out: Path,
    options: MapBuildOptions | None = None,
    progress: Progress = ignore_progress,
) -> BuildReport:
    """Builds a map bundle; the same images and options give the same map.

    Args:
        images: What is to be mapped; with poses the map lies in their frame and scale.
        out: The bundle; an existing bundle is replaced once the new one is complete.
        options: See there.
        progress: Told of the steps extract, match, verify, sfm and save.

    Raises:
        UsageError: Unknown extractor, global descriptor or mapper, weights missing or not needed,
            or a camera that does not fit.
        WeightsError: Weights of the local or global descriptor are missing or damaged.
        PosesFileError: The poses name none of the images.
        MapError: `out` exists and is not a map bundle, or cannot be written.
        MapBuildError: The images do not make a map; the message says why and what to do.
    """
    options = options or MapBuildOptions()
    _check_output(out)
    if options.mapper not in MAPPERS:
        msg = f'unknown mapper `{options.mapper}`; known are {", ".join(MAPPERS)}'
        raise UsageError(msg)
    extractor = create_extractor(options.extractor, options.max_keypoints)
    describer = load_global_descriptor(options.global_descriptor, options.global_weights)
    _check_names(images.names)
    wanted = _with_pose(images.names, images.camera_from_world)
    timer = StepTimer()
    with timer.step('extract'):
        extracted = extract_images(images.folder, wanted, extractor, describer, progress)
    _check_usable(extracted, images.folder)
    cameras = assign_cameras(images, extracted.images)
    with timer.step('match'):
        retrieval = _describe_images(extracted.images, describer)
        matches = _match(extracted.images, retrieval, options, progress)
    constant = frozenset() if options.refine_camera else cameras.given
    sfm_input = SfmInput(extracted.images, cameras, constant, matches, images.camera_from_world)
    model = _reconstruct(sfm_input, options.mapper, timer, progress)
    with timer.step('describe'):
        content = _content(model.reconstruction, extracted.images, retrieval)
    report = _report(images.names, wanted, extracted, model, content, timer)
    progress('save', 0, 1)
    manifest = _manifest(images, extractor, retrieval.describer, options, report)
    save_map(out, content, manifest, model.reconstruction)
    progress('save', 1, 1)
    return report


def _check_output(out: Path) -> None:
    """Finds out before an hour of work, and not after it, that the result has no place."""
    if out.exists() and not (out / MANIFEST).is_file():
        msg = f'{out}: exists and is not a map bundle (no {MANIFEST}); choose another name'
        raise MapError(msg)
    ancestor = next(folder for folder in out.absolute().parents if folder.exists())
    if not ancestor.is_dir() or not os.access(ancestor, os.W_OK):
        msg = f'{out}: cannot be written, since {ancestor} is not a folder that may be written to'
        raise MapError(msg)


def _check_names(names: Sequence[str]) -> None:
    """Refuses names that a line of a poses file cannot hold."""
    for name in names:
        encodable = name.encode('utf-8', errors='ignore').decode() == name
        if not encodable or len(name.splitlines()) != 1 or name.lstrip().startswith('#'):
            msg = (
                f'image {name!r}: rename it; a name may not begin with #, nor hold a line break or '
                f'bytes that are not UTF-8'
            )
            raise UsageError(msg)


def _with_pose(given: Sequence[str], poses: Mapping[str, pycolmap.Rigid3d] | None) -> Sequence[str]:
    """The images to use: those that the poses name, when there are poses."""
    if poses is None:
        return given
    wanted = [name for name in given if name in poses]
    if not wanted:
        msg = (
            f'the poses name none of the images: poses are for {_examples(list(poses))}, images '
            f'are {_examples(given)}; names are relative to the folder of images'
        )
        raise PosesFileError(msg)
    return wanted


def _check_usable(extracted: ExtractedImages, folder: Path) -> None:
    usable = sum(len(image.features) > 0 for image in extracted.images)
    if usable < MIN_IMAGES:
        msg = (
            f'{folder}: {usable} images can be used, a map needs at least {MIN_IMAGES}: '
            f'{len(extracted.unreadable)} could not be read, '
            f'{len(extracted.images) - usable} show nothing that can be recognised'
        )
        raise MapBuildError(msg)


def _describe_images(
    images: Sequence[MappingImage], describer: GlobalDescriptor | None
) -> _Retrieval:
    if describer is None:
        vlad = Vlad.train(np.concatenate([image.features.descriptors for image in images]))
        described = [vlad.aggregate(image.features.descriptors) for image in images]
        return _Retrieval(vlad, np.stack(described), vlad.codebook)
    dimension = images[0].features.descriptors.shape[1]
    described = [one.global_descriptor for one in images if one.global_descriptor is not None]
    return _Retrieval(describer, np.stack(described), np.zeros((0, dimension), np.float32))


def _match(
    images: Sequence[MappingImage],
    retrieval: _Retrieval,
    options: MapBuildOptions,
    progress: Progress,
) -> dict[tuple[int, int], NDArray[np.int64]]:
    """Matches of the pairs worth comparing, by indices of their images."""
    pairs = choose_pairs(retrieval.global_descriptors)
    matches: dict[tuple[int, int], NDArray[np.int64]] = {}
    for done, (first, second) in enumerate(pairs, start=1):
        matches[first, second] = mutual_nearest_neighbours(
            images[first].features.descriptors,
            images[second].features.descriptors,
            _MIN_SIMILARITY[options.extractor],
            _MAX_RATIO,
        )
        progress('match', done, len(pairs))
    return matches


def _reconstruct(sfm_input: SfmInput, mapper: str, timer: StepTimer, progress: Progress) -> _Model:
    """Runs structure from motion in a temporary folder."""
    with tempfile.TemporaryDirectory(prefix='map_build_') as folder, quiet_colmap():
        work = Path(folder)
        database = work / 'database.db'
        progress('verify', 0, 1)
        with timer.step('verify'):
            write_database(database, sfm_input)
            verified = verify_geometry(database)
        progress('verify', 1, 1)
        progress('sfm', 0, len(sfm_input.images))
        with timer.step('sfm'):
            models = _models(database, work, sfm_input, mapper, progress)
        progress('sfm', len(sfm_input.images), len(sfm_input.images))
    largest = models[0] if models else pycolmap.Reconstruction()
    _check_model(largest, sfm_input, verified)
    return _Model(
        reconstruction=largest,
        other_models=tuple(model.num_reg_images() for model in models[1:]),
        pairs_matched=len(sfm_input.matches),
        pairs_verified=verified,
    )


def _models(
    database: Path,
    work: Path,
    sfm_input: SfmInput,
    mapper: str,
    progress: Progress,
) -> list[pycolmap.Reconstruction]:
    if sfm_input.camera_from_world is None:
        return map_images(database, work, sfm_input, mapper, progress)
    return [triangulate(database, work, sfm_input, sfm_input.camera_from_world)]


def _images_with_points(model: pycolmap.Reconstruction) -> int:
    return sum(image.has_pose and image.num_points3D > 0 for image in model.images.values())


def _check_model(model: pycolmap.Reconstruction, sfm_input: SfmInput, verified: int) -> None:
    """Refuses what is no map, with what to do about it.

    Raises:
        MapBuildError: Too few images found a place, or their points agree by chance alone.
    """
    placed = _images_with_points(model)
    if placed < MIN_IMAGES:
        found = f'{placed} images could be placed (needed: {MIN_IMAGES})'
    elif model.compute_mean_track_length() < _MIN_MEAN_TRACK_LENGTH:
        found = f'its points agree in {model.compute_mean_track_length():.1f} images, as by chance'
    else:
        return
    advice = (
        'take more images, overlapping by two thirds, from different positions, of surfaces with '
        'texture'
        if sfm_input.camera_from_world is None
        else 'check the camera, and that the poses are camera_from_world as COLMAP has it'
    )
    msg = (
        f'{len(sfm_input.images)} images do not make a map: of {len(sfm_input.matches)} image '
        f'pairs {verified} show the same thing, and {found}; {advice}'
    )
    raise MapBuildError(msg)


def _content(
    model: pycolmap.Reconstruction, images: Sequence[MappingImage], retrieval: _Retrieval
) -> MapContent:
    described = describe_points(model, images)
    rows = list(described.images)
    return MapContent(
        image_names=tuple(images[row].name for row in rows),
        camera_from_sfm=tuple(model.image(image_id_of(row)).cam_from_world() for row in rows),
        points=described.points,
        descriptors=described.descriptors,
        observation_offsets=described.observation_offsets,
        observation_points=described.observation_points,
        global_descriptors=retrieval.global_descriptors[rows],
        codebook=retrieval.codebook,
    )


def _report(
    given: Sequence[str],
    wanted: Sequence[str],
    extracted: ExtractedImages,
    model: _Model,
    content: MapContent,
    timer: StepTimer,
) -> BuildReport:
    reconstruction = model.reconstruction
    reconstruction.update_point_3d_errors()
    mapped = set(content.image_names)
    return BuildReport(
        images_given=len(given),
        images_registered=len(content.image_names),
        unregistered=tuple(image.name for image in extracted.images if image.name not in mapped),
        unreadable=dict(extracted.unreadable),
        without_pose=tuple(sorted(set(given).difference(wanted))),
        other_models=model.other_models,
        pairs_matched=model.pairs_matched,
        pairs_verified=model.pairs_verified,
        points=len(content.points),
        observations=len(content.observation_points),
        mean_track_length=len(content.observation_points) / len(content.points),
        mean_reprojection_error=reconstruction.compute_mean_reprojection_error(),
        cameras=tuple(
            format_camera(camera) for _, camera in sorted(reconstruction.cameras.items())
        ),
        seconds={step: round(seconds, 2) for step, seconds in timer.seconds.items()},
    )


def _manifest(
    images: ImageSet,
    extractor: LocalExtractor,
    describer: GlobalDescriptor,
    options: MapBuildOptions,
    report: BuildReport,
) -> Manifest:
    frame = MapFrame()
    if images.camera_from_world is not None:
        frame = MapFrame(metric=images.metric, source='the given camera poses')
    return Manifest(
        extractor=extractor.identity,
        retrieval=describer.name,
        retrieval_weights_sha256=describer.weights_sha256,
        frame=frame,
        counts={},
        build={
            'images': images.folder.absolute().name,
            'options': {
                'cameras': sorted({format_camera(one) for one in images.cameras.values()}),
                'poses': None
                if images.camera_from_world is None
                else len(images.camera_from_world),
                'refine_camera': options.refine_camera,
                'max_keypoints': options.max_keypoints,
                'mapper': options.mapper,
            },
            'software': {
                'gam_relocalizer': __version__,
                'pycolmap': pycolmap.__version__,
                'numpy': np.__version__,
            },
            'report': report.as_dict(),
        },
    )


def _examples(names: Sequence[str]) -> str:
    shown = ', '.join(f'`{name}`' for name in names[:_EXAMPLES])
    return shown if len(names) <= _EXAMPLES else f'{shown}, ... ({len(names)})'
