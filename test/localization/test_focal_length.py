# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What images with a known focal length say about a wrong and about the right one."""

from __future__ import annotations

import math
from copy import copy
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from gam_relocalizer.geometry import rigid3d_from_rotation
from gam_relocalizer.localization.focal_length import focal_length_of
from gam_relocalizer.localization.pose import estimate_pose
from gam_relocalizer.localization.verdict import judge_focal_length

if TYPE_CHECKING:
    from gam_relocalizer.localization.focal_length import FocalLength

PINHOLE = pycolmap.Camera(model='PINHOLE', width=640, height=480, params=[500, 505, 318, 243])
RADIAL = pycolmap.Camera(model='SIMPLE_RADIAL', width=640, height=480, params=[500, 318, 243, -0.1])
OPENCV = pycolmap.Camera(
    model='OPENCV', width=640, height=480, params=[500, 505, 318, 243, -0.2, 0.05, 0.001, -0.001]
)
FISHEYE = pycolmap.Camera(
    model='OPENCV_FISHEYE',
    width=640,
    height=480,
    params=[250, 252, 320, 240, -0.02, 0.01, 0.0, 0.0],
)
CAMERAS = [PINHOLE, RADIAL, OPENCV, FISHEYE]
NUM_POINTS = 200

every_camera = pytest.mark.parametrize('camera', CAMERAS, ids=lambda camera: camera.model_name)


def with_focal_length(camera: pycolmap.Camera, factor: float) -> pycolmap.Camera:
    changed = copy(camera)
    params = camera.params.copy()
    params[camera.focal_length_idxs()] *= factor
    changed.params = params
    return changed


def seen_through(
    camera: pycolmap.Camera,
    given: pycolmap.Camera,
    seed: int = 0,
    slant: float | None = None,
    offset: float = 0.0,
    unit: float = 1.0,
) -> FocalLength:
    """What an image of a camera says when another one is given with it.

    Args:
        camera: The true camera.
        given: The one that is told.
        seed: Of the scene and the noise.
        slant: Of one flat wall; without it, a scene with depth.
        offset: Of the map's origin.
        unit: Map units per metre.
    """
    rng = np.random.default_rng(seed)
    pixels = rng.uniform([5.0, 5.0], [635.0, 475.0], (NUM_POINTS, 2))
    rays = np.column_stack([camera.cam_from_img(pixels), np.ones(NUM_POINTS)])
    if slant is None:
        depths = rng.uniform(2.0, 10.0, NUM_POINTS)
    else:
        depths = 4.0 / (1.0 + slant * rays[:, 0])
    position = np.array([1.0, -2.0, 0.5]) + offset
    turn = Rotation.from_rotvec([0.3, -0.2, 0.4])
    points = unit * (turn.inv().apply(rays * depths[:, None]) + position)
    keypoints = pixels + rng.normal(0.0, 1.0, pixels.shape)
    pose = estimate_pose(keypoints, points, np.ones(NUM_POINTS), given)
    if pose is None:  # as near to it as any, for what an image of a wall may do
        camera_from_map = rigid3d_from_rotation(turn, -unit * turn.apply(position))
        return focal_length_of(camera_from_map, keypoints, points, given)
    return focal_length_of(
        pose.camera_from_map, keypoints[pose.inliers], points[pose.inliers], given
    )


@every_camera
@pytest.mark.parametrize('factor', [0.8, 1.2])
def test_scene_with_depth_tells_the_true_focal_length(
    camera: pycolmap.Camera, factor: float
) -> None:
    for seed in range(5):
        found = seen_through(camera, with_focal_length(camera, factor), seed)
        assert found.ratio == pytest.approx(1.0 / factor, rel=0.06)
        assert found.log_sigma < 0.05
        assert judge_focal_length(found) is not None


@every_camera
@pytest.mark.parametrize('slant', [None, 0.0, 0.4, 0.7], ids=['depth', 'wall', 'slant', 'steep'])
def test_right_focal_length_is_never_doubted(camera: pycolmap.Camera, slant: float | None) -> None:
    for seed in range(8):
        assert judge_focal_length(seen_through(camera, camera, seed, slant)) is None


@every_camera
def test_right_focal_length_is_as_near_as_its_deviation_says(camera: pycolmap.Camera) -> None:
    found = [seen_through(camera, camera, seed) for seed in range(30)]
    off = [math.log(each.ratio) / each.log_sigma for each in found]
    assert 0.7 < np.sqrt(np.mean(np.square(off))) < 1.4


def test_slanted_wall_tells_little_where_both_focal_lengths_are_free() -> None:
    found = [seen_through(OPENCV, OPENCV, seed, slant=0.7) for seed in range(30)]
    off = [math.log(each.ratio) / each.log_sigma for each in found]
    assert 0.6 < np.sqrt(np.mean(np.square(off))) < 1.5


@pytest.mark.parametrize('factor', [0.8, 1.0, 1.2])
def test_flat_wall_tells_nothing(factor: float) -> None:
    found = seen_through(PINHOLE, with_focal_length(PINHOLE, factor), slant=0.0)
    assert found.log_sigma > 1.0


@pytest.mark.parametrize(('offset', 'unit'), [(1e5, 1.0), (0.0, 1e4), (10.0, 1e-4)])
def test_answers_the_same_in_any_map(offset: float, unit: float) -> None:
    given = with_focal_length(PINHOLE, 1.2)
    expected = seen_through(PINHOLE, given)
    found = seen_through(PINHOLE, given, offset=offset, unit=unit)
    assert found.ratio == pytest.approx(expected.ratio, rel=1e-3)
    assert found.log_sigma == pytest.approx(expected.log_sigma, rel=0.02)


def test_the_given_camera_stays_as_it_is() -> None:
    given = with_focal_length(RADIAL, 1.2)
    before = given.params.copy()
    seen_through(RADIAL, given)
    np.testing.assert_array_equal(given.params, before)
