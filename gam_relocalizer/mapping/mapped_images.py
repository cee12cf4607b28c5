# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The reference images of a map as if they had just been extracted, without their pixels.

The COLMAP model of a bundle knows camera, pose and keypoints of each image. The descriptor of a
keypoint that observes a point is the map's mean descriptor of that point. So the images of a map go
through matching, verification and structure from motion like any others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pycolmap

from gam_relocalizer.cameras import format_camera
from gam_relocalizer.errors import MapError, ModelError, UsageError
from gam_relocalizer.features.local import LocalFeatures
from gam_relocalizer.mapping.colmap_model import NO_POINT, read_colmap_model
from gam_relocalizer.mapping.descriptors import describe_points
from gam_relocalizer.mapping.extraction import MappingImage
from gam_relocalizer.mapping.intrinsics import ImageCameras
from gam_relocalizer.mapping.sfm import image_id_of
from gam_relocalizer.scene_map import SFM, MapContent, load_content, verify_files

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from gam_relocalizer.mapping.colmap_model import ColmapModel, ModelImage
    from gam_relocalizer.scene_map import Manifest

_EXAMPLES = 3


@dataclass(frozen=True)
class MappedImages:
    """What a map knows of its reference images; all in its SfM frame.

    Attributes:
        path: The bundle.
        manifest: Of the map.
        content: Of the map.
        cameras: Of the images; all of them count as given.
        images: I images in the map's order. The descriptor of a keypoint that observes no point is
            zero: it is like nothing, and is matched with nothing.
        camera_from_sfm: I poses as structure from motion left them.
        points: [N,3] float64, in the order of the map.
        point_of_keypoint: For each image [M] int64 rows of points, or `NO_POINT`.
    """

    path: Path
    manifest: Manifest
    content: MapContent
    cameras: ImageCameras
    images: tuple[MappingImage, ...]
    camera_from_sfm: tuple[pycolmap.Rigid3d, ...]
    points: NDArray[np.float64]
    point_of_keypoint: tuple[NDArray[np.int64], ...]


def read_mapped_images(path: Path) -> MappedImages:
    """Reads the images of a map from its bundle alone.

    Raises:
        MapError: The map is damaged, or has no COLMAP model that fits it.
    """
    manifest, content = load_content(path)
    model = read_model_of(path, manifest)
    known = images_in_order(model, content.image_names, len(content.points))
    cameras = _cameras_of(model, known)
    images = tuple(
        _mapping_image(image, cameras.of(index), content.descriptors)
        for index, image in enumerate(known)
    )
    return MappedImages(
        path=path,
        manifest=manifest,
        content=content,
        cameras=cameras,
        images=images,
        camera_from_sfm=tuple(image.camera_from_world for image in known),
        points=model.points,
        point_of_keypoint=tuple(image.points for image in known),
    )


def read_model_of(path: Path, manifest: Manifest) -> ColmapModel:
    """Reads the COLMAP model of a map, which comes from anywhere.

    Raises:
        MapError: There is none, or it is damaged.
    """
    names = [name for name in manifest.files if name.startswith(f'{SFM}/')]
    if not names:
        msg = (
            f'{path}: has no COLMAP model ({SFM}/), which holds the keypoints and tracks of its '
            f'images; build it again with `map build`'
        )
        raise MapError(msg)
    verify_files(path, manifest, iter(names))
    try:
        return read_colmap_model(path / SFM)
    except ModelError as err:
        raise MapError(str(err)) from err


def images_in_order(
    model: ColmapModel, image_names: Sequence[str], num_points: int
) -> list[ModelImage]:
    """The images of a model in the order of its map.

    Raises:
        MapError: The model is not that of a map with such images and points.
    """
    by_name = {image.name: image for image in model.images}
    missing = [name for name in image_names if name not in by_name]
    if missing or len(model.points) != num_points:
        lacks = f', and lacks `{missing[0]}`' if missing else ''
        msg = (
            f'{model.folder}: {len(by_name)} images and {len(model.points)} points, the map has '
            f'{len(image_names)} and {num_points}{lacks}; build it again with `map build`'
        )
        raise MapError(msg)
    return [by_name[name] for name in image_names]


def assemble(
    cameras: ImageCameras,
    images: Sequence[MappingImage],
    camera_from_sfm: Sequence[pycolmap.Rigid3d],
    points: NDArray[np.float64],
    point_of_keypoint: Sequence[NDArray[np.int64]],
) -> pycolmap.Reconstruction:
    """A COLMAP model: image i has id i + 1, the point of row r has id r + 1.

    Args:
        cameras: Of the images.
        images: I images.
        camera_from_sfm: I poses.
        points: [N,3].
        point_of_keypoint: For each image [M] rows of points, or `NO_POINT`.
    """
    model = pycolmap.Reconstruction()
    for camera in cameras.cameras:
        model.add_camera_with_trivial_rig(camera)
    for index, (image, pose) in enumerate(zip(images, camera_from_sfm, strict=True)):
        colmap_image = pycolmap.Image(
            name=image.name,
            keypoints=image.features.keypoints.astype(np.float64),
            camera_id=cameras.of(index).camera_id,
            image_id=image_id_of(index),
        )
        model.add_image_with_trivial_frame(colmap_image, pose)
    tracks: list[list[pycolmap.TrackElement]] = [[] for _ in points]
    for index, rows in enumerate(point_of_keypoint):
        for keypoint in np.flatnonzero(rows != NO_POINT).tolist():
            tracks[rows[keypoint]].append(pycolmap.TrackElement(image_id_of(index), keypoint))
    for point, track in zip(points, tracks, strict=True):
        model.add_point3D(point, pycolmap.Track(track))
    return model


