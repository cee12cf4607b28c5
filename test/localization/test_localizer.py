# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The whole query on a made-up place: accuracy, statuses for hopeless input, determinism."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from map_content import changed_map, of_first_images
from synthetic_place import (
    CAMERA,
    IDENTITY,
    NUM_IMAGES,
    Place,
    ViewExtractor,
    features_of,
    image_of,
    looking,
    no_features,
    query_pose,
    save_place,
    twin_of,
)

from gam_relocalizer.errors import MapError
from gam_relocalizer.geometry import pose_error
from gam_relocalizer.localization.localizer import Localizer, LocalizerOptions
from gam_relocalizer.localization.prior import Expectation, Gravity, PositionHint, Prior
from gam_relocalizer.localization.result import LocalizationResult, Status
from gam_relocalizer.localization.scenes import Coarse
from gam_relocalizer.localization.verdict import VerdictOptions
from gam_relocalizer.matching.baselines import NearestNeighbourRatio
from gam_relocalizer.scene_map import MapFrame

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike

    from gam_relocalizer.features.local import LocalFeatures
    from gam_relocalizer.scene_map import MapContent, SceneMap

PLACE = Place()
FISHEYE = pycolmap.Camera(
    camera_id=1,
    model='OPENCV_FISHEYE',
    width=800,
    height=600,
    params=[300, 300, 400, 300, -0.02, 0.01, 0.0, 0.0],
)
DISTORTED = pycolmap.Camera(
    camera_id=1,
    model='OPENCV',
    width=800,
    height=600,
    params=[600, 600, 400, 300, -0.2, 0.05, 0.001, -0.001],
)


@pytest.fixture(scope='module')
def scene_map(tmp_path_factory: pytest.TempPathFactory) -> SceneMap:
    return save_place(tmp_path_factory.mktemp('maps') / 'place', PLACE)


@pytest.fixture(scope='module')
def twin_map(tmp_path_factory: pytest.TempPathFactory) -> SceneMap:
    """The same place twice, the other 100 above the one."""
    twins, poses = twin_of(PLACE, np.array([0.0, 0.0, 100.0]))
    return save_place(tmp_path_factory.mktemp('maps') / 'twins', twins, poses=poses)


def make_localizer(
    scene_map: SceneMap,
    views: Mapping[int, LocalFeatures],
    options: LocalizerOptions | None = None,
) -> Localizer:
    return Localizer(scene_map, ViewExtractor(dict(views)), NearestNeighbourRatio(), options)


def localize(scene_map: SceneMap, features: LocalFeatures, **options: object) -> LocalizationResult:
    localizer = make_localizer(scene_map, {0: features}, LocalizerOptions(**options))
    return localizer.localize(image_of(0), CAMERA)


def localize_near(
    scene_map: SceneMap, view: int, position: ArrayLike, radius: float, **options: object
) -> LocalizationResult:
    """Localizes a view of the place with a hint where its camera is."""
    features = features_of(PLACE, query_pose(view), seed=view)
    localizer = make_localizer(scene_map, {0: features}, LocalizerOptions(**options))
    prior = Prior(hint=PositionHint(np.asarray(position, dtype=float), radius))
    return localizer.localize(image_of(0), CAMERA, prior)


