# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pycolmap
import pytest
from corner_room import CAMERA, CornerRoom, looking_into_the_corner, write_room_images
from scipy.spatial.transform import Rotation

from gam_relocalizer.errors import MapBuildError, MapError, UsageError
from gam_relocalizer.geometry import pose_error, rigid3d_from_rotation
from gam_relocalizer.image_set import ImageSet
from gam_relocalizer.mapping.build import MapBuildOptions, build_map
from gam_relocalizer.mapping.merge import MergeReport, merge_maps
from gam_relocalizer.scene_map import load_content, load_map, save_frame, save_map

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

FIRST, SECOND = slice(0, 6), slice(4, 10)
OPTIONS = MapBuildOptions(max_keypoints=600)


@dataclass(frozen=True)
class Merged:
    """Two maps of the room, both with the images in its middle, and what came of them.

    The first lies in the frame of the room, the second has origin, orientation and scale of its
    own.
    """

    first: Path
    second: Path
    path: Path
    report: MergeReport
    truth: Mapping[str, pycolmap.Rigid3d]


@pytest.fixture(scope='module')
def merged(tmp_path_factory: pytest.TempPathFactory) -> Merged:
    folder = tmp_path_factory.mktemp('merge')
    truth = write_room_images(folder / 'images', count=10)
    names = sorted(truth)

    def some(chosen: slice) -> ImageSet:
        return ImageSet(folder / 'images', tuple(names[chosen]), dict.fromkeys(names, CAMERA))

    first = replace(some(FIRST), camera_from_world=truth)
    build_map(first, folder / 'first', OPTIONS)
    build_map(some(SECOND), folder / 'second', OPTIONS)
    report = merge_maps(folder / 'first', folder / 'second', folder / 'merged', prefix='second/')
    return Merged(folder / 'first', folder / 'second', folder / 'merged', report, truth)


def test_images_and_frame_of_the_first_map_stay(merged: Merged) -> None:
    before, after = load_map(merged.first), load_map(merged.path)

    assert after.image_names[: before.num_images] == before.image_names
    for old, new in zip(before.camera_from_map, after.camera_from_map, strict=False):
        np.testing.assert_allclose(new.matrix(), old.matrix(), atol=1e-6)
    assert after.manifest.frame == before.manifest.frame


def test_images_of_the_second_map_come_to_where_they_were_taken(merged: Merged) -> None:
    after = load_map(merged.path)
    moved = {
        name.removeprefix('second/'): pose
        for name, pose in zip(after.image_names, after.camera_from_map, strict=True)
        if name.startswith('second/')
    }

    assert len(moved) == 6
    for name, camera_from_map in moved.items():
        error = pose_error(camera_from_map, merged.truth[name])
        assert error.position < 0.03
        assert error.rotation_deg < 0.5


def test_points_lie_on_the_walls_and_are_seen_by_images_of_both_maps(merged: Merged) -> None:
    after = load_map(merged.path)
    num_first = load_map(merged.first).num_images
    seen = [
        np.concatenate([after.points_seen_by(i) for i in part])
        for part in (range(num_first), range(num_first, after.num_images))
    ]

    assert np.median(np.abs(after.points).min(axis=1)) < 0.02
    assert len(np.intersect1d(*seen)) > 200
    assert len(after.points) < len(load_map(merged.first).points) + len(
        load_map(merged.second).points
    )


def test_report_and_history_tell_how_the_maps_fit(merged: Merged) -> None:
    report, after = merged.report, load_map(merged.path)
    (change,) = after.manifest.build['changes']

    assert report.images == (6, 6)
    assert 200 < report.points_joined <= report.points_matched
    assert report.median_distance < 0.1
    assert report.points == len(after.points)
    assert report.warnings == ()
    assert (change['what'], change['map'], change['images']) == ('merge', 'second', 6)
    assert change['map_id'] == load_map(merged.second).manifest.map_id


def test_scale_relates_the_units_of_the_maps(merged: Merged) -> None:
    room = load_map(merged.first).camera_positions
    own = load_map(merged.second).camera_positions
    shared = np.linalg.norm(room[5] - room[4]) / np.linalg.norm(own[1] - own[0])

    assert merged.report.scale == pytest.approx(shared, rel=0.05)


