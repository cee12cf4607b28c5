# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""A pose that is nearly right becomes more exact, and one that cannot be sharpened stays."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from synthetic_place import CAMERA, Place, features_of, query_pose, save_place

from gam_relocalizer.geometry import pose_error, rigid3d_from_rotation, rotation_of
from gam_relocalizer.localization.sharpening import sharpened

if TYPE_CHECKING:
    from gam_relocalizer.features.local import LocalFeatures
    from gam_relocalizer.scene_map import SceneMap

PLACE = Place()
OFF_M, OFF_RAD = 0.005, 0.0005
COVARIANCE = np.diag([OFF_M**2] * 3 + [OFF_RAD**2] * 3)


@pytest.fixture(scope='module')
def scene_map(tmp_path_factory: pytest.TempPathFactory) -> SceneMap:
    return save_place(tmp_path_factory.mktemp('place') / 'map', PLACE)


def nearly(view: int) -> pycolmap.Rigid3d:
    """The pose of a view, about one standard deviation off in everything."""
    rng = np.random.default_rng(view)
    truth = query_pose(view)
    turn = Rotation.from_rotvec(rng.choice([-OFF_RAD, OFF_RAD], 3))
    rotation = turn * rotation_of(truth)
    centre = truth.tgt_origin_in_src() + rng.choice([-OFF_M, OFF_M], 3)
    return rigid3d_from_rotation(rotation, -rotation.apply(centre))


def exact_features(view: int, camera: pycolmap.Camera = CAMERA) -> LocalFeatures:
    """Those of a view as good extractors find them: to a third of a pixel."""
    features = features_of(PLACE, query_pose(view), seed=view, camera=camera)
    _, pixels = PLACE.seen_by(query_pose(view), camera)
    noise = np.random.default_rng(view).normal(0.0, 0.3, pixels.shape)
    keypoints = features.keypoints.copy()
    keypoints[: len(pixels)] = pixels + noise
    return replace(features, keypoints=keypoints)


def sharpen(
    scene_map: SceneMap,
    view: int,
    features: LocalFeatures,
    covariance: np.ndarray = COVARIANCE,
    camera: pycolmap.Camera = CAMERA,
) -> pycolmap.Rigid3d:
    points = np.arange(scene_map.num_points)
    return sharpened(nearly(view), covariance, features, camera, points, scene_map)


@pytest.mark.parametrize('view', range(6))
def test_a_pose_comes_closer_to_the_truth(scene_map: SceneMap, view: int) -> None:
    features = exact_features(view)
    before = pose_error(nearly(view), query_pose(view))
    after = pose_error(sharpen(scene_map, view, features), query_pose(view))

    assert after.position < 0.7 * before.position
    assert after.rotation_deg < 0.7 * before.rotation_deg


def test_it_works_with_a_distorted_camera(scene_map: SceneMap) -> None:
    camera = pycolmap.Camera(
        camera_id=1, model='OPENCV_FISHEYE', width=640, height=480,
        params=[300, 300, 320, 240, 0.01, -0.002, 0.0, 0.0],
    )  # fmt: skip
    features = exact_features(1, camera)
    after = pose_error(sharpen(scene_map, 1, features, camera=camera), query_pose(1))

    assert after.position < 0.5 * pose_error(nearly(1), query_pose(1)).position


def test_features_that_look_like_nothing_there_have_no_say(scene_map: SceneMap) -> None:
    features = exact_features(0)
    strangers = np.random.default_rng(5).normal(size=features.descriptors.shape)
    strangers /= np.linalg.norm(strangers, axis=1, keepdims=True)
    unlike = replace(features, descriptors=strangers.astype(np.float32))

    np.testing.assert_array_equal(sharpen(scene_map, 0, unlike).matrix(), nearly(0).matrix())


def test_a_pose_does_not_leave_its_own_ellipsoid(scene_map: SceneMap) -> None:
    features = exact_features(0)

    certain = sharpen(scene_map, 0, features, covariance=1e-4 * COVARIANCE)

    np.testing.assert_array_equal(certain.matrix(), nearly(0).matrix())


def test_few_features_change_nothing(scene_map: SceneMap) -> None:
    features = exact_features(0)
    few = replace(
        features,
        keypoints=features.keypoints[:20],
        descriptors=features.descriptors[:20],
        scores=features.scores[:20],
    )

    np.testing.assert_array_equal(sharpen(scene_map, 0, few).matrix(), nearly(0).matrix())
