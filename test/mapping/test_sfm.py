# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
from full_disk import files_no_larger_than

from gam_relocalizer.cameras import format_camera
from gam_relocalizer.features.local import LocalFeatures
from gam_relocalizer.mapping.extraction import MappingImage
from gam_relocalizer.mapping.intrinsics import ImageCameras
from gam_relocalizer.mapping.sfm import (
    SfmInput,
    image_id_of,
    numbered_by_sight,
    verify_pairs,
    write_database,
)
from gam_relocalizer.scene_map import write_model

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


def cameras_in_a_row() -> pycolmap.Reconstruction:
    """Two rigs of two cameras with points that only some images see, numbered without order."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 2, 2, 4
    options.num_points3D = 60
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(options)
    rng = np.random.default_rng(0)
    for point_id in sorted(model.point3D_ids()):
        track = sorted(track_of(model.point3D(point_id)))
        first = rng.integers(len(track) - 3)
        last = rng.integers(first + 3, len(track))
        for image_id, keypoint in (*track[:first], *track[last + 1 :]):
            model.delete_observation(image_id, keypoint)
    model.update_point_3d_errors()
    return model


def track_of(point: pycolmap.Point3D) -> list[tuple[int, int]]:
    return [(element.image_id, element.point2D_idx) for element in point.track.elements]


def sight_of(point: pycolmap.Point3D) -> tuple[int, int]:
    images = [image_id for image_id, _ in track_of(point)]
    return min(images), max(images)


def test_points_are_numbered_by_the_first_and_then_the_last_image_that_sees_them() -> None:
    numbered = numbered_by_sight(cameras_in_a_row())

    assert sorted(numbered.point3D_ids()) == list(range(1, numbered.num_points3D() + 1))
    sights = [sight_of(numbered.point3D(one)) for one in sorted(numbered.point3D_ids())]
    assert sights == sorted(sights)
    assert len(set(sights)) > 10


def test_a_numbered_model_is_the_same_model_when_colmap_reads_it_again(tmp_path: Path) -> None:
    model = cameras_in_a_row()
    numbered_by_sight(model).write_binary(tmp_path)

    read = pycolmap.Reconstruction(tmp_path)

    def facts(one: pycolmap.Reconstruction) -> set[object]:
        return {
            (*point.xyz, *point.color, point.error, tuple(track_of(point)))
            for point in one.points3D.values()
        }

    assert facts(read) == facts(model)
    assert read.is_valid()
    assert (read.num_rigs(), read.num_cameras(), read.num_reg_frames()) == (2, 4, 8)
    for image_id, image in model.images.items():
        again = read.image(image_id)
        assert again.name == image.name
        assert format_camera(again.camera) == format_camera(image.camera)
        np.testing.assert_array_equal(
            again.cam_from_world().matrix(), image.cam_from_world().matrix()
        )
        np.testing.assert_array_equal(
            [point.xy for point in again.points2D], [point.xy for point in image.points2D]
        )
        for index in range(image.num_points2D()):
            old, new = image.points2D[index], again.points2D[index]
            assert old.has_point3D() == new.has_point3D()
            if old.has_point3D():
                np.testing.assert_array_equal(
                    read.point3D(new.point3D_id).xyz, model.point3D(old.point3D_id).xyz
                )


@pytest.mark.parametrize('size', [1000, 5000])
def test_a_model_that_a_full_disk_cuts_short_is_noticed(tmp_path: Path, size: int) -> None:
    model = cameras_in_a_row()

    with files_no_larger_than(size), pytest.raises(OSError, match='No space left'):
        write_model(model, tmp_path)

    write_model(model, tmp_path)
    assert pycolmap.Reconstruction(tmp_path).num_points3D() == model.num_points3D()


def seen_by_two(
    count: int, wrong: int
) -> tuple[list[MappingImage], ImageCameras, dict[tuple[int, int], np.ndarray]]:
    """Points before two cameras; the last so many matches are wrong."""
    camera = pycolmap.Camera(
        camera_id=1, model='SIMPLE_PINHOLE', width=800, height=480, params=[400, 400, 240]
    )
    rng = np.random.default_rng(0)
    points = rng.uniform([-2, -1, 4], [2, 1, 8], (count, 3))
    images = [
        image_of(name, camera.img_from_cam(points + np.array([shift, 0, 0])).tolist())
        for name, shift in [('a', 0.0), ('b', 0.5)]
    ]
    matches = np.stack([np.arange(count)] * 2, axis=1)
    matches[-wrong:, 1] = rng.permutation(matches[-wrong:, 1])
    return images, ImageCameras((camera,), (0, 0)), {(0, 1): matches}


def test_wrong_matches_are_left_out_of_a_verified_pair() -> None:
    images, cameras, matches = seen_by_two(count=100, wrong=20)

    geometry = verify_pairs(images, cameras, matches)[0, 1]

    inliers = set(map(tuple, geometry.inlier_matches.tolist()))
    assert {(index, index) for index in range(80)} <= inliers
    assert len(inliers) < 90


def test_a_pair_with_few_matches_does_not_hold() -> None:
    images, cameras, matches = seen_by_two(count=25, wrong=2)

    assert len(verify_pairs(images, cameras, matches)[0, 1].inlier_matches) == 0
