# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Queries of a made-up place, whose every number is known, by every method."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from synthetic_place import (
    CAMERA,
    IDENTITY,
    NUM_IMAGES,
    Place,
    features_of,
    looking,
    no_features,
    query_pose,
    ring_pose,
    save_place,
)

from gam_relocalizer.cameras import format_camera
from gam_relocalizer.errors import CameraError, ImageError
from gam_relocalizer.evaluation.localization import (
    Outcome,
    calibration_of,
    covisible_images,
    evaluate_set,
    methods_of,
    score_retrieval,
    summarise,
    tally,
)
from gam_relocalizer.evaluation.metrics import THRESHOLDS
from gam_relocalizer.evaluation.query_set import read_query_set
from gam_relocalizer.features.vlad import Vlad
from gam_relocalizer.geometry import PoseError, pose_error, write_poses
from gam_relocalizer.localization.localizer import Localizer, LocalizerOptions
from gam_relocalizer.localization.result import Status
from gam_relocalizer.localization.scenes import Coarse
from gam_relocalizer.matching.baselines import NearestNeighbourCross, NearestNeighbourRatio
from gam_relocalizer.scene_map import MapFrame

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from gam_relocalizer.evaluation.localization import SetEvaluation
    from gam_relocalizer.evaluation.query_set import QuerySet
    from gam_relocalizer.features.local import LocalFeatures
    from gam_relocalizer.scene_map import SceneMap

PLACE = Place(num_points=2500)
QUERIES = 3
BLANK = QUERIES
WORLD_FROM_MAP = pycolmap.Sim3d(
    scale=0.4,
    rotation=pycolmap.Rotation3d(Rotation.from_euler('xyz', [0.3, -1.1, 2.0]).as_quat()),
    translation=np.array([30.0, -7.0, 2.0]),
)
MATCHERS = {'nn-cross': NearestNeighbourCross(), 'nn-ratio': NearestNeighbourRatio()}


class NumberedExtractor:
    """Looks up features by the grey value that `write_query` paints; counts what it is asked."""

    identity = IDENTITY

    def __init__(self, views: Mapping[int, LocalFeatures]) -> None:
        self._views = views
        self.asked: list[int] = []

    def extract(self, image: np.ndarray) -> LocalFeatures:
        self.asked.append(int(image[0, 0, 0]))
        return self._views[self.asked[-1]]


def name_of(view: int) -> str:
    return f'query {view:02}.png'


def write_query(folder: Path, view: int) -> None:
    folder.mkdir(exist_ok=True)
    grey = np.full((CAMERA.height, CAMERA.width), view, np.uint8)
    cv2.imwrite(str(folder / name_of(view)), grey)