def content_of(
    model: pycolmap.Reconstruction,
    images: Sequence[MappingImage],
    global_descriptors: NDArray[np.float32],
    codebook: NDArray[np.float32],
) -> MapContent:
    """What a map keeps of a model of some images; those that see no point are left out.

    Args:
        model: Image i has id i + 1.
        images: I images.
        global_descriptors: [I,G].
        codebook: [W,D].
    """
    described = describe_points(model, images)
    rows = list(described.images)
    return MapContent(
        image_names=tuple(images[row].name for row in rows),
        camera_from_sfm=tuple(model.image(image_id_of(row)).cam_from_world() for row in rows),
        points=described.points,
        descriptors=described.descriptors,
        observation_offsets=described.observation_offsets,
        observation_points=described.observation_points,
        global_descriptors=global_descriptors[rows],
        codebook=codebook,
    )


def joined_cameras(first: ImageCameras, second: ImageCameras) -> ImageCameras:
    """The cameras of the images of `first`, followed by those of `second` under further ids.

    Given cameras that are equal become one.
    """
    known = {
        format_camera(camera): index
        for index, camera in enumerate(first.cameras)
        if camera.camera_id in first.given
    }
    cameras, given, moved = list(first.cameras), set(first.given), []
    for camera in second.cameras:
        is_given = camera.camera_id in second.given
        index = known.get(format_camera(camera)) if is_given else None
        if index is None:
            index = len(cameras)
            cameras.append(pycolmap.Camera(camera.todict()))
            cameras[index].camera_id = index + 1
            given |= {index + 1} if is_given else set()
        moved.append(index)
    return ImageCameras(
        cameras=tuple(cameras),
        of_image=(*first.of_image, *(moved[index] for index in second.of_image)),
        given=frozenset(given),
    )


def with_prefix(images: Iterable[MappingImage], prefix: str) -> tuple[MappingImage, ...]:
    """The images under longer names."""
    return tuple(replace(image, name=f'{prefix}{image.name}') for image in images)


def check_no_name_twice(path: Path, names: Iterable[str], more: Iterable[str]) -> None:
    """Refuses images that are named like images of the map at `path`.

    Raises:
        UsageError: The names, and what to do.
    """
    taken = set(names)
    twice = [name for name in more if name in taken]
    if twice:
        shown = ', '.join(f'`{name}`' for name in twice[:_EXAMPLES])
        msg = (
            f'{path}: has {len(twice)} images of the same names already: {shown}'
            f'{", ..." if len(twice) > _EXAMPLES else ""}; tell the others apart with --prefix, '
            f'for example `--prefix {path.stem}-2/`'
        )
        raise UsageError(msg)


def changed_manifest(
    manifest: Manifest, change: Mapping[str, Any], model: pycolmap.Reconstruction
) -> Manifest:
    """The manifest of a map that was changed: `build.changes` tells how, oldest change first.

    The numbers of `build.report` that describe the map, and not the build, follow the change.
    """
    build = dict(manifest.build)
    changes = build.get('changes')
    build['changes'] = [*(changes if isinstance(changes, list) else []), dict(change)]
    if isinstance(build.get('report'), dict):
        model.update_point_3d_errors()
        build['report'] = {
            **build['report'],
            'images_registered': model.num_reg_images(),
            'points': model.num_points3D(),
            'observations': model.compute_num_observations(),
            'mean_track_length': model.compute_mean_track_length(),
            'mean_reprojection_error': model.compute_mean_reprojection_error(),
            'cameras': [format_camera(camera) for _, camera in sorted(model.cameras.items())],
        }
    return replace(manifest, build=build)


def _cameras_of(model: ColmapModel, images: Sequence[ModelImage]) -> ImageCameras:
    """The cameras that took the images, with ids 1, 2, ..."""
    used = sorted({image.camera_id for image in images})
    cameras = [pycolmap.Camera(model.cameras[camera_id].todict()) for camera_id in used]
    for camera_id, camera in enumerate(cameras, start=1):
        camera.camera_id = camera_id
    return ImageCameras(
        cameras=tuple(cameras),
        of_image=tuple(used.index(image.camera_id) for image in images),
        given=frozenset(range(1, len(cameras) + 1)),
    )


def _mapping_image(
    image: ModelImage, camera: pycolmap.Camera, descriptors: NDArray[np.floating[Any]]
) -> MappingImage:
    known = image.points != NO_POINT
    described = np.zeros((len(known), descriptors.shape[1]), np.float32)
    described[known] = descriptors[image.points[known]]
    keypoints = image.keypoints.astype(np.float32)
    features = LocalFeatures(keypoints, described, np.zeros(len(keypoints), np.float32))
    return MappingImage(image.name, camera.width, camera.height, features)
