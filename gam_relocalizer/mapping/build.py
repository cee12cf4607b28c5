# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""From a folder of images to a map bundle."""

from __future__ import annotations

import os
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import PurePosixPath
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
from gam_relocalizer.mapping.extraction import Extraction
from gam_relocalizer.mapping.intrinsics import assign_cameras
from gam_relocalizer.mapping.pairs import choose_pairs
from gam_relocalizer.mapping.progress import ignore_progress
from gam_relocalizer.mapping.report import BuildReport, calibration_warnings
from gam_relocalizer.mapping.sfm import MIN_IMAGES, SfmInput, image_id_of, quiet_colmap
from gam_relocalizer.mapping.steps import Matched, Steps
from gam_relocalizer.mapping.workspace import temporary_workspace
from gam_relocalizer.scene_map import (
    DESCRIPTOR_BITS,
    MANIFEST,
    Manifest,
    MapContent,
    MapFrame,
    save_map,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from gam_relocalizer.features.global_descriptor import GlobalDescriptor
    from gam_relocalizer.features.local import LocalExtractor
    from gam_relocalizer.image_set import ImageSet
    from gam_relocalizer.mapping.extraction import ExtractionResult, StoredImages
    from gam_relocalizer.mapping.progress import Progress
    from gam_relocalizer.mapping.steps import Model, Retrieval
    from gam_relocalizer.mapping.workspace import Workspace

MAPPERS = ('incremental', 'global')
_EXAMPLES = 3
# Poses within some hundred metres of their origin keep it: single precision holds 0.03 mm there.
_ROUND_PLACE = 1000.0


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
        descriptor_bits: That the map keeps of each number of a local descriptor: 16 or 8.
    """

    refine_camera: bool = False
    extractor: str = DEFAULT_EXTRACTOR
    max_keypoints: int = DEFAULT_MAX_KEYPOINTS
    mapper: str = 'incremental'
    global_descriptor: str = DEFAULT_GLOBAL_DESCRIPTOR
    global_weights: Path | None = None
    descriptor_bits: int = 16


def build_map(
    images: ImageSet,
    out: Path,
    options: MapBuildOptions | None = None,
    progress: Progress = ignore_progress,
    workspace: Workspace | None = None,
) -> BuildReport:
    """Builds a map bundle; the same images and options give the same map.

    The folder of images is only read.

    Args:
        images: What is to be mapped; with poses the map lies in their frame and scale.
        out: The bundle; an existing bundle is replaced once the new one is complete.
        options: See there.
        progress: Told of the steps extract, match, verify, sfm and save.
        workspace: Where steps find their results of an earlier build, and leave them for a later
            one; without one nothing is left behind. It changes nothing about the map.

    Raises:
        UsageError: Unknown extractor, global descriptor or mapper, weights missing or not needed,
            an impossible number of bits, or a camera that does not fit.
        WeightsError: Weights of the local or global descriptor are missing or damaged.
        PosesFileError: The poses name none of the images.
        MapError: `out` exists and is not a map bundle, or cannot be written.
        MapBuildError: The images do not make a map, or the workspace cannot be written to; the
            message says why and what to do.
    """
    options = options or MapBuildOptions()
    check_output(out)
    check_apart(out, images.folder)
    _check_options(options)
    extractor = create_extractor(options.extractor, options.max_keypoints)
    describer = load_global_descriptor(options.global_descriptor, options.global_weights)
    check_names(images.names)
    wanted = _with_pose(images.names, images.camera_from_world)
    where = nullcontext(workspace) if workspace is not None else temporary_workspace()
    with where as used, quiet_colmap():
        steps = Steps(used, progress)
        extraction = Extraction(extractor, options.max_keypoints, describer)
        extracted = steps.extract(images.folder, wanted, extraction)
        _check_usable(extracted, images.source)
        cameras = assign_cameras(images, extracted.images)
        retrieval = steps.describe(extracted.images, learn_words=describer is None)
        matched = Matched(
            extracted.images, choose_pairs(retrieval.global_descriptors), options.extractor
        )
        frame = _frame(images, wanted)
        sfm_input = SfmInput(
            images=extracted.images,
            cameras=cameras,
            constant_cameras=frozenset() if options.refine_camera else cameras.given,
            matches={},
            camera_from_sfm=_camera_from_sfm(images, frame),
        )
        model = steps.reconstruct(matched, sfm_input, options.mapper)
        with steps.timer.step('describe'):
            content = _content(model.reconstruction, extracted.images, retrieval)
        report = replace(
            _report(images.names, wanted, extracted, matched, model, content, steps),
            warnings=calibration_warnings(cameras, dict(model.reconstruction.cameras.items())),
        )
        progress('save', 0, 1)
        identity = describer or Vlad(retrieval.codebook)
        manifest = _manifest(images, frame, extractor, identity, options, report)
        save_bundle(out, content, manifest, model.reconstruction)
        steps.forget_others()
    progress('save', 1, 1)
    return report


def _check_options(options: MapBuildOptions) -> None:
    if options.mapper not in MAPPERS:
        msg = f'unknown mapper `{options.mapper}`; known are {", ".join(MAPPERS)}'
        raise UsageError(msg)
    check_descriptor_bits(options.descriptor_bits)


def check_descriptor_bits(bits: int) -> None:
    """Refuses a number of bits that a map cannot keep of a number of its descriptors.

    Raises:
        UsageError: See above.
    """
    if bits not in DESCRIPTOR_BITS:
        known = ' or '.join(map(str, DESCRIPTOR_BITS))
        msg = f'descriptors of {bits} bits: must be {known}'
        raise UsageError(msg)


def check_output(out: Path) -> None:
    """Finds out before an hour of work, and not after it, that the result has no place."""
    if out.exists() and not (out / MANIFEST).is_file():
        msg = f'{out}: exists and is not a map bundle (no {MANIFEST}); choose another name'
        raise MapError(msg)
    ancestor = next(folder for folder in out.absolute().parents if folder.exists())
    if not ancestor.is_dir() or not os.access(ancestor, os.W_OK):
        msg = f'{out}: cannot be written, since {ancestor} is not a folder that may be written to'
        raise MapError(msg)


def check_apart(out: Path, images: Path) -> None:
    """Refuses to write a map among images: its pictures would be taken for some of them.

    Raises:
        UsageError: The map is to lie in the folder of images.
    """
    if out.resolve().is_relative_to(images.resolve()):
        msg = (
            f'{out}: lies in the folder of images, {images}, where the pictures that a build '
            f'leaves would be taken for images; choose a place outside of it'
        )
        raise UsageError(msg)


def check_names(names: Sequence[str]) -> None:
    """Refuses names that a line of a poses file cannot hold, or that lead out of their folder.

    Raises:
        UsageError: The first such name.
    """
    for name in names:
        encodable = name.encode('utf-8', errors='ignore').decode() == name
        if not encodable or len(name.splitlines()) != 1 or name.lstrip().startswith('#'):
            msg = (
                f'image {name!r}: rename it; a name may not begin with #, nor hold a line break or '
                f'bytes that are not UTF-8'
            )
            raise UsageError(msg)
        if PurePosixPath(name).is_absolute() or '..' in PurePosixPath(name).parts:
            msg = f'image {name!r}: the name leads out of the folder of images; it may hold no `..`'
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


def _check_usable(extracted: ExtractionResult, source: str) -> None:
    usable = extracted.num_usable
    if usable < MIN_IMAGES:
        msg = (
            f'{source}: {usable} of its images can be used, a map needs at least {MIN_IMAGES}: '
            f'{len(extracted.unreadable)} could not be read, '
            f'{len(extracted.images) - usable} show nothing that can be recognised'
        )
        raise MapBuildError(msg)


def _frame(images: ImageSet, mapped: Sequence[str]) -> MapFrame:
    """The frame of the given poses, seen from a round place near the cameras.

    A map stores points in single precision: of coordinates in the millions (UTM) it would keep
    decimetres.
    """
    poses = images.camera_from_world
    if poses is None:
        return MapFrame()
    centre = np.mean([poses[name].tgt_origin_in_src() for name in mapped], axis=0)
    x, y, z = (_ROUND_PLACE * round(float(value) / _ROUND_PLACE) for value in centre)
    return MapFrame(translation=(x, y, z), metric=images.metric, source='the given camera poses')


def _camera_from_sfm(images: ImageSet, frame: MapFrame) -> dict[str, pycolmap.Rigid3d] | None:
    if images.camera_from_world is None:
        return None
    world_from_sfm = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array(frame.translation))
    return {name: pose * world_from_sfm for name, pose in images.camera_from_world.items()}


def _content(
    model: pycolmap.Reconstruction, images: StoredImages, retrieval: Retrieval
) -> MapContent:
    described = describe_points(model, images)
    rows = list(described.images)
    return MapContent(
        image_names=tuple(images.names[row] for row in rows),
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
    extracted: ExtractionResult,
    matched: Matched,
    model: Model,
    content: MapContent,
    steps: Steps,
) -> BuildReport:
    reconstruction = model.reconstruction
    reconstruction.update_point_3d_errors()
    mapped = set(content.image_names)
    return BuildReport(
        images_given=len(given),
        images_registered=len(content.image_names),
        unregistered=tuple(name for name in extracted.images.names if name not in mapped),
        unreadable=dict(extracted.unreadable),
        without_pose=tuple(sorted(set(given).difference(wanted))),
        other_models=model.other_models,
        pairs_matched=len(matched.pairs),
        pairs_verified=model.pairs_verified,
        points=len(content.points),
        observations=len(content.observation_points),
        mean_track_length=len(content.observation_points) / len(content.points),
        mean_reprojection_error=reconstruction.compute_mean_reprojection_error(),
        cameras=tuple(
            format_camera(camera) for _, camera in sorted(reconstruction.cameras.items())
        ),
        seconds={step: round(seconds, 2) for step, seconds in steps.timer.seconds.items()},
        reused=dict(steps.reused),
    )


def save_bundle(
    out: Path, content: MapContent, manifest: Manifest, model: pycolmap.Reconstruction
) -> None:
    """Writes a map whose making took long.

    Raises:
        MapError: The disk is full, or the folder cannot be written to.
    """
    try:
        save_map(out, content, manifest, model)
    except OSError as err:
        msg = f'{out}: cannot be written: {err.strerror or err}; make room and start again'
        raise MapError(msg) from err


def _manifest(
    images: ImageSet,
    frame: MapFrame,
    extractor: LocalExtractor,
    describer: GlobalDescriptor,
    options: MapBuildOptions,
    report: BuildReport,
) -> Manifest:
    return Manifest(
        extractor=extractor.identity,
        retrieval=describer.name,
        retrieval_weights_sha256=describer.weights_sha256,
        descriptor_bits=options.descriptor_bits,
        frame=frame,
        counts={},
        build={
            'images': images.source,
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
