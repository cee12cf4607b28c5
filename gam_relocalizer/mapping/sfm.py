# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Structure from motion with pycolmap: database, geometric verification, mapping, triangulation."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pycolmap

from gam_relocalizer.cameras import have_known_rays

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from gam_relocalizer.mapping.extraction import MappingImage
    from gam_relocalizer.mapping.intrinsics import ImageCameras
    from gam_relocalizer.mapping.progress import Progress

MIN_IMAGES = 3
_SEED = 0
# Bundle adjustment sums in the order of its threads: with more than one, no two maps are alike.
_THREADS = 1
# Mutual neighbours that are forced into one geometry always yield some inliers. Pairs below these
# were false nine times out of ten in a courtyard of repeated windows.
_MIN_INLIERS = 30
_MIN_INLIER_RATIO = 0.3
_MAX_TRIALS = 2000
# What COLMAP's incremental mapper filters by.
_MAX_ERROR_PX = 4.0
_MIN_ANGLE_DEG = 1.5
_MAX_ADJUSTMENTS = 50


@dataclass(frozen=True)
class SfmInput:
    """Everything that structure from motion starts from.

    Attributes:
        images: Image i has COLMAP's id i + 1.
        cameras: Of these images.
        constant_cameras: Ids of the cameras whose intrinsics are kept as they are.
        matches: (first, second) image index to [K,2] keypoint indices.
        camera_from_sfm: By name of image, where all poses are known.
    """

    images: Sequence[MappingImage]
    cameras: ImageCameras
    constant_cameras: frozenset[int]
    matches: Mapping[tuple[int, int], NDArray[np.integer]]
    camera_from_sfm: Mapping[str, pycolmap.Rigid3d] | None = None

    @property
    def all_cameras_constant(self) -> bool:
        """Whether nothing is left to be calibrated."""
        return len(self.constant_cameras) == len(self.cameras.cameras)


def image_id_of(index: int) -> int:
    """COLMAP's id of an image; ids start at 1."""
    return index + 1


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """Keeps COLMAP's own log off the terminal."""
    level, threshold = pycolmap.logging.minloglevel, pycolmap.logging.stderrthreshold
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    pycolmap.logging.stderrthreshold = pycolmap.logging.Level.FATAL.value
    try:
        yield
    finally:
        pycolmap.logging.minloglevel, pycolmap.logging.stderrthreshold = level, threshold


def write_database(path: Path, sfm_input: SfmInput) -> None:
    """Writes cameras, images, keypoints and raw matches to a new COLMAP database.

    Keypoints whose ray the camera model does not know keep their place and have no match: COLMAP
    would give them a wrong ray.
    """
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        for camera in sfm_input.cameras.cameras:
            database.write_camera(camera, use_camera_id=True)
            database.write_rig(_trivial_rig(camera), use_rig_id=True)
        for index, image in enumerate(sfm_input.images):
            _write_image(database, index, image, sfm_input)
        known = [
            have_known_rays(image.features.keypoints, sfm_input.cameras.of(index))
            for index, image in enumerate(sfm_input.images)
        ]
        for (first, second), matches in sfm_input.matches.items():
            usable = matches[known[first][matches[:, 0]] & known[second][matches[:, 1]]]
            database.write_matches(
                image_id_of(first), image_id_of(second), usable.astype(np.uint32)
            )


def write_geometries(
    path: Path, geometries: Mapping[tuple[int, int], pycolmap.TwoViewGeometry]
) -> None:
    """Adds what `verify_pairs` found to a database of the same images."""
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        for (first, second), geometry in geometries.items():
            database.write_two_view_geometry(image_id_of(first), image_id_of(second), geometry)


def verify_pairs(
    images: Sequence[MappingImage],
    cameras: ImageCameras,
    matches: Mapping[tuple[int, int], NDArray[np.integer]],
) -> dict[tuple[int, int], pycolmap.TwoViewGeometry]:
    """Those matches of each pair of images that agree with one epipolar geometry or homography.

    Keypoints whose ray the camera model does not know have no match: COLMAP would give them a wrong
    ray.

    Args:
        images: With keypoints.
        cameras: Of these images.
        matches: (first, second) image index to [K,2] keypoint indices.

    Returns:
        For each pair; one that does not hold has no inlier matches.
    """
    pixels = {
        index: images[index].features.keypoints.astype(np.float64)
        for index in {index for pair in matches for index in pair}
    }
    known = {index: have_known_rays(one, cameras.of(index)) for index, one in pixels.items()}

    def verify(pair: tuple[int, int]) -> pycolmap.TwoViewGeometry:
        first, second = pair
        matched = matches[pair]
        usable = matched[known[first][matched[:, 0]] & known[second][matched[:, 1]]]
        return pycolmap.estimate_two_view_geometry(
            cameras.of(first),
            pixels[first],
            cameras.of(second),
            pixels[second],
            usable.astype(np.uint32),
            _two_view_options(),
        )

    # every pair starts from the same seed: the number of threads changes nothing
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return dict(zip(matches, pool.map(verify, matches), strict=True))


