# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Models of the corner room as COLMAP and hloc leave them: SIFT, database, model, HDF5 features."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING

import h5py
import numpy as np
import pycolmap
from corner_room import CAMERA

from gam_relocalizer.mapping.sfm import quiet_colmap

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path


@dataclass(frozen=True)
class ForeignModel:
    """A COLMAP model of images with known poses.

    Attributes:
        sfm: The model's folder, binary.
        database: What COLMAP made it of.
        features: The same features as hloc keeps them.
    """

    sfm: Path
    database: Path
    features: Path


def write_foreign_model(
    folder: Path,
    images: Path,
    poses: Mapping[str, pycolmap.Rigid3d],
    normalization: pycolmap.Normalization = pycolmap.Normalization.L1_ROOT,
) -> ForeignModel:
    """Runs COLMAP: SIFT, matching, triangulation."""
    folder.mkdir(parents=True)
    model = ForeignModel(folder / 'sfm', folder / 'database.db', folder / 'feats.h5')
    model.sfm.mkdir()
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads = False, 1
    options.sift.max_num_features = 1200
    options.sift.normalization = normalization
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model, reader.camera_params = 'SIMPLE_PINHOLE', '340,192,144'
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu, matching.num_threads = False, 1
    with quiet_colmap():
        pycolmap.extract_features(
            model.database,
            images,
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=options,
        )
        pycolmap.match_exhaustive(model.database, matching_options=matching)
        _triangulated(model.database, images, poses, model.sfm).write_binary(model.sfm)
    _write_features(model)
    return model


def _triangulated(
    database_path: Path, images: Path, poses: Mapping[str, pycolmap.Rigid3d], out: Path
) -> pycolmap.Reconstruction:
    start = pycolmap.Reconstruction()
    with pycolmap.Database.open(database_path) as database:
        camera = pycolmap.Camera(CAMERA.todict())
        camera.camera_id = database.read_all_cameras()[0].camera_id
        start.add_camera_with_trivial_rig(camera)
        for image in database.read_all_images():
            keypoints = database.read_keypoints(image.image_id)[:, :2].astype(np.float64)
            start.add_image_with_trivial_frame(
                pycolmap.Image(
                    name=image.name,
                    keypoints=keypoints,
                    camera_id=camera.camera_id,
                    image_id=image.image_id,
                ),
                poses[image.name],
            )
    return pycolmap.triangulate_points(start, database_path, images, out)


def _write_features(model: ForeignModel) -> None:
    """hloc's layout: pixel centres at integers, descriptors by columns."""
    with (
        closing(sqlite3.connect(model.database)) as database,
        h5py.File(model.features, 'w') as file,
    ):
        for name, rows, keypoints, descriptors in database.execute(
            'SELECT i.name, k.rows, k.data, d.data FROM images i JOIN keypoints k USING (image_id) '
            'JOIN descriptors d USING (image_id)'
        ):
            group = file.create_group(name)
            places = np.frombuffer(keypoints, np.float32).reshape(rows, -1)[:, :2] - 0.5
            described = np.frombuffer(descriptors, np.uint8).reshape(rows, 128) / 512
            group.create_dataset('keypoints', data=places)
            group.create_dataset('descriptors', data=described.T.astype(np.float16))
            group.create_dataset('scores', data=np.ones(rows, np.float32))
            group.create_dataset('image_size', data=[CAMERA.width, CAMERA.height])
