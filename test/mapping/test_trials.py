# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Each reference image, localized in the map without it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from gam_relocalizer.errors import UsageError
from gam_relocalizer.geometry import rigid3d_from
from gam_relocalizer.mapping.colmap_model import NO_POINT
from gam_relocalizer.mapping.coverage import Standing
from gam_relocalizer.mapping.leave_one_out import (
    ReferenceImages,
    map_without,
    read_reference_images,
)
from gam_relocalizer.mapping.trials import measure_coverage
from gam_relocalizer.scene_map import MapContent, covisibility_of, load_map, map_in_memory

if TYPE_CHECKING:
    from pathlib import Path

    from conftest import BuiltMap, Room

    from gam_relocalizer.mapping.coverage import Coverage
    from gam_relocalizer.scene_map import SceneMap

SOME_IMAGES = [0, 3, 7]


@pytest.fixture(scope='module')
def references(posed_map: BuiltMap, room: Room) -> ReferenceImages:
    return read_reference_images(load_map(posed_map.path), room.images)


@pytest.fixture(scope='module')
def coverage(posed_map: BuiltMap, room: Room) -> Coverage:
    return measure_coverage(load_map(posed_map.path), room.images)


def made_without(references: ReferenceImages, image: int) -> SceneMap:
    """The slow way: all that a map is made of, but for one image."""
    whole = references.scene_map
    others = [other for other in range(whole.num_images) if other != image]
    seen = [whole.points_seen_by(other) for other in others]
    often = np.bincount(np.concatenate(seen), minlength=whole.num_points) >= 2
    seen_twice = [
        points[often[points] | ~np.isin(points, whole.points_seen_by(image))] for points in seen
    ]
    sums = np.zeros((whole.num_points, whole.manifest.extractor.dimension))
    for other in others:
        described = references.images[other]
        observes = described.point_of_keypoint != NO_POINT
        np.add.at(sums, described.point_of_keypoint[observes], described.descriptors[observes])
    descriptors = np.array(whole.descriptors_of(np.arange(whole.num_points)))
    own = np.intersect1d(whole.points_seen_by(image), np.concatenate(seen_twice))
    descriptors[own] = sums[own] / np.linalg.norm(sums[own], axis=1, keepdims=True)
    content = MapContent(
        image_names=tuple(whole.image_names[other] for other in others),
        camera_from_sfm=tuple(whole.camera_from_map[other] for other in others),
        points=whole.points,
        descriptors=descriptors,
        observation_offsets=np.cumsum([0, *map(len, seen_twice)], dtype=np.int64),
        observation_points=np.concatenate(seen_twice).astype(np.int32),
        global_descriptors=np.stack([whole.global_descriptor_of(other) for other in others]),
        codebook=whole.codebook,
    )
    return map_in_memory(whole.path, content, whole.manifest)


@pytest.mark.parametrize('image', SOME_IMAGES)
def test_map_without_an_image_is_the_map_made_without_it(
    references: ReferenceImages, image: int
) -> None:
    without, made = map_without(references, image), made_without(references, image)

    assert without.image_names == made.image_names
    np.testing.assert_array_equal(without.num_points_seen, made.num_points_seen)
    for expected, found in zip(made.observations(), without.observations(), strict=True):
        np.testing.assert_array_equal(found, expected)
    for other in range(made.num_images):
        np.testing.assert_array_equal(without.points_seen_by(other), made.points_seen_by(other))
    assert (without.covisibility != made.covisibility).nnz == 0
    assert (without.covisibility != covisibility_of(*made.observations(), made.num_points)).nnz == 0
    np.testing.assert_allclose(without.camera_positions, made.camera_positions)
    seen = np.unique(made.observations()[1])
    np.testing.assert_allclose(without.descriptors_of(seen), made.descriptors_of(seen), atol=2e-3)
    query = references.scene_map.global_descriptor_of(image)
    np.testing.assert_allclose(without.likeness(query), made.likeness(query), atol=0.05)


@pytest.mark.parametrize('image', SOME_IMAGES)
def test_points_that_an_image_shares_with_one_other_are_gone(
    references: ReferenceImages, image: int
) -> None:
    whole = references.scene_map
    lengths = np.bincount(whole.observations()[1], minlength=whole.num_points)
    of_two = whole.points_seen_by(image)[lengths[whole.points_seen_by(image)] == 2]

    without = map_without(references, image)

    assert len(of_two)
    assert not np.isin(of_two, without.observations()[1]).any()


def test_images_of_a_good_map_are_found_where_they_are(coverage: Coverage) -> None:
    assert coverage.recall == 1.0
    assert len(coverage.images) == 8
    assert coverage.count(Standing.WRONG) == coverage.count(Standing.REFUSED) == 0
    for one in coverage.images:
        assert one.position_error is not None
        assert one.position_error < 0.05


def test_every_so_many_th_image_is_tried(
    posed_map: BuiltMap, room: Room, coverage: Coverage
) -> None:
    some = measure_coverage(load_map(posed_map.path), room.images, every=3)

    assert some.images == coverage.images[::3]


def test_an_image_with_a_wrong_pose_in_the_map_is_found_elsewhere(
    posed_map: BuiltMap, room: Room
) -> None:
    scene_map = load_map(posed_map.path)
    poses = list(scene_map.camera_from_map)
    poses[4] = rigid3d_from([1, 0, 0, 0], [0.6, 0, 0]) * poses[4]

    moved = measure_coverage(replace(scene_map, camera_from_map=tuple(poses)), room.images, every=4)

    assert [one.standing is Standing.WRONG for one in moved.images] == [False, True]
    (spot,) = [spot for spot in moved.weak_spots if spot.standing is Standing.WRONG]
    assert spot.images == (scene_map.image_names[4],)
    assert moved.images[1].position_error == pytest.approx(0.6, abs=0.05)


def test_a_missing_folder_is_a_usage_error(posed_map: BuiltMap, tmp_path: Path) -> None:
    with pytest.raises(UsageError):
        measure_coverage(load_map(posed_map.path), tmp_path / 'nowhere')
