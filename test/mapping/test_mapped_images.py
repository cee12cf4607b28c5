# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from corner_room import CAMERA

from gam_relocalizer.cameras import parse_camera
from gam_relocalizer.mapping.colmap_model import NO_POINT
from gam_relocalizer.mapping.intrinsics import ImageCameras
from gam_relocalizer.mapping.mapped_images import (
    assemble,
    content_of,
    joined_cameras,
    read_mapped_images,
)
from gam_relocalizer.scene_map import load_map

if TYPE_CHECKING:
    import pycolmap
    from conftest import BuiltMap


def camera(camera_id: int, focal: float) -> pycolmap.Camera:
    made = parse_camera(f'SIMPLE_PINHOLE 384 288 {focal} 192 144')
    made.camera_id = camera_id
    return made


def test_keypoints_look_like_the_points_they_observe(posed_map: BuiltMap) -> None:
    mapped, scene_map = read_mapped_images(posed_map.path), load_map(posed_map.path)

    assert [image.name for image in mapped.images] == list(scene_map.image_names)
    for image, pose, seen in zip(
        mapped.images, mapped.camera_from_sfm, mapped.point_of_keypoint, strict=True
    ):
        known = seen != NO_POINT
        pixels = CAMERA.img_from_cam(pose * mapped.points[seen[known]])
        away = np.linalg.norm(pixels - image.features.keypoints[known], axis=1)
        assert away.max() < 4.1
        np.testing.assert_allclose(
            image.features.descriptors[known], scene_map.descriptors_of(seen[known]), atol=1e-3
        )
        assert not image.features.descriptors[~known].any()


def test_assembled_again_it_is_the_same_map(posed_map: BuiltMap) -> None:
    mapped = read_mapped_images(posed_map.path)
    content = mapped.content

    model = assemble(
        mapped.cameras,
        mapped.images,
        mapped.camera_from_sfm,
        mapped.points,
        mapped.point_of_keypoint,
    )
    again = content_of(model, mapped.images, content.global_descriptors, content.codebook)

    assert again.image_names == content.image_names
    np.testing.assert_allclose(again.points, content.points, atol=1e-6)
    np.testing.assert_allclose(again.descriptors, content.descriptors, atol=1e-3)
    np.testing.assert_array_equal(again.observation_offsets, content.observation_offsets)
    np.testing.assert_array_equal(again.observation_points, content.observation_points)


def test_equal_cameras_become_one_only_when_both_are_known() -> None:
    first = ImageCameras((camera(1, 340.0),), (0, 0), frozenset({1}))
    second = ImageCameras((camera(1, 300.0), camera(2, 340.0)), (0, 1), frozenset({1, 2}))
    guessed = ImageCameras((camera(1, 340.0),), (0,), frozenset())

    joined = joined_cameras(first, second)

    assert [one.params[0] for one in joined.cameras] == [340.0, 300.0]
    assert joined.of_image == (0, 0, 1, 0)
    assert joined.given == {1, 2}
    assert joined_cameras(first, guessed).of_image == (0, 0, 1)
    assert joined_cameras(first, guessed).given == {1}
    assert [one.camera_id for one in joined.cameras] == [1, 2]
