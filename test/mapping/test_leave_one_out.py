# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Every reference image as a query to the map without it."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from corner_room import CAMERA
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from map_content import all_global_descriptors

from gam_relocalizer.errors import ImageError, MapError, UsageError
from gam_relocalizer.geometry import rigid3d_from
from gam_relocalizer.localization.pose import reprojection_errors
from gam_relocalizer.mapping.colmap_model import NO_POINT
from gam_relocalizer.mapping.leave_one_out import (
    ReferenceImage,
    ReferenceImages,
    _same_keypoints,
    leave_out,
    read_reference_images,
)
from gam_relocalizer.scene_map import (
    SFM,
    ExtractorIdentity,
    FileEntry,
    Manifest,
    MapContent,
    MapFrame,
    SceneMap,
    load_map,
    map_in_memory,
    sha256_of,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from conftest import BuiltMap, Room

DIMENSION = 5
MANIFEST = Manifest(ExtractorIdentity('synthetic', DIMENSION, ''), 'vlad', MapFrame(), {})


def references_of(sees: np.ndarray, seed: int = 0) -> ReferenceImages:
    """Images with random descriptors that see points as told by [I,N], and some clutter.

    The keypoint that observes a point is at another index in every image.
    """
    rng = np.random.default_rng(seed)
    num_images, num_points = sees.shape
    images = []
    sums = np.zeros((num_points, DIMENSION), np.float32)
    for row in sees:
        point_of_keypoint = rng.permutation([*np.flatnonzero(row), NO_POINT, NO_POINT])
        descriptors = rng.normal(size=(len(point_of_keypoint), DIMENSION)).astype(np.float32)
        descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
        keypoints = rng.uniform(0.0, 100.0, (len(point_of_keypoint), 2)).astype(np.float32)
        images.append(ReferenceImage(CAMERA, keypoints, descriptors, point_of_keypoint))
        sums[point_of_keypoint[point_of_keypoint != NO_POINT]] += descriptors[
            point_of_keypoint != NO_POINT
        ]
    seen = [np.flatnonzero(row) for row in sees]
    scene_map = map_in_memory(
        Path('map'),
        MapContent(
            image_names=tuple(map(str, range(num_images))),
            camera_from_sfm=(rigid3d_from([1, 0, 0, 0], [0, 0, 0]),) * num_images,
            points=rng.normal(size=(num_points, 3)),
            descriptors=np.zeros((num_points, DIMENSION), np.float16),
            observation_offsets=np.cumsum([0, *map(len, seen)], dtype=np.int64),
            observation_points=np.concatenate(seen).astype(np.int32),
            global_descriptors=rng.normal(size=(num_images, 3)).astype(np.float32),
            codebook=np.zeros((1, DIMENSION), np.float32),
        ),
        MANIFEST,
    )
    return ReferenceImages(scene_map, tuple(images), sums)


visibilities = st.tuples(st.integers(2, 5), st.integers(1, 12)).flatmap(
    lambda shape: arrays(np.bool_, shape)
)


def test_view_holds_what_covisible_images_see() -> None:
    sees = np.array(
        [
            [1, 1, 1, 0, 0, 0],
            [0, 1, 1, 1, 0, 0],  # shares points 1 and 2 with the first
            [0, 0, 0, 1, 1, 0],  # shares nothing with the first
            [0, 0, 0, 0, 0, 1],
        ],
        dtype=bool,
    )
    references = references_of(sees)

    views = [leave_out(references, image) for image in range(4)]

    assert [view.points.tolist() for view in views] == [[1, 2, 3], [0, 1, 2, 3, 4], [1, 2, 3], []]
    true_points = [view.points[view.true_rows[view.true_rows != NO_POINT]] for view in views]
    assert [sorted(points.tolist()) for points in true_points] == [[1, 2], [1, 2, 3], [3], []]


@given(visibilities, st.integers(0, 1000))
def test_true_rows_are_the_points_that_others_see_too(sees: np.ndarray, seed: int) -> None:
    references = references_of(sees, seed)

    for image, described in enumerate(references.images):
        view = leave_out(references, image)
        others_see = np.delete(sees, image, axis=0).any(axis=0)
        assert others_see[view.points].all()
        assert (np.diff(view.points) > 0).all()
        points = np.append(view.points, NO_POINT)[view.true_rows]
        observed = described.point_of_keypoint
        expected = np.where((observed != NO_POINT) & others_see[observed], observed, NO_POINT)
        np.testing.assert_array_equal(points, expected)


@given(visibilities, st.integers(0, 1000))
def test_descriptors_are_the_means_over_the_other_images(sees: np.ndarray, seed: int) -> None:
    references = references_of(sees, seed)

    for image in range(len(sees)):
        view = leave_out(references, image)
        for point, descriptor in zip(view.points, view.point_descriptors, strict=True):
            mean = np.mean(
                [
                    other.descriptors[other.point_of_keypoint == point][0]
                    for index, other in enumerate(references.images)
                    if index != image and sees[index, point]
                ],
                axis=0,
            )
            np.testing.assert_allclose(descriptor, mean / np.linalg.norm(mean), atol=1e-4)


@given(visibilities, st.integers(0, 1000))
def test_reference_is_the_most_alike_of_the_others(sees: np.ndarray, seed: int) -> None:
    references = references_of(sees, seed)
    described = all_global_descriptors(references.scene_map)
    alike = described @ described.T
    np.fill_diagonal(alike, -np.inf)

    for image in range(len(sees)):
        assert leave_out(references, image).reference == alike[image].argmax()


def test_leaving_out_changes_nothing_for_the_next() -> None:
    references = references_of(np.ones((3, 4), dtype=bool))

    first = leave_out(references, 0)
    leave_out(references, 1)
    again = leave_out(references, 0)

    np.testing.assert_array_equal(first.point_descriptors, again.point_descriptors)


@pytest.fixture(scope='module')
def references(posed_map: BuiltMap, room: Room) -> ReferenceImages:
    return read_reference_images(load_map(posed_map.path), room.images)


def test_sums_of_the_tracks_are_the_map_s_descriptors(references: ReferenceImages) -> None:
    sums = references.descriptor_sums
    means = sums / np.linalg.norm(sums, axis=1, keepdims=True)
    everything = np.arange(len(means))
    np.testing.assert_allclose(means, references.scene_map.descriptors_of(everything), atol=1e-3)


def test_keypoints_lie_where_their_points_are_seen(references: ReferenceImages) -> None:
    scene_map = references.scene_map
    for index, image in enumerate(references.images):
        observes = image.point_of_keypoint != NO_POINT
        points = image.point_of_keypoint[observes]
        errors = reprojection_errors(
            scene_map.camera_from_map[index],
            image.keypoints[observes].astype(float),
            scene_map.points[points],
            image.camera,
        )
        assert np.median(errors) < 2.0
        assert set(points.tolist()) == set(scene_map.points_seen_by(index).tolist())


def test_cameras_outlive_the_colmap_model(references: ReferenceImages) -> None:
    assert len(references.images) == 8
    for image in references.images:
        assert image.camera.params.tolist() == CAMERA.params.tolist()
        assert (image.camera.width, image.camera.height) == (CAMERA.width, CAMERA.height)


def test_progress_counts_the_images(posed_map: BuiltMap, room: Room) -> None:
    told: list[tuple[str, int, int]] = []
    read_reference_images(load_map(posed_map.path), room.images, lambda *one: told.append(one))
    assert told == [('extract', done, 8) for done in range(1, 9)]


def test_rejects_other_images_of_the_same_names(
    posed_map: BuiltMap, room: Room, tmp_path: Path
) -> None:
    names = sorted(path.name for path in room.images.iterdir())
    for name, other in zip(names, [*names[1:], names[0]], strict=True):
        shutil.copy(room.images / other, tmp_path / name)
    with pytest.raises(ImageError, match='view 00'):
        read_reference_images(load_map(posed_map.path), tmp_path)


def test_rejects_a_folder_that_lacks_an_image(
    posed_map: BuiltMap, room: Room, tmp_path: Path
) -> None:
    shutil.copytree(room.images, tmp_path / 'images')
    (tmp_path / 'images' / 'view 03.png').unlink()
    with pytest.raises(ImageError, match='view 03'):
        read_reference_images(load_map(posed_map.path), tmp_path / 'images')


def test_rejects_a_folder_that_is_not_there(posed_map: BuiltMap, tmp_path: Path) -> None:
    with pytest.raises(UsageError):
        read_reference_images(load_map(posed_map.path), tmp_path / 'nowhere')


def without_model(scene_map: SceneMap) -> SceneMap:
    files = scene_map.manifest.files
    kept = {name: entry for name, entry in files.items() if not name.startswith(SFM)}
    return replace(scene_map, manifest=replace(scene_map.manifest, files=kept))


def with_another_extractor(scene_map: SceneMap) -> SceneMap:
    other = replace(scene_map.manifest.extractor, weights_sha256='other')
    return replace(scene_map, manifest=replace(scene_map.manifest, extractor=other))


def without_build_options(scene_map: SceneMap) -> SceneMap:
    return replace(scene_map, manifest=replace(scene_map.manifest, build={}))


def with_a_point_less(scene_map: SceneMap) -> SceneMap:
    stored = replace(scene_map.stored, points=scene_map.stored.points[:-1])
    return replace(scene_map, stored=stored)


def with_an_image_renamed(scene_map: SceneMap) -> SceneMap:
    return replace(scene_map, image_names=('other.png', *scene_map.image_names[1:]))


@pytest.mark.parametrize(
    'spoil',
    [
        without_model,
        with_another_extractor,
        without_build_options,
        with_a_point_less,
        with_an_image_renamed,
    ],
)
def test_rejects_a_map_that_does_not_tell_its_tracks(
    posed_map: BuiltMap, room: Room, spoil: Callable[[SceneMap], SceneMap]
) -> None:
    with pytest.raises(MapError):
        read_reference_images(spoil(load_map(posed_map.path)), room.images)


def test_rejects_a_damaged_model(posed_map: BuiltMap, room: Room, tmp_path: Path) -> None:
    shutil.copytree(posed_map.path, tmp_path / 'map')
    file = tmp_path / 'map' / SFM / 'images.bin'
    file.write_bytes(file.read_bytes()[:-7])
    with pytest.raises(MapError, match=r'images\.bin'):
        read_reference_images(load_map(tmp_path / 'map'), room.images)


def test_rejects_a_truncated_model_that_the_manifest_vouches_for(
    posed_map: BuiltMap, room: Room, tmp_path: Path
) -> None:
    shutil.copytree(posed_map.path, tmp_path / 'map')
    file = tmp_path / 'map' / SFM / 'images.bin'
    file.write_bytes(file.read_bytes()[:-7])
    scene_map = load_map(tmp_path / 'map')
    entry = FileEntry(file.stat().st_size, sha256_of(file))
    files = {**scene_map.manifest.files, f'{SFM}/images.bin': entry}
    vouched = replace(scene_map, manifest=replace(scene_map.manifest, files=files))

    with pytest.raises(MapError, match=r'images\.bin'):
        read_reference_images(vouched, room.images)


@given(st.permutations(range(12)), st.integers(0, 12))
def test_keypoints_in_another_order_are_the_same(order: list[int], kept: int) -> None:
    observed = np.stack([np.arange(12.0) * 7 % 11, np.arange(12.0)], axis=1)
    noise = np.random.default_rng(0).uniform(-0.003, 0.003, observed.shape)
    found = (observed + noise)[order][:kept]
    assert _same_keypoints(found, observed).tolist() == order[:kept]


def test_keypoints_at_one_place_are_told_apart_by_their_order() -> None:
    observed = np.array([[1.0, 1.0], [1.0, 1.0], [2.0, 2.0], [1.0, 1.0]])
    assert _same_keypoints(observed, observed).tolist() == [0, 1, 2, 3]


def test_keypoints_elsewhere_are_not_the_same() -> None:
    observed = np.array([[1.0, 1.0], [2.0, 2.0]])
    assert _same_keypoints(observed + np.array([0.0, 0.5]), observed).tolist() == [2, 2]
    assert _same_keypoints(observed, observed[:0]).tolist() == [0, 0]
