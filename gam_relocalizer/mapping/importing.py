# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Maps from what others made: datasets with true poses, COLMAP models, hloc outputs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import pycolmap

from gam_relocalizer import __version__
from gam_relocalizer.cameras import format_camera
from gam_relocalizer.datasets.layout import Split, layout_of
from gam_relocalizer.datasets.reading import read_dataset
from gam_relocalizer.datasets.spacing import DEFAULT_ANGLE_DEG, spaced
from gam_relocalizer.errors import ModelError
from gam_relocalizer.features.registry import create_extractor
from gam_relocalizer.features.vlad import Vlad
from gam_relocalizer.image_set import ImageSet
from gam_relocalizer.mapping.build import (
    MapBuildOptions,
    build_map,
    check_descriptor_bits,
    check_names,
    check_output,
    save_bundle,
)
from gam_relocalizer.mapping.colmap_model import NO_POINT, read_colmap_model
from gam_relocalizer.mapping.extraction import MappingImage
from gam_relocalizer.mapping.intrinsics import assign_cameras
from gam_relocalizer.mapping.mapped_images import assemble, content_of
from gam_relocalizer.mapping.progress import StepTimer, ignore_progress
from gam_relocalizer.mapping.report import BuildReport
from gam_relocalizer.mapping.sfm import MIN_IMAGES, numbered_by_sight, quiet_colmap
from gam_relocalizer.scene_map import Manifest, MapFrame

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from gam_relocalizer.datasets.layout import Layout
    from gam_relocalizer.mapping.colmap_model import ColmapModel
    from gam_relocalizer.mapping.foreign_features import ForeignFeatures
    from gam_relocalizer.mapping.progress import Progress
    from gam_relocalizer.mapping.workspace import Workspace
    from gam_relocalizer.scene_map import MapContent

_MIN_TRACK = 2


@dataclass(frozen=True)
class DatasetOptions:
    """What the reading of a dataset can be told.

    Attributes:
        layout: Found by the files in the folder when None.
        split: Which of its images.
        spacing: Least movement [m] and turn [deg] between the images that are taken, see
            `spaced`; by default those of the layout.
        camera: That took all images, instead of the dataset's.
        metric: Whether the unit of the poses is a metre.
    """

    layout: Layout | None = None
    split: Split = Split.TRAIN
    spacing: tuple[float, float] | None = None
    camera: pycolmap.Camera | None = None
    metric: bool = True


@dataclass(frozen=True)
class ModelSummary:
    """What there was before an import.

    Attributes:
        images: With a pose.
        points: 3D points.
        mean_reprojection_error: Over the points [px], as the model says; None when it does not.
    """

    images: int
    points: int
    mean_reprojection_error: float | None


def import_dataset(
    folder: Path,
    out: Path,
    dataset: DatasetOptions | None = None,
    options: MapBuildOptions | None = None,
    progress: Progress = ignore_progress,
    workspace: Workspace | None = None,
) -> BuildReport:
    """A map of a dataset, in the frame of its poses.

    A camera that is only nominal (`Layout.camera_is_nominal`) is refined.

    Args:
        folder: Of the dataset; only read.
        out: The bundle.
        dataset: See there.
        options: Of the build.
        progress: Told of the steps of `build_map`.
        workspace: See `build_map`.

    Raises:
        UsageError: Options that cannot be used.
        DatasetError: See `read_dataset`.
        MapError, MapBuildError: See `build_map`.
    """
    dataset, options = dataset or DatasetOptions(), options or MapBuildOptions()
    check_output(out)
    layout = layout_of(folder, dataset.split, dataset.layout)
    distance, angle_deg = dataset.spacing or (layout.spacing, DEFAULT_ANGLE_DEG)
    images = spaced(read_dataset(folder, layout, dataset.split), distance, angle_deg)
    images = replace(images, metric=dataset.metric)
    if dataset.camera is not None:
        images = replace(images, cameras=dict.fromkeys(images.names, dataset.camera))
    elif layout.camera_is_nominal:
        options = replace(options, refine_camera=True)
    return build_map(images, out, options, progress, workspace)


def import_model(
    folder: Path,
    images: Path,
    out: Path,
    options: MapBuildOptions | None = None,
    *,
    metric: bool = False,
    progress: Progress = ignore_progress,
    workspace: Workspace | None = None,
) -> tuple[BuildReport, ModelSummary]:
    """A map of a COLMAP model and its images: cameras and poses are kept, points are new.

    Args:
        folder: Of the model; only read.
        images: The folder that the names in the model are relative to. Images that are missing
            there are left out.
        out: The bundle.
        options: Of the build.
        metric: Whether the unit of the model is a metre.
        progress: Told of the steps of `build_map`.
        workspace: See `build_map`.

    Raises:
        ModelError: The model is damaged or empty, or none of its images is there.
        UsageError, MapError, MapBuildError: See `build_map`.
    """
    check_output(out)
    model = read_colmap_model(folder)
    if not any((images / image.name).is_file() for image in model.images):
        msg = (
            f'{images}: none of the {len(model.images)} images of {folder} is there, for example '
            f'`{model.images[0].name}`; names are relative to the folder of images'
        )
        raise ModelError(msg)
    source = _image_set(model, images, metric=metric)
    report = build_map(source, out, options, progress, workspace)
    return report, _summary(model)


