# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What is to be localized, from each of the layouts."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import miniature_datasets
import numpy as np
import pycolmap
import pytest
from miniature_datasets import same_poses
from scipy.spatial.transform import Rotation
from synthetic_place import CAMERA, Place, query_pose, ring_pose, save_place

from gam_relocalizer.cameras import format_camera
from gam_relocalizer.datasets.layout import Layout
from gam_relocalizer.errors import CameraError, DatasetError, MapError, UsageError
from gam_relocalizer.evaluation.query_set import (
    own_camera,
    read_dataset_queries,
    read_listed_queries,
    read_query,
    read_query_set,
    world_from_map_of,
)
from gam_relocalizer.geometry import write_poses
from gam_relocalizer.scene_map import Manifest, MapFrame, load_content, save_map

if TYPE_CHECKING:
    from pathlib import Path

    from gam_relocalizer.scene_map import SceneMap

WORLD_FROM_MAP = pycolmap.Sim3d(
    scale=0.4,
    rotation=pycolmap.Rotation3d(Rotation.from_euler('xyz', [0.3, -1.1, 2.0]).as_quat()),
    translation=np.array([30.0, -7.0, 2.0]),
)


@pytest.fixture(scope='module')
def scene_map(tmp_path_factory: pytest.TempPathFactory) -> SceneMap:
    """A map whose manifest tells of no camera."""
    return save_place(
        tmp_path_factory.mktemp('maps') / 'place', Place(num_points=2500), MapFrame(metric=True)
    )


def test_the_similarity_between_map_and_world_is_found(scene_map: SceneMap) -> None:
    free = replace(scene_map, manifest=replace(scene_map.manifest, frame=MapFrame(metric=False)))
    poses = [WORLD_FROM_MAP.transform_camera_world(pose) for pose in free.camera_from_map]
    found = world_from_map_of(free, dict(zip(free.image_names, poses, strict=True)))
    np.testing.assert_allclose(found.matrix(), WORLD_FROM_MAP.matrix(), atol=1e-9)


def test_a_reference_must_know_all_images_of_the_map(scene_map: SceneMap) -> None:
    free = replace(scene_map, manifest=replace(scene_map.manifest, frame=MapFrame(metric=False)))
    with pytest.raises(UsageError, match=r'000\.png'):
        world_from_map_of(free, {'other.png': ring_pose(0)})


def test_cameras_in_one_place_fit_no_similarity(scene_map: SceneMap) -> None:
    free = replace(scene_map, manifest=replace(scene_map.manifest, frame=MapFrame(metric=False)))
    with pytest.raises(MapError):
        world_from_map_of(free, dict.fromkeys(free.image_names, ring_pose(0)))


def test_a_map_knows_its_own_camera(scene_map: SceneMap) -> None:
    described = {'report': {'cameras': [format_camera(CAMERA)]}}
    camera = own_camera(replace(scene_map, manifest=manifest_with(scene_map, described)))
    assert format_camera(camera) == format_camera(CAMERA)


@pytest.mark.parametrize(
    'build',
    [
        {},
        {'report': {}},
        {'report': 'none'},
        {'report': {'cameras': 7}},
        {'report': {'cameras': [7]}},
        {'report': {'cameras': []}},
        {'report': {'cameras': [format_camera(CAMERA)] * 2}},
    ],
)
def test_without_exactly_one_camera_the_map_has_none(
    scene_map: SceneMap, build: dict[str, object]
) -> None:
    with pytest.raises(CameraError):
        own_camera(replace(scene_map, manifest=manifest_with(scene_map, build)))


def manifest_with(scene_map: SceneMap, build: dict[str, object]) -> Manifest:
    return replace(scene_map.manifest, build=build)


def test_truth_of_other_images_is_a_usage_error(scene_map: SceneMap, tmp_path: Path) -> None:
    miniature_datasets.write_frame(tmp_path / 'images' / '0.png', 0)
    write_poses(tmp_path / 'other.txt', {'other.png': query_pose(0)})
    with pytest.raises(UsageError, match=r'other\.png'):
        read_query_set(
            scene_map.path, tmp_path / 'images', tmp_path / 'other.txt', format_camera(CAMERA)
        )


def in_folder(tmp_path: Path, *names: str) -> Path:
    for index, name in enumerate(names):
        miniature_datasets.write_frame(tmp_path / 'images' / name, index)
    return tmp_path / 'images'


def test_a_folder_has_one_camera_and_leaves_out_what_has_no_truth(
    scene_map: SceneMap, tmp_path: Path
) -> None:
    folder = in_folder(tmp_path, 'b/1.png', 'a.png', 'c.png')
    poses = {'b/1.png': query_pose(0), 'a.png': query_pose(1), 'other.png': query_pose(2)}
    write_poses(tmp_path / 'truth.txt', poses)

    found = read_query_set(
        scene_map.path, folder, tmp_path / 'truth.txt', format_camera(miniature_datasets.CAMERA)
    )

    assert found.names == ('a.png', 'b/1.png')
    assert found.images_without_truth == 1
    assert set(found.truth) == set(found.cameras) == set(found.names)
    assert same_poses(found.truth, {name: poses[name] for name in found.names})
    for name in found.names:
        assert read_query(found, name).shape == (288, 384, 3)