def map_images(
    database_path: Path, work: Path, sfm_input: SfmInput, mapper: str, progress: Progress
) -> list[pycolmap.Reconstruction]:
    """Recovers poses and points; the model of most images comes first.

    Args:
        database_path: With verified matches.
        work: Folder for intermediate files.
        sfm_input: What the database was made of.
        mapper: `incremental` or `global`.
        progress: Told of every registered image.
    """
    pycolmap.set_random_seed(_SEED)
    if mapper == 'global':
        models = _map_globally(database_path, work, sfm_input)
    else:
        models = _map_incrementally(database_path, work, sfm_input, progress)
    return sorted(models, key=lambda model: (-model.num_reg_images(), -model.num_points3D()))


def triangulate(
    database_path: Path,
    work: Path,
    sfm_input: SfmInput,
    camera_from_sfm: Mapping[str, pycolmap.Rigid3d],
) -> pycolmap.Reconstruction:
    """Points from images with known poses; the model lies in the frame and scale of the poses."""
    pycolmap.set_random_seed(_SEED)
    model = pycolmap.Reconstruction()
    for camera in sfm_input.cameras.cameras:
        model.add_camera_with_trivial_rig(camera)
    for index, image in enumerate(sfm_input.images):
        model.add_image_with_trivial_frame(
            _colmap_image(index, image, sfm_input), camera_from_sfm[image.name]
        )
    options = pycolmap.IncrementalPipelineOptions()
    _set_incremental_options(options, sfm_input)
    return pycolmap.triangulate_points(
        model,
        database_path,
        work,
        work,
        options=options,
        refine_intrinsics=not sfm_input.all_cameras_constant,
    )


def add_images(
    database_path: Path,
    work: Path,
    sfm_input: SfmInput,
    model: pycolmap.Reconstruction,
    progress: Progress,
) -> pycolmap.Reconstruction:
    """Finds places for further images in a model whose images stay exactly where they are.

    Points may gain and lose observations and move a little, and there are new ones.

    Args:
        database_path: With verified matches of the further images.
        work: Folder for intermediate files.
        sfm_input: What the database was made of: first the images of the model, with their ids,
            then the others.
        model: To start from.
        progress: Told of every registered image.
    """
    pycolmap.set_random_seed(_SEED)
    start = work / 'start'
    start.mkdir()
    model.write_binary(start)
    options = pycolmap.IncrementalPipelineOptions()
    _set_incremental_options(options, sfm_input)
    options.fix_existing_frames = True
    options.multiple_models = False
    # those of the model are not matched with each other, and would count as unconnected
    options.load_all_images = True
    total, registered = len(sfm_input.images) - model.num_reg_images(), 0

    def count_image() -> None:
        nonlocal registered
        registered = min(registered + 1, total)
        progress('sfm', registered, total)

    models = pycolmap.incremental_mapping(
        database_path,
        work,
        work,
        options=options,
        input_path=start,
        next_image_callback=count_image,
    )
    return max(models.values(), key=lambda one: one.num_reg_images(), default=model)


def adjust_images(
    model: pycolmap.Reconstruction, image_ids: Sequence[int], shared_points: Sequence[int]
) -> None:
    """Bundle adjustment of some images of a model; all others, and all cameras, stay.

    Observations that do not fit afterwards are taken from the points of these images.

    Args:
        model: Changed in place.
        image_ids: Of the images that may move.
        shared_points: Ids of points that other images see as well: what ties these to the others.
    """
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in image_ids:
        config.add_image(image_id)
    for point_id in shared_points:
        config.add_variable_point(point_id)
    for camera_id in model.cameras:
        config.set_constant_cam_intrinsics(camera_id)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.solver_options.num_threads = _THREADS
    options.ceres.solver_options.max_num_iterations = _MAX_ADJUSTMENTS
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    seen = {
        point.point3D_id
        for image_id in image_ids
        for point in model.image(image_id).get_observation_points2D()
    }
    pycolmap.ObservationManager(model).filter_points3D(_MAX_ERROR_PX, _MIN_ANGLE_DEG, seen)