def with_retrieval_turned_round(scene_map: SceneMap) -> SceneMap:
    """Every image of the ring is retrieved by what the opposite one looks like."""

    def turn(content: MapContent) -> MapContent:
        turned = np.roll(content.global_descriptors, NUM_IMAGES // 2, axis=0)
        return replace(content, global_descriptors=turned)

    return changed_map(scene_map, turn)


def check_invariants(result: LocalizationResult) -> None:
    assert result.reason
    assert result.keypoints >= result.matches >= result.inliers >= 0
    assert result.timings.total >= 0.0
    if result.accepted:
        assert result.estimate is not None
    if result.estimate is not None:
        covariance = result.estimate.covariance
        assert (covariance == covariance.T).all()
        np.linalg.cholesky(covariance)
        assert len(result.estimate.inlier_keypoints) == result.inliers
        assert len(set(result.estimate.inlier_points.tolist())) == result.inliers
        assert 0.0 < result.estimate.coverage <= 1.0
        assert result.estimate.inlier_ratio == pytest.approx(result.inliers / result.matches)


@pytest.mark.parametrize('camera', [CAMERA, DISTORTED, FISHEYE], ids=lambda c: c.model_name)
def test_localizes_queries_near_the_truth(scene_map: SceneMap, camera: pycolmap.Camera) -> None:
    views = {i: features_of(PLACE, query_pose(i), seed=i, camera=camera) for i in range(10)}
    localizer = make_localizer(scene_map, views)
    for index in views:
        result = localizer.localize(image_of(index, camera), camera)
        check_invariants(result)
        assert result.accepted
        error = pose_error(result.estimate.camera_from_map, query_pose(index))
        assert error.position < 0.05
        assert error.rotation_deg < 0.5


def test_answers_in_the_frame_of_the_map(tmp_path_factory: pytest.TempPathFactory) -> None:
    frame = MapFrame(2.5, (0.5, 0.5, -0.5, 0.5), (10.0, -20.0, 3.0), metric=True, source='survey')
    framed = save_place(tmp_path_factory.mktemp('maps') / 'framed', PLACE, frame)
    result = localize(framed, features_of(PLACE, query_pose(0), seed=0))
    truth = frame.map_from_sfm.transform_camera_world(query_pose(0))
    assert result.accepted
    assert pose_error(result.estimate.camera_from_map, truth).position < 0.1
    assert pose_error(result.estimate.camera_from_map, truth).rotation_deg < 0.5


def test_same_image_gives_the_same_bytes(scene_map: SceneMap) -> None:
    features = features_of(PLACE, query_pose(1), seed=1, clutter=500)
    first, second = (localize(scene_map, features) for _ in range(2))
    assert first.estimate.camera_from_map.matrix().tobytes() == (
        second.estimate.camera_from_map.matrix().tobytes()
    )
    assert first.estimate.covariance.tobytes() == second.estimate.covariance.tobytes()
    assert replace(first, estimate=None, timings=None) == (
        replace(second, estimate=None, timings=None)
    )


def test_image_without_features_is_refused(scene_map: SceneMap) -> None:
    result = localize(scene_map, no_features())
    assert result.status is Status.TOO_FEW_FEATURES
    assert result.estimate is None


def test_another_place_is_refused(scene_map: SceneMap) -> None:
    elsewhere = Place(seed=77)
    for index in range(10):
        result = localize(scene_map, features_of(elsewhere, query_pose(index), seed=index))
        check_invariants(result)
        assert not result.accepted


def test_mirrored_image_is_refused(scene_map: SceneMap) -> None:
    for index in range(5):
        features = features_of(PLACE, query_pose(index), seed=index)
        mirrored = features.keypoints * [-1.0, 1.0] + [CAMERA.width, 0.0]
        result = localize(scene_map, replace(features, keypoints=mirrored.astype(np.float32)))
        check_invariants(result)
        assert not result.accepted


@pytest.mark.parametrize(
    'image',
    [
        np.zeros((480, 640), np.uint16),
        np.zeros((480, 640, 4), np.uint8),
        np.zeros((480, 640, 3), np.float32),
        np.zeros((0, 640), np.uint8),
        np.zeros(640, np.uint8),
    ],
)
def test_what_is_no_image_is_refused(scene_map: SceneMap, image: np.ndarray) -> None:
    result = make_localizer(scene_map, {}).localize(image, CAMERA)
    assert result.status is Status.UNDECODABLE_IMAGE
    assert result.reason


def test_image_of_another_size_than_the_camera_is_refused(scene_map: SceneMap) -> None:
    result = make_localizer(scene_map, {}).localize(np.zeros((240, 320), np.uint8), CAMERA)
    assert result.status is Status.NO_CALIBRATION
    assert result.reason


def test_empty_map_gives_no_scene(scene_map: SceneMap) -> None:
    empty = changed_map(scene_map, partial(of_first_images, count=0))
    result = localize(empty, features_of(PLACE, query_pose(0), seed=0))
    assert result.status is Status.NO_SCENE
    assert result.scenes_tried == 0


def test_good_scene_ends_the_search_and_weak_ones_do_not(scene_map: SceneMap) -> None:
    features = features_of(PLACE, query_pose(0), seed=0)
    assert localize(scene_map, features).scenes_tried == 1
    never_enough = localize(scene_map, features, enough_inliers=10**6, scene_images=2, max_scenes=3)
    assert never_enough.scenes_tried == 3
    assert never_enough.accepted


def test_same_place_twice_in_the_map_gives_no_fix(twin_map: SceneMap) -> None:
    result = localize(twin_map, features_of(PLACE, query_pose(0), seed=0))
    assert result.status is Status.AMBIGUOUS
    assert result.inliers >= LocalizerOptions().enough_inliers


@pytest.mark.parametrize('coarse', list(Coarse))
def test_every_way_from_images_to_scenes_localizes(scene_map: SceneMap, coarse: Coarse) -> None:
    for index in range(5):
        features = features_of(PLACE, query_pose(index), seed=index)
        result = localize(scene_map, features, coarse=coarse)
        assert result.accepted
        assert pose_error(result.estimate.camera_from_map, query_pose(index)).position < 0.05


@given(
    view=st.integers(0, 20),
    position=st.tuples(*[st.floats(-5.0, 5.0)] * 3) | st.just((1e3, -1e3, 1e3)),
    radius=st.floats(0.0, 10.0) | st.just(np.inf),
    coarse=st.sampled_from(Coarse),
)
@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_no_hint_takes_a_fix_away_or_moves_it(
    scene_map: SceneMap,
    view: int,
    position: tuple[float, float, float],
    radius: float,
    coarse: Coarse,
) -> None:
    small = {'coarse': coarse, 'retrieved_images': 3, 'scene_images': 3}
    without = localize(scene_map, features_of(PLACE, query_pose(view), seed=view), **small)
    hinted = localize_near(scene_map, view, position, radius, **small)
    assert hinted.scenes_tried >= without.scenes_tried
    assert hinted.accepted >= without.accepted
    if without.accepted:
        moved = pose_error(hinted.estimate.camera_from_map, without.estimate.camera_from_map)
        assert moved.position < 0.05
        assert moved.rotation_deg < 0.5


@pytest.mark.parametrize('coarse', list(Coarse))
def test_hint_at_everything_changes_no_byte(scene_map: SceneMap, coarse: Coarse) -> None:
    without = localize(scene_map, features_of(PLACE, query_pose(3), seed=3), coarse=coarse)
    hinted = localize_near(scene_map, 3, [0.0, 0.0, 0.0], np.inf, coarse=coarse)
    assert replace(hinted, estimate=None, timings=None) == (
        replace(without, estimate=None, timings=None)
    )
    assert hinted.estimate.camera_from_map.matrix().tobytes() == (
        without.estimate.camera_from_map.matrix().tobytes()
    )


def test_hint_finds_a_place_that_the_retrieval_missed(scene_map: SceneMap) -> None:
    misled = with_retrieval_turned_round(scene_map)
    yaw = 0.4
    pose = looking(yaw, np.array([np.cos(yaw), np.sin(yaw), 0.0]))
    views = {0: features_of(PLACE, pose, seed=0)}
    localizer = make_localizer(misled, views, LocalizerOptions(retrieved_images=3, scene_images=3))
    assert not localizer.localize(image_of(0), CAMERA).accepted
    hint = PositionHint(pose.tgt_origin_in_src() + 0.05, 0.3)
    hinted = localizer.localize(image_of(0), CAMERA, Prior(hint=hint))
    assert hinted.accepted
    assert pose_error(hinted.estimate.camera_from_map, pose).position < 0.05


@pytest.mark.parametrize('coarse', list(Coarse))
@pytest.mark.parametrize('height', [0.0, 100.0], ids=['right', 'wrong'])
def test_hint_at_one_of_two_places_that_look_alike_gives_no_fix(
    twin_map: SceneMap, coarse: Coarse, height: float
) -> None:
    for view in range(2):
        result = localize_near(twin_map, view, [0.0, 0.0, height], 5.0, coarse=coarse)
        assert not result.accepted
        if coarse is not Coarse.TOGETHER:  # both places in one scene leave no unique match
            assert result.status is Status.AMBIGUOUS


@pytest.mark.parametrize(
    ('up_in_camera', 'status'),
    [
        ([0.0, -9.81, 0.0], Status.ACCEPTED),
        ([0.0, 1.0, 0.0], Status.IMPLAUSIBLE),
        ([1.0, -1.0, 0.0], Status.IMPLAUSIBLE),
    ],
    ids=['level', 'upside down', 'rolled'],
)
def test_pose_against_gravity_is_implausible(
    scene_map: SceneMap, up_in_camera: list[float], status: Status
) -> None:
    views = {0: features_of(PLACE, looking(0.7, np.zeros(3)), seed=0)}
    prior = Prior(gravity=Gravity(np.array(up_in_camera), 15.0))
    result = make_localizer(scene_map, views).localize(image_of(0), CAMERA, prior)
    check_invariants(result)
    assert result.status is status
    assert result.estimate is not None


def test_best_rejected_pose_is_kept_with_its_reason(scene_map: SceneMap) -> None:
    result = localize(
        scene_map,
        features_of(PLACE, query_pose(0), seed=0),
        verdict=VerdictOptions(min_coverage=1.1),
    )
    check_invariants(result)
    assert result.status is Status.POOR_COVERAGE
    assert result.estimate is not None
    assert result.scene in scene_map.image_names


@given(
    keep=st.integers(0, 80),
    clutter=st.integers(0, 300),
    view=st.integers(0, 20),
)
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_every_result_is_well_formed(
    scene_map: SceneMap, keep: int, clutter: int, view: int
) -> None:
    features = features_of(PLACE, query_pose(view), seed=view, clutter=clutter)
    correct = len(features) - clutter
    chosen = np.r_[np.arange(min(keep, correct)), np.arange(correct, len(features))]
    result = localize(
        scene_map,
        replace(
            features,
            keypoints=features.keypoints[chosen],
            descriptors=features.descriptors[chosen],
            scores=features.scores[chosen],
        ),
    )
    check_invariants(result)
    if result.accepted:
        assert pose_error(result.estimate.camera_from_map, query_pose(view)).position < 0.3


@pytest.mark.parametrize(
    'identity',
    [
        replace(IDENTITY, name='other'),
        replace(IDENTITY, dimension=128),
        replace(IDENTITY, weights_sha256='retrained'),
    ],
)
def test_refuses_a_map_of_another_extractor(scene_map: SceneMap, identity: object) -> None:
    extractor = ViewExtractor({})
    extractor.identity = identity
    with pytest.raises(MapError):
        Localizer(scene_map, extractor, NearestNeighbourRatio())


def test_refuses_a_map_of_another_retrieval(scene_map: SceneMap) -> None:
    other = replace(scene_map, manifest=replace(scene_map.manifest, retrieval='netvlad'))
    with pytest.raises(MapError):
        make_localizer(other, {})


def test_load_refuses_a_map_of_an_unknown_extractor(scene_map: SceneMap) -> None:
    with pytest.raises(MapError):
        Localizer.load(scene_map.path)


def weak_view(view: int) -> LocalFeatures:
    """A quarter of the image, so that alone it convinces nobody."""
    features = features_of(PLACE, query_pose(view), seed=view)
    kept = (features.keypoints < [0.55 * CAMERA.width, 0.55 * CAMERA.height]).all(axis=1)
    return replace(
        features,
        keypoints=features.keypoints[kept],
        descriptors=features.descriptors[kept],
        scores=features.scores[kept],
    )


def test_a_pose_that_is_expected_is_believed_sooner(scene_map: SceneMap) -> None:
    options = LocalizerOptions(verdict=VerdictOptions(min_belief=0.0))
    localizer = make_localizer(scene_map, {0: weak_view(2)}, options)
    alone = localizer.localize(image_of(0), CAMERA)
    expected = localizer.localize(
        image_of(0), CAMERA, Prior(expectation=Expectation(query_pose(2), 0.3, 5.0))
    )
    assert alone.accepted
    assert expected.estimate.belief > alone.estimate.belief
    strict = replace(options.verdict, min_belief=(alone.estimate.belief + 1.0) / 2.0)
    localizer = localizer.with_options(replace(options, verdict=strict))
    assert localizer.localize(image_of(0), CAMERA).status is Status.CONTRADICTED
    assert localizer.localize(
        image_of(0), CAMERA, Prior(expectation=Expectation(query_pose(2), 0.3, 5.0))
    ).accepted


def test_a_wrong_expectation_changes_nothing(scene_map: SceneMap) -> None:
    localizer = make_localizer(scene_map, {0: features_of(PLACE, query_pose(1), seed=1)})
    alone = localizer.localize(image_of(0), CAMERA)
    elsewhere = Prior(expectation=Expectation(query_pose(5), 0.3, 5.0))
    misled = localizer.localize(image_of(0), CAMERA, elsewhere)
    assert replace(misled, estimate=None, timings=None) == (
        replace(alone, estimate=None, timings=None)
    )
    assert misled.estimate.belief == alone.estimate.belief