SEQUENCES = {
    Layout.CAMBRIDGE: miniature_datasets.write_cambridge,
    Layout.SEVEN_SCENES: miniature_datasets.write_seven_scenes,
    Layout.TUM: miniature_datasets.write_tum,
    Layout.EUROC: miniature_datasets.write_euroc,
    Layout.KITTI: miniature_datasets.write_kitti,
}
TEST_FRAMES = {
    Layout.CAMBRIDGE: [7],
    Layout.SEVEN_SCENES: [4, 5, 6, 7],
    Layout.TUM: [0, 1, 2, 3, 4, 5, 6],
    Layout.EUROC: list(range(8)),
    Layout.KITTI: list(range(8)),
}


@pytest.mark.parametrize('layout', Layout)
@pytest.mark.parametrize('every', [1, 3])
def test_queries_of_a_dataset_are_its_test_images_or_its_sequence(
    layout: Layout, every: int, scene_map: SceneMap, tmp_path: Path
) -> None:
    poses = list(SEQUENCES[layout](tmp_path / 'set').items())
    camera = format_camera(miniature_datasets.CAMERA)

    found = read_dataset_queries(scene_map.path, tmp_path / 'set', camera=camera, every=every)

    expected = dict(poses[frame] for frame in TEST_FRAMES[layout][::every])
    assert found.names == tuple(expected)
    assert same_poses(found.truth, expected)
    assert {format_camera(one) for one in found.cameras.values()} == {camera}
    assert all(read_query(found, name).size for name in found.names)


def test_images_of_a_dataset_without_a_pose_are_left_out_and_counted(
    scene_map: SceneMap, tmp_path: Path
) -> None:
    poses = miniature_datasets.write_tum(tmp_path / 'freiburg3_room')

    found = read_dataset_queries(scene_map.path, tmp_path / 'freiburg3_room')

    assert set(found.names) == set(poses)
    assert found.images_without_truth == 1
    assert {one.model_name for one in found.cameras.values()} == {'PINHOLE'}


@pytest.mark.parametrize('layout', [Layout.SEVEN_SCENES, Layout.TUM])
def test_where_a_dataset_has_no_calibration_the_camera_is_that_of_the_map(
    layout: Layout, scene_map: SceneMap, tmp_path: Path
) -> None:
    camera = format_camera(miniature_datasets.CAMERA)
    manifest, content = load_content(scene_map.path)
    known = replace(manifest, build={'report': {'cameras': [camera]}})
    save_map(tmp_path / 'known', content, known, None)
    SEQUENCES[layout](tmp_path / 'set')

    found = read_dataset_queries(tmp_path / 'known', tmp_path / 'set')

    assert {format_camera(one) for one in found.cameras.values()} == {camera}


def test_a_dataset_without_calibration_needs_one_somewhere(
    scene_map: SceneMap, tmp_path: Path
) -> None:
    miniature_datasets.write_seven_scenes(tmp_path)
    with pytest.raises(CameraError):
        read_dataset_queries(scene_map.path, tmp_path)


@pytest.mark.parametrize('every', [1, 2])
def test_a_list_has_its_own_cameras_and_no_truth(
    every: int, scene_map: SceneMap, tmp_path: Path
) -> None:
    listed = miniature_datasets.write_aachen(tmp_path)

    found = read_listed_queries(scene_map.path, listed.folder, listed.file, every=every)

    assert found.names == tuple(listed.poses)[::every]
    assert found.truth == {}
    assert found.images_without_truth == 0
    for name in found.names:
        camera = found.cameras[name]
        assert read_query(found, name).shape[:2] == (camera.height, camera.width)


def test_a_list_with_a_truth_has_queries_where_both_agree(
    scene_map: SceneMap, tmp_path: Path
) -> None:
    listed = miniature_datasets.write_aachen(tmp_path)
    by_night = {name: pose for name, pose in listed.poses.items() if 'night' in name}
    write_poses(tmp_path / 'truth.txt', by_night)

    found = read_listed_queries(scene_map.path, listed.folder, listed.file, tmp_path / 'truth.txt')

    assert same_poses(found.truth, by_night)
    assert found.images_without_truth == 3


def test_queries_that_are_not_on_disk_are_a_usage_error(
    scene_map: SceneMap, tmp_path: Path
) -> None:
    listed = miniature_datasets.write_aachen(tmp_path)
    missing = next(iter(listed.poses))
    (tmp_path / missing).unlink()

    with pytest.raises(UsageError, match=missing):
        read_listed_queries(scene_map.path, listed.folder, listed.file)


def test_a_folder_that_is_no_dataset_is_a_dataset_error(
    scene_map: SceneMap, tmp_path: Path
) -> None:
    with pytest.raises(DatasetError):
        read_dataset_queries(scene_map.path, tmp_path)


def test_an_image_of_another_size_is_refused_by_name(scene_map: SceneMap, tmp_path: Path) -> None:
    listed = miniature_datasets.write_aachen(tmp_path)
    found = read_listed_queries(scene_map.path, listed.folder, listed.file)
    first, *_, last = found.names

    with pytest.raises(CameraError, match=first):
        read_query(replace(found, cameras={first: found.cameras[last]}), first)