def numbered_by_sight(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """The same model, its points numbered 1, 2, ... in the order in which images come to see them.

    Points are ordered by the first image that observes them, then by the last: what is seen
    together has neighbouring ids, and so neighbouring rows in a map.
    """
    ids = np.array(sorted(model.point3D_ids()), dtype=np.int64)
    seen = np.array([_first_and_last_image(model.point3D(int(one))) for one in ids]).reshape(-1, 2)
    order = np.lexsort((ids, seen[:, 1], seen[:, 0]))
    numbered = pycolmap.Reconstruction(model)
    for one in ids:
        numbered.delete_point3D(int(one))
    for new, old in enumerate(ids[order], start=1):
        numbered.add_point3D_with_id(new, model.point3D(int(old)))
    return numbered


def _first_and_last_image(point: pycolmap.Point3D) -> tuple[int, int]:
    images = [element.image_id for element in point.track.elements]
    return min(images), max(images)


def _two_view_options() -> pycolmap.TwoViewGeometryOptions:
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = _SEED
    options.ransac.max_num_trials = _MAX_TRIALS
    options.min_num_inliers = _MIN_INLIERS
    options.min_inlier_ratio = _MIN_INLIER_RATIO
    options.compute_relative_pose = True
    return options


def _map_incrementally(
    database_path: Path, work: Path, sfm_input: SfmInput, progress: Progress
) -> list[pycolmap.Reconstruction]:
    options = pycolmap.IncrementalPipelineOptions()
    _set_incremental_options(options, sfm_input)
    total, registered = len(sfm_input.images), 0

    def count_image() -> None:
        nonlocal registered
        registered = min(registered + 1, total)
        progress('sfm', registered, total)

    models = pycolmap.incremental_mapping(
        database_path, work, work, options=options, next_image_callback=count_image
    )
    return list(models.values())


def _map_globally(
    database_path: Path, work: Path, sfm_input: SfmInput
) -> list[pycolmap.Reconstruction]:
    if not sfm_input.all_cameras_constant:
        calibration = pycolmap.ViewGraphCalibrationOptions()
        calibration.random_seed = _SEED
        pycolmap.calibrate_view_graph(database_path, calibration)
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = options.mapper.random_seed = _SEED
    options.num_threads = options.mapper.num_threads = _THREADS
    adjustment = options.mapper.bundle_adjustment
    adjustment.refine_focal_length = not sfm_input.all_cameras_constant
    adjustment.refine_extra_params = not sfm_input.all_cameras_constant
    return list(pycolmap.global_mapping(database_path, work, work, options).values())


def _set_incremental_options(
    options: pycolmap.IncrementalPipelineOptions, sfm_input: SfmInput
) -> None:
    options.random_seed = _SEED
    options.num_threads = _THREADS
    options.min_model_size = MIN_IMAGES
    options.extract_colors = False
    options.constant_cameras = set(sfm_input.constant_cameras)


def _write_image(
    database: pycolmap.Database, index: int, image: MappingImage, sfm_input: SfmInput
) -> None:
    colmap_image = _colmap_image(index, image, sfm_input)
    database.write_image(colmap_image, use_image_id=True)
    frame = pycolmap.Frame(frame_id=image_id_of(index), rig_id=colmap_image.camera_id)
    frame.add_data_id(colmap_image.data_id)
    database.write_frame(frame, use_frame_id=True)
    database.write_keypoints(image_id_of(index), image.features.keypoints)


def _colmap_image(index: int, image: MappingImage, sfm_input: SfmInput) -> pycolmap.Image:
    return pycolmap.Image(
        name=image.name,
        keypoints=image.features.keypoints.astype(np.float64),
        camera_id=sfm_input.cameras.of(index).camera_id,
        image_id=image_id_of(index),
    )


def _trivial_rig(camera: pycolmap.Camera) -> pycolmap.Rig:
    rig = pycolmap.Rig(rig_id=camera.camera_id)
    rig.add_ref_sensor(camera.sensor_id)
    return rig
