# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pycolmap

from gam_relocalizer.features.local import LocalFeatures
from gam_relocalizer.mapping.extraction import MappingImage
from gam_relocalizer.mapping.intrinsics import ImageCameras
from gam_relocalizer.mapping.sfm import SfmInput, image_id_of, write_database

if TYPE_CHECKING:
    from pathlib import Path

FISHEYE = pycolmap.Camera(
    camera_id=1,
    model='OPENCV_FISHEYE',
    width=800,
    height=480,
    params=[200, 200, 400, 240, 0, 0, 0, 0],
)
CENTRE, SIDE, CORNER = [400.0, 240.0], [600.0, 240.0], [790.0, 470.0]


def image_of(name: str, keypoints: list[list[float]]) -> MappingImage:
    count = len(keypoints)
    features = LocalFeatures(
        np.array(keypoints, np.float32), np.eye(count, dtype=np.float32), np.ones(count, np.float32)
    )
    return MappingImage(name, FISHEYE.width, FISHEYE.height, features)


def test_keypoints_without_a_known_ray_have_no_match(tmp_path: Path) -> None:
    images = [image_of('a', [CENTRE, CORNER, SIDE]), image_of('b', [CORNER, SIDE, CENTRE])]
    matches = {(0, 1): np.array([[0, 2], [1, 1], [2, 0], [2, 1]])}

    write_database(
        tmp_path / 'database.db',
        SfmInput(images, ImageCameras((FISHEYE,), (0, 0)), frozenset({1}), matches),
    )

    with pycolmap.Database.open(tmp_path / 'database.db') as database:
        written = database.read_matches(image_id_of(0), image_id_of(1))
        assert database.num_keypoints() == 6
    np.testing.assert_array_equal(written, [[0, 2], [2, 1]])
