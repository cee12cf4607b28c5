# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Images to localize in a map and what is known of them, from any of the layouts people have."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import pycolmap

from gam_relocalizer.cameras import parse_camera
from gam_relocalizer.datasets.layout import Split, layout_of
from gam_relocalizer.datasets.query_list import read_query_list
from gam_relocalizer.datasets.reading import read_dataset
from gam_relocalizer.errors import CameraError, MapError, UsageError
from gam_relocalizer.geometry import read_poses
from gam_relocalizer.image_set import ImageSet
from gam_relocalizer.images import read_image
from gam_relocalizer.scene_map import load_map

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from gam_relocalizer.datasets.layout import Layout
    from gam_relocalizer.scene_map import SceneMap


@dataclass(frozen=True)
class QuerySet:
    """Images to localize in a map.

    Attributes:
        scene_map: The map.
        folder: Where the images are.
        names: Of the queries, relative to the folder, in the order of their source.
        cameras: Of every query, by name.
        truth: camera_from_world of every query, by name; empty when no truth is known at all.
        images_without_truth: Number of further images, left out since the truth does not say where
            they were taken.
        world_from_map: Identity where the truth is in the frame of the map.
        aligned: Whether `world_from_map` was fitted to true poses of the map's images.
    """

    scene_map: SceneMap
    folder: Path
    names: tuple[str, ...]
    cameras: Mapping[str, pycolmap.Camera]
    truth: Mapping[str, pycolmap.Rigid3d]
    images_without_truth: int
    world_from_map: pycolmap.Sim3d
    aligned: bool


def read_query_set(
    map_path: Path,
    folder: Path,
    truth: Path,
    camera: str | None = None,
    reference: Path | None = None,
    every: int = 1,
) -> QuerySet:
    """A plain folder of images with a poses file; reads all but the images.

    Args:
        map_path: The map bundle.
        folder: The images; those that the truth names are queries.
        truth: Poses file, camera_from_world.
        camera: See `parse_camera`; the map's own if none is given.
        reference: Poses file of the images that the map was built from, in the world of the truth.
        every: Takes every so many-th image.

    Raises:
        UsageError: No such folder, no query in it, or a reference that lacks an image of the map.
        PosesFileError: A poses file is missing or malformed.
        CameraError: The camera cannot be understood, or the map has not exactly one of its own.
        MapError: The map is damaged, or does not fit over the reference.
    """
    parsed_camera = None if camera is None else parse_camera(camera)
    images = ImageSet.of_folder(folder, parsed_camera, read_poses(truth))
    return _query_set(map_path, images, str(truth), reference, every)


def read_dataset_queries(
    map_path: Path,
    dataset: Path,
    layout: Layout | None = None,
    camera: str | None = None,
    reference: Path | None = None,
    every: int = 1,
) -> QuerySet:
    """The test images of a dataset, or all of one that is a single sequence.

    Args:
        map_path: The map bundle, in the frame of the dataset's poses unless there is a reference.
        dataset: See `read_dataset`.
        layout: Found by the files in the folder when None.
        camera: Of all images instead of the dataset's; where that is unknown or only nominal, the
            map's own.
        reference: See `read_query_set`.
        every: Takes every so many-th image.

    Raises:
        UsageError, PosesFileError, CameraError, MapError: See `read_query_set`.
        DatasetError: See `read_dataset`.
    """
    parsed_camera = None if camera is None else parse_camera(camera)
    known = layout_of(dataset, Split.TRAIN, layout)
    split = Split.TEST if known.has_test_split else Split.TRAIN
    images = read_dataset(dataset, known, split)
    if parsed_camera is not None:
        images = replace(images, cameras=dict.fromkeys(images.names, parsed_camera))
    elif known.camera_is_nominal:
        images = replace(images, cameras={})
    return _query_set(map_path, images, str(dataset), reference, every)


def read_listed_queries(
    map_path: Path,
    folder: Path,
    query_list: Path,
    truth: Path | None = None,
    reference: Path | None = None,
    every: int = 1,
) -> QuerySet:
    """Images that a list names with a camera each, see `read_query_list`.

    Args:
        map_path: The map bundle.
        folder: What the names in the list are relative to.
        query_list: The list.
        truth: Poses file, camera_from_world; without it all images of the list are queries.
        reference: See `read_query_set`.
        every: Takes every so many-th image.

    Raises:
        UsageError, PosesFileError, CameraError, MapError: See `read_query_set`.
        DatasetError: See `read_query_list`.
    """
    images = read_query_list(query_list, folder)
    if truth is not None:
        images = replace(images, camera_from_world=read_poses(truth))
    return _query_set(map_path, images, str(truth), reference, every)