def test_same_maps_same_result(merged: Merged, tmp_path: Path) -> None:
    merge_maps(merged.first, merged.second, tmp_path / 'again', prefix='second/')

    again = load_map(tmp_path / 'again').manifest
    assert again.map_id == load_map(merged.path).manifest.map_id


def test_metric_maps_of_different_scale_are_merged_with_a_warning(
    merged: Merged, tmp_path: Path
) -> None:
    second = tmp_path / 'second'
    shutil.copytree(merged.second, second)
    frame = load_map(second).manifest.frame
    save_frame(second, replace(frame, metric=True), {})

    report = merge_maps(merged.first, second, tmp_path / 'merged', prefix='second/')

    assert len(report.warnings) == 1


def test_frame_of_the_second_map_does_not_matter(merged: Merged, tmp_path: Path) -> None:
    second = tmp_path / 'second'
    shutil.copytree(merged.second, second)
    rotation = rigid3d_from_rotation(Rotation.from_euler('z', 70, degrees=True), [4.0, 5.0, 6.0])
    w, x, y, z = np.roll(rotation.rotation.quat, 1).tolist()
    frame = replace(
        load_map(second).manifest.frame,
        scale=3.0,
        rotation_wxyz=(w, x, y, z),
        translation=(4.0, 5.0, 6.0),
    )
    save_frame(second, frame, {})

    report = merge_maps(merged.first, second, tmp_path / 'merged', prefix='second/')

    expected, found = load_map(merged.path), load_map(tmp_path / 'merged')
    np.testing.assert_allclose(found.camera_positions, expected.camera_positions, atol=1e-6)
    assert report.scale == pytest.approx(merged.report.scale / 3.0)


def test_maps_of_different_places_are_refused(merged: Merged, tmp_path: Path) -> None:
    room = CornerRoom(seed=5)
    (tmp_path / 'images').mkdir()
    for index in range(4):
        image = room.render(looking_into_the_corner(index / 3))
        cv2.imwrite(str(tmp_path / 'images' / f'other {index}.png'), image)
    build_map(ImageSet.of_folder(tmp_path / 'images', CAMERA), tmp_path / 'other', OPTIONS)

    with pytest.raises(MapBuildError, match='does not fit'):
        merge_maps(merged.first, tmp_path / 'other', tmp_path / 'merged')
    assert not (tmp_path / 'merged').exists()


def test_a_map_whose_points_are_in_the_wrong_places_is_refused(
    merged: Merged, tmp_path: Path
) -> None:
    model = pycolmap.Reconstruction(merged.second / 'sfm')
    rng = np.random.default_rng(0)
    for point in model.points3D.values():
        point.xyz = point.xyz + rng.normal(0, 1.0, 3)
    manifest, content = load_content(merged.second)
    save_map(tmp_path / 'bent', content, manifest, model)

    with pytest.raises(MapBuildError, match='does not fit'):
        merge_maps(merged.first, tmp_path / 'bent', tmp_path / 'merged', prefix='second/')


def test_images_of_the_same_name_are_refused(merged: Merged, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match='--prefix'):
        merge_maps(merged.first, merged.second, tmp_path / 'merged')


def test_maps_of_different_extractors_are_refused(merged: Merged, tmp_path: Path) -> None:
    manifest, content = load_content(merged.second)
    extractor = replace(manifest.extractor, name='sift')
    model = pycolmap.Reconstruction(merged.second / 'sfm')
    save_map(tmp_path / 'sift', content, replace(manifest, extractor=extractor), model)

    with pytest.raises(MapError, match='sift'):
        merge_maps(merged.first, tmp_path / 'sift', tmp_path / 'merged', prefix='second/')


def test_a_map_without_its_colmap_model_is_refused(merged: Merged, tmp_path: Path) -> None:
    manifest, content = load_content(merged.second)
    save_map(tmp_path / 'bare', content, manifest, None)

    with pytest.raises(MapError, match='sfm'):
        merge_maps(merged.first, tmp_path / 'bare', tmp_path / 'merged', prefix='second/')