def import_model_with_features(
    folder: Path,
    features: ForeignFeatures,
    out: Path,
    *,
    metric: bool = False,
    descriptor_bits: int = 16,
    progress: Progress = ignore_progress,
) -> tuple[BuildReport, ModelSummary]:
    """A map of a COLMAP model and the features it was made of; no image is needed.

    Points and tracks are those of the model. Images are retrieved by VLAD, whose words are learned
    from the features.

    Args:
        folder: Of the model; only read.
        features: As many of each image as the model has keypoints.
        out: The bundle.
        metric: Whether the unit of the model is a metre.
        descriptor_bits: That the map keeps of each number of a local descriptor: 16 or 8.
        progress: Told of the steps extract, sfm and save.

    Raises:
        ModelError: The model is damaged or empty, or the features do not fit it.
        UsageError: Unknown extractor, an impossible number of bits, or names of images that a map
            cannot hold.
        WeightsError: The weights of the extractor are missing or damaged.
        MapError: `out` exists and is not a map bundle, or cannot be written.
    """
    check_output(out)
    check_descriptor_bits(descriptor_bits)
    extractor = create_extractor(features.extractor)
    model = read_colmap_model(folder)
    source = _image_set(model, folder, metric=metric)
    check_names(source.names)
    timer = StepTimer()
    with timer.step('extract'):
        images = _with_features(model, features, extractor.identity.dimension, progress)
    with timer.step('sfm'):
        progress('sfm', 0, 1)
        reconstruction = _reconstruction(model, images, source)
        vlad = Vlad.train(np.concatenate([image.features.descriptors for image in images]))
        described = np.stack([vlad.aggregate(image.features.descriptors) for image in images])
        content = content_of(reconstruction, images, described, vlad.codebook)
        progress('sfm', 1, 1)
    report = _report(model, content, reconstruction, timer)
    manifest = Manifest(
        extractor=extractor.identity,
        retrieval=vlad.name,
        descriptor_bits=descriptor_bits,
        frame=MapFrame(metric=metric, source='the imported COLMAP model'),
        counts={},
        build={
            'images': source.source,
            'options': {'imported': 'a COLMAP model and its features'},
            'software': {
                'gam_relocalizer': __version__,
                'pycolmap': pycolmap.__version__,
                'numpy': np.__version__,
            },
            'report': report.as_dict(),
        },
    )
    progress('save', 0, 1)
    save_bundle(out, content, manifest, reconstruction)
    progress('save', 1, 1)
    return report, _summary(model)


def _summary(model: ColmapModel) -> ModelSummary:
    return ModelSummary(len(model.images), len(model.points), model.mean_reprojection_error)


def _image_set(model: ColmapModel, folder: Path, *, metric: bool) -> ImageSet:
    return ImageSet(
        folder=folder,
        names=tuple(image.name for image in model.images),
        cameras={image.name: model.cameras[image.camera_id] for image in model.images},
        camera_from_world={image.name: image.camera_from_world for image in model.images},
        metric=metric,
    )


def _with_features(
    model: ColmapModel, features: ForeignFeatures, dimension: int, progress: Progress
) -> tuple[MappingImage, ...]:
    images: list[MappingImage] = []
    for done, image in enumerate(model.images, start=1):
        camera = model.cameras[image.camera_id]
        found = features.of(image, dimension)
        images.append(MappingImage(image.name, camera.width, camera.height, found))
        progress('extract', done, len(model.images))
    return tuple(images)


def _reconstruction(
    model: ColmapModel, images: Sequence[MappingImage], source: ImageSet
) -> pycolmap.Reconstruction:
    """The model with image i under id i + 1, without points that nothing describes."""
    seen = [
        np.where(described.features.descriptors.any(axis=1), image.points, NO_POINT)
        for image, described in zip(model.images, images, strict=True)
    ]
    observers = np.zeros(len(model.points), dtype=np.int64)
    for rows in seen:
        observers[np.unique(rows[rows != NO_POINT])] += 1
    kept = observers >= _MIN_TRACK
    seeing = sum(bool(kept[rows[rows != NO_POINT]].any()) for rows in seen)
    if seeing < MIN_IMAGES:
        msg = (
            f'{model.folder}: {seeing} of {len(model.images)} images see points that others see, '
            f'too; a map needs {MIN_IMAGES}'
        )
        raise ModelError(msg)
    with quiet_colmap():
        reconstruction = assemble(
            assign_cameras(source, images),
            images,
            [image.camera_from_world for image in model.images],
            model.points[kept],
            [_renumbered(rows, kept) for rows in seen],
        )
        return numbered_by_sight(reconstruction)


def _renumbered(rows: NDArray[np.int64], kept: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Rows of the points that are kept, counted among these."""
    new_row = np.append(np.where(kept, np.cumsum(kept) - 1, NO_POINT), NO_POINT)
    return np.asarray(new_row[rows], dtype=np.int64)


def _report(
    model: ColmapModel,
    content: MapContent,
    reconstruction: pycolmap.Reconstruction,
    timer: StepTimer,
) -> BuildReport:
    reconstruction.update_point_3d_errors()
    mapped = set(content.image_names)
    return BuildReport(
        images_given=len(model.images),
        images_registered=len(mapped),
        unregistered=tuple(image.name for image in model.images if image.name not in mapped),
        unreadable={},
        without_pose=(),
        other_models=(),
        pairs_matched=0,
        pairs_verified=0,
        points=len(content.points),
        observations=len(content.observation_points),
        mean_track_length=len(content.observation_points) / len(content.points),
        mean_reprojection_error=reconstruction.compute_mean_reprojection_error(),
        cameras=tuple(
            format_camera(camera) for _, camera in sorted(reconstruction.cameras.items())
        ),
        seconds={step: round(seconds, 2) for step, seconds in timer.seconds.items()},
    )