def read_query(query_set: QuerySet, name: str) -> NDArray[np.uint8]:
    """The pixels of a query, see `read_image`.

    Raises:
        ImageError: It cannot be read.
        CameraError: It has another size than its camera.
    """
    image, camera = read_image(query_set.folder / name), query_set.cameras[name]
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        msg = (
            f'{query_set.folder / name}: the image has {width} x {height} pixels, the camera '
            f'{camera.width} x {camera.height}; give the camera that took it, by --camera or in '
            f'the list of queries'
        )
        raise CameraError(msg)
    return image


def own_camera(scene_map: SceneMap) -> pycolmap.Camera:
    """The camera that took all images of a map, as its build left it.

    Raises:
        CameraError: There are several, or the manifest does not tell.
    """
    report = scene_map.manifest.build.get('report')
    lines = report.get('cameras') if isinstance(report, dict) else None
    if not isinstance(lines, list) or len(lines) != 1 or not isinstance(lines[0], str):
        found = f'{len(lines)} cameras' if isinstance(lines, list) else 'no cameras'
        msg = (
            f'{scene_map.path}: its manifest tells of {found}, expected one that took the queries '
            f'too; give the camera of the queries with --camera'
        )
        raise CameraError(msg)
    return parse_camera(lines[0])


def world_from_map_of(
    scene_map: SceneMap, true_mapping: Mapping[str, pycolmap.Rigid3d]
) -> pycolmap.Sim3d:
    """The similarity that lays the map's cameras over the true ones; identity for a metric map.

    Args:
        scene_map: A map.
        true_mapping: camera_from_world of its images, by name.

    Raises:
        UsageError: An image of the map has no true pose.
        MapError: No similarity fits.
    """
    if scene_map.manifest.frame.metric:
        return pycolmap.Sim3d()
    missing = [name for name in scene_map.image_names if name not in true_mapping]
    if missing:
        msg = (
            f'{scene_map.path}: {len(missing)} of its {scene_map.num_images} images have no true '
            f'pose in the reference, the first is `{missing[0]}`'
        )
        raise UsageError(msg)
    in_map = [pose.tgt_origin_in_src() for pose in scene_map.camera_from_map]
    in_world = [true_mapping[name].tgt_origin_in_src() for name in scene_map.image_names]
    fitted = pycolmap.estimate_sim3d(np.array(in_map), np.array(in_world))
    if fitted is None:
        msg = f'{scene_map.path}: no similarity lays its cameras over the true ones'
        raise MapError(msg)
    return fitted


def _query_set(
    map_path: Path, images: ImageSet, source: str, reference: Path | None, every: int
) -> QuerySet:
    """The images of a source as queries of a map.

    Args:
        map_path: The map bundle.
        images: Queries, their poses None when nothing is known of any.
        source: What holds the poses, for errors.
        reference: See `read_query_set`.
        every: Takes every so many-th image.
    """
    true_mapping = None if reference is None else read_poses(reference)
    taken = images.names[::every]
    names = taken if images.camera_from_world is None else _with_truth(taken, images, source)
    truth = images.camera_from_world or {}
    _check_on_disk(images.folder, names)
    scene_map = load_map(map_path)
    return QuerySet(
        scene_map=scene_map,
        folder=images.folder,
        names=names,
        cameras=_cameras(scene_map, names, images.cameras),
        truth={name: truth[name] for name in names if name in truth},
        images_without_truth=len(taken) - len(names),
        world_from_map=(
            pycolmap.Sim3d() if true_mapping is None else world_from_map_of(scene_map, true_mapping)
        ),
        aligned=true_mapping is not None and not scene_map.manifest.frame.metric,
    )


def _with_truth(names: tuple[str, ...], images: ImageSet, source: str) -> tuple[str, ...]:
    poses = images.camera_from_world or {}
    known = tuple(name for name in names if name in poses)
    if not known:
        msg = (
            f'{source}: names none of the {len(names)} images in {images.folder}; expected names '
            f'like `{names[0]}`, found names like `{next(iter(poses))}`'
        )
        raise UsageError(msg)
    return known


def _check_on_disk(folder: Path, names: tuple[str, ...]) -> None:
    missing = [name for name in names if not (folder / name).is_file()]
    if missing:
        msg = (
            f'{folder}: {len(missing)} of the {len(names)} queries are not there, the first is '
            f'`{missing[0]}`'
        )
        raise UsageError(msg)


def _cameras(
    scene_map: SceneMap, names: tuple[str, ...], known: Mapping[str, pycolmap.Camera]
) -> dict[str, pycolmap.Camera]:
    """A camera per query; where none is known, that of the map."""
    if all(name in known for name in names):
        return {name: known[name] for name in names}
    own = own_camera(scene_map)
    return {name: known.get(name, own) for name in names}