@pytest.fixture(scope='module')
def scene_map(tmp_path_factory: pytest.TempPathFactory) -> SceneMap:
    return save_place(tmp_path_factory.mktemp('maps') / 'place', PLACE, MapFrame(metric=True))


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Queries, then a blank image with a truth and an image without one; the truth beside it."""
    path = tmp_path_factory.mktemp('queries') / 'images'
    for view in range(QUERIES + 2):
        write_query(path, view)
    truth = {name_of(view): query_pose(view) for view in range(QUERIES + 1)}
    write_poses(path.parent / 'truth.txt', truth)
    return path


def extractor() -> NumberedExtractor:
    views = {view: features_of(PLACE, query_pose(view), seed=view) for view in range(QUERIES)}
    return NumberedExtractor({**views, BLANK: no_features()})


def evaluate(query_set: QuerySet, asked: NumberedExtractor | None = None) -> SetEvaluation:
    describer = Vlad(query_set.scene_map.codebook)
    return evaluate_set(query_set, asked or extractor(), describer, MATCHERS, retrieved_images=10)


def read(scene_map: SceneMap, folder: Path, **options: object) -> QuerySet:
    truth = folder.parent / 'truth.txt'
    return read_query_set(scene_map.path, folder, truth, format_camera(CAMERA), **options)


@dataclass(frozen=True)
class Evaluated:
    """An evaluation, and which images its features were extracted from."""

    evaluation: SetEvaluation
    asked: list[int]


@pytest.fixture(scope='module')
def evaluated(scene_map: SceneMap, folder: Path) -> Evaluated:
    asked = extractor()
    query_set = read(scene_map, folder)
    return Evaluated(evaluate(query_set, asked), asked.asked)


@pytest.fixture(scope='module')
def evaluation(evaluated: Evaluated) -> SetEvaluation:
    return evaluated.evaluation


def test_rows_are_those_of_the_paper() -> None:
    rows = [(one.name, one.matcher, one.coarse) for one in methods_of(('nn-ratio', 'gam'))]
    assert rows == [
        ('SR1', 'nn-ratio', Coarse.EXPANDED),
        ('SR1', 'gam', Coarse.EXPANDED),
        ('IR', 'gam', Coarse.TOGETHER),
        ('CC', 'gam', Coarse.CLUSTERS),
        ('SR', 'gam', Coarse.EXPANDED),
    ]
    tried = [one.max_scenes for one in methods_of(('gam',))]
    assert tried == [1, *[LocalizerOptions().max_scenes] * 3]


def test_every_method_finds_the_queries_and_nothing_in_the_blank(
    evaluation: SetEvaluation,
) -> None:
    assert (evaluation.queries, evaluation.images_without_truth) == (QUERIES + 1, 1)
    assert tuple(evaluation.outcomes) == methods_of(tuple(MATCHERS))
    for outcomes in evaluation.outcomes.values():
        assert list(outcomes) == [name_of(view) for view in range(QUERIES + 1)]
        blank = outcomes[name_of(BLANK)]
        assert (blank.status, blank.error) == (Status.TOO_FEW_FEATURES, None)
        score = summarise(outcomes.values())
        assert score.found.localized == score.accepted.localized == QUERIES
        assert score.found.recall[THRESHOLDS[0]] == pytest.approx(QUERIES / (QUERIES + 1))
        assert score.worst_position < 0.05
        assert score.worst_rotation_deg < 0.5
        assert score.milliseconds > 0.0


def test_a_row_is_what_the_localizer_does(
    scene_map: SceneMap, folder: Path, evaluation: SetEvaluation
) -> None:
    method = methods_of(tuple(MATCHERS))[0]
    options = LocalizerOptions(max_scenes=method.max_scenes, coarse=method.coarse)
    localizer = Localizer(scene_map, extractor(), MATCHERS[method.matcher], options)
    for view in range(QUERIES):
        image = np.full((CAMERA.height, CAMERA.width, 3), view, np.uint8)
        result = localizer.localize(image, CAMERA)
        outcome = evaluation.outcomes[method][name_of(view)]
        assert outcome.status is result.status
        expected = pose_error(
            result.estimate.camera_from_map, read(scene_map, folder).truth[name_of(view)]
        )
        assert astuple(outcome.error) == pytest.approx(astuple(expected), rel=1e-6)


def test_without_a_truth_the_same_poses_are_found(
    scene_map: SceneMap, folder: Path, evaluation: SetEvaluation
) -> None:
    found = evaluate(replace(read(scene_map, folder), truth={}))
    assert not found.has_truth
    assert found.retrieval is None
    for method, outcomes in evaluation.outcomes.items():
        for name, expected in outcomes.items():
            unknown = found.outcomes[method][name]
            assert unknown.error is None
            assert unknown.status is expected.status
            assert (unknown.camera_from_world is None) == (expected.camera_from_world is None)
            if unknown.camera_from_world is not None:
                error = pose_error(unknown.camera_from_world, query_pose(int(name[6:8])))
                assert error.position == pytest.approx(expected.error.position, abs=1e-8)


def test_poses_of_others_are_scored_against_the_same_truth(
    scene_map: SceneMap, folder: Path
) -> None:
    moved = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([0.0, 0.0, 0.03]))
    poses = {name_of(view): moved * query_pose(view) for view in range(QUERIES - 1)}
    query_set = read(scene_map, folder)
    describer = Vlad(scene_map.codebook)
    found = evaluate_set(
        *(query_set, extractor(), describer, MATCHERS), retrieved_images=10, others={'hloc': poses}
    )
    assert set(found.others['hloc']) == set(poses)
    for error in found.others['hloc'].values():
        assert error.position == pytest.approx(0.03)
        assert error.rotation_deg == pytest.approx(0.0, abs=1e-5)


def test_every_query_is_seen_by_its_own_camera(
    scene_map: SceneMap, folder: Path, evaluation: SetEvaluation
) -> None:
    query_set, method = read(scene_map, folder), methods_of(tuple(MATCHERS))[0]
    tele = pycolmap.Camera(
        camera_id=1, model='SIMPLE_PINHOLE', width=640, height=480, params=[600, 320, 240]
    )
    found = evaluate(replace(query_set, cameras={**query_set.cameras, name_of(0): tele}))
    once, again = (one.outcomes[method] for one in (evaluation, found))
    assert again[name_of(1)].error == once[name_of(1)].error
    assert again[name_of(0)].error != once[name_of(0)].error


def test_features_of_a_query_are_extracted_once(evaluated: Evaluated) -> None:
    assert evaluated.asked == list(range(QUERIES + 1))


def test_pictures_show_where_queries_were_and_the_worst_poses(evaluation: SetEvaluation) -> None:
    sights, whole = evaluation.sights, list(evaluation.outcomes)[-1]
    assert sights is not None
    for view in range(QUERIES):
        there = query_pose(view).tgt_origin_in_src()
        np.testing.assert_allclose(sights.positions[name_of(view)], there, atol=1e-9)
    errors = [evaluation.outcomes[whole][name].error for name in sights.worst]
    assert [error.position for error in errors] == sorted(
        (one.error.position for one in evaluation.outcomes[whole].values() if one.error),
        reverse=True,
    )
    for name, illustration in sights.worst.items():
        assert name_of(int(illustration.image[0, 0, 0])) == name
        assert illustration.estimate.inliers > 0


def test_retrieval_finds_what_is_covisible(evaluation: SetEvaluation) -> None:
    found = evaluation.retrieval
    # the blank has a pose that reference images share, and finds none of them
    assert found.queries == QUERIES + 1
    assert found.recall[0] == pytest.approx(QUERIES / (QUERIES + 1))
    assert len(found.recall) == 20
    assert 0.0 < found.covisible < 0.5


def test_a_map_in_a_frame_of_its_own_is_laid_over_the_reference(
    tmp_path: Path, scene_map: SceneMap, folder: Path, evaluation: SetEvaluation
) -> None:
    free = save_place(tmp_path / 'free', PLACE, MapFrame(metric=False))
    write_query(tmp_path / 'images', 0)
    in_world = {name_of(0): WORLD_FROM_MAP.transform_camera_world(query_pose(0))}
    write_poses(tmp_path / 'truth.txt', in_world)
    ring = {
        name: WORLD_FROM_MAP.transform_camera_world(pose)
        for name, pose in zip(free.image_names, free.camera_from_map, strict=True)
    }
    write_poses(tmp_path / 'reference.txt', ring)
    query_set = read(free, tmp_path / 'images', reference=tmp_path / 'reference.txt')

    assert query_set.aligned
    found = evaluate(query_set)
    for method, outcomes in evaluation.outcomes.items():
        in_map, error = outcomes[name_of(0)].error, found.outcomes[method][name_of(0)].error
        assert error.position == pytest.approx(WORLD_FROM_MAP.scale * in_map.position, abs=1e-6)
        assert error.rotation_deg == pytest.approx(in_map.rotation_deg, abs=1e-4)
    assert found.retrieval.recall[0] == 1.0
    # the same reference says nothing new about a metric map
    metric = read(scene_map, folder, reference=tmp_path / 'reference.txt')
    assert not metric.aligned
    np.testing.assert_array_equal(metric.world_from_map.matrix(), pycolmap.Sim3d().matrix())


@pytest.mark.parametrize('index', [0, 5, 17])
def test_neighbours_are_covisible_and_the_other_side_is_not(
    scene_map: SceneMap, index: int
) -> None:
    seen = covisible_images(scene_map, ring_pose(index), CAMERA)
    assert seen[[index, index - 1, (index + 1) % NUM_IMAGES]].all()
    assert not seen[(index + NUM_IMAGES // 2) % NUM_IMAGES]
    assert seen.sum() < NUM_IMAGES / 2


def test_from_behind_the_wall_nothing_is_covisible(scene_map: SceneMap) -> None:
    behind = looking(np.pi, np.array([12.0, 0.0, 0.0]))
    visible, _ = PLACE.seen_by(behind)
    assert len(visible) > 500
    # the wall is seen from behind, and through it only the wall across
    wall = covisible_images(scene_map, behind, CAMERA)
    assert not wall[[0, 1, NUM_IMAGES - 1]].any()


def test_a_glimpse_is_not_covisible(scene_map: SceneMap) -> None:
    tele = pycolmap.Camera(
        camera_id=1, model='SIMPLE_PINHOLE', width=640, height=480, params=[6000, 320, 240]
    )
    visible, _ = PLACE.seen_by(ring_pose(0), tele)
    assert 0 < len(visible) < 30
    assert not covisible_images(scene_map, ring_pose(0), tele).any()


def test_what_a_lens_folds_into_the_image_is_not_covisible(scene_map: SceneMap) -> None:
    # r (1 - 5 r^2): rays beyond r = 0.26 turn back, so the model puts points at r = 0.447 into the
    # centre of an image that shows no more than r = 0.1
    folding = pycolmap.Camera(
        camera_id=1, model='SIMPLE_RADIAL', width=100, height=100, params=[500, 50, 50, -5.0]
    )
    straight = pycolmap.Camera(
        camera_id=1, model='SIMPLE_PINHOLE', width=100, height=100, params=[500, 50, 50]
    )
    pose = ring_pose(0)
    np.testing.assert_array_equal(
        covisible_images(scene_map, pose, folding), covisible_images(scene_map, pose, straight)
    )


def test_recall_of_retrieval_counts_the_first_hit() -> None:
    covisible = [
        np.array([True, False, False, False]),
        np.array([False, True, True, False]),
        np.array([False, False, False, True]),
        np.zeros(4, bool),
    ]
    found = [np.array(order) for order in ([0, 1, 2, 3], [3, 0, 2, 1], [0, 1], [0, 1, 2, 3])]
    score = score_retrieval(found, covisible)
    assert score.queries == 3
    assert score.recall == pytest.approx([1 / 3, 1 / 3, *[2 / 3] * 18])
    assert score.covisible == pytest.approx(np.mean([1 / 4, 2 / 4, 1 / 4]))


def test_without_any_covisible_image_retrieval_has_no_recall() -> None:
    score = score_retrieval([np.array([0])], [np.zeros(3, bool)])
    assert score.queries == 0
    assert math.isnan(score.covisible)
    assert all(math.isnan(recall) for recall in score.recall)


def outcome(status: Status, position: float | None, confidence: float = 0.0) -> Outcome:
    error = None if position is None else PoseError(position, 10.0 * position)
    found = None if position is None else pycolmap.Rigid3d()
    return Outcome(status, error, confidence, 20.0, found)


OUTCOMES = (
    outcome(Status.ACCEPTED, 0.01, 0.9),
    outcome(Status.ACCEPTED, 0.15, 0.8),
    outcome(Status.UNCERTAIN, 0.03, 0.4),
    outcome(Status.TOO_FEW_INLIERS, 4.0, 0.1),
    outcome(Status.NO_SCENE, None),
)


def test_poses_without_a_verdict_are_told_apart_from_accepted_ones() -> None:
    score = summarise(OUTCOMES)
    assert (score.found.queries, score.found.localized) == (5, 4)
    assert (score.accepted.queries, score.accepted.localized) == (5, 2)
    assert list(score.found.recall.values()) == pytest.approx([0.4, 0.4, 0.6, 0.6, 0.6])
    assert list(score.accepted.recall.values()) == pytest.approx([0.2, 0.2, 0.4, 0.4, 0.4])
    assert score.found.median_position == pytest.approx(0.09)
    assert score.accepted.median_position == pytest.approx(0.08)
    assert score.worst_position == pytest.approx(0.15)
    assert score.worst_rotation_deg == pytest.approx(1.5)


def test_without_a_truth_poses_are_counted() -> None:
    unknown = [replace(one, error=None) for one in OUTCOMES]
    counted = tally(unknown)
    assert (counted.queries, counted.found, counted.accepted) == (5, 4, 2)
    assert counted.milliseconds == 20.0


def test_nothing_accepted_has_no_worst_error() -> None:
    score = summarise(OUTCOMES[2:])
    assert math.isnan(score.worst_position)
    assert math.isnan(score.worst_rotation_deg)


def test_confidence_is_held_against_the_poses_found() -> None:
    calibration, curve = calibration_of(OUTCOMES)
    assert sum(one.count for one in calibration.bins) == 4
    assert calibration.brier_score == pytest.approx(np.mean(np.square([0.1, 0.2, 0.6, 0.1])))
    np.testing.assert_allclose(curve.recall, [0.2, 0.4, 0.6, 0.6])
    assert curve.recall_without_error == pytest.approx(0.6)


def test_an_image_of_another_size_than_the_camera_is_a_camera_error(
    scene_map: SceneMap, folder: Path
) -> None:
    half = pycolmap.Camera(
        camera_id=1, model='SIMPLE_PINHOLE', width=320, height=240, params=[250, 160, 120]
    )
    query_set = read(scene_map, folder)
    query_set = replace(query_set, cameras=dict.fromkeys(query_set.names, half))
    with pytest.raises(CameraError, match=r'query 00\.png'):
        evaluate(query_set)


def test_an_unreadable_image_is_an_image_error(scene_map: SceneMap, tmp_path: Path) -> None:
    write_query(tmp_path / 'images', 0)
    (tmp_path / 'images' / name_of(0)).write_bytes(b'nonsense')
    write_poses(tmp_path / 'truth.txt', {name_of(0): query_pose(0)})
    query_set = read(scene_map, tmp_path / 'images')
    with pytest.raises(ImageError):
        evaluate(query_set)
