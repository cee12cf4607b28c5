# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import shutil
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
import yaml

from gam_relocalizer.geometry import rigid3d_from
from gam_relocalizer.mapping.check import NO_MODEL, NOT_LOCALIZED, check_map
from gam_relocalizer.scene_map import (
    MANIFEST,
    SFM,
    ExtractorIdentity,
    Manifest,
    MapContent,
    MapFrame,
    load_content,
    load_map,
    save_frame,
    save_map,
    sha256_of,
)

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from conftest import BuiltMap

MANIFEST_TO_BE = Manifest(ExtractorIdentity('xfeat', 4, ''), 'vlad', MapFrame(metric=True), {})


def truncate(path: Path, name: str) -> None:
    """Cuts a file of a map short, and lets the manifest say that it is to be so."""
    file = path / name
    file.write_bytes(file.read_bytes()[:-7])
    manifest = yaml.safe_load((path / MANIFEST).read_text())
    manifest['files'][name] = {'size': file.stat().st_size, 'sha256': sha256_of(file)}
    (path / MANIFEST).write_text(yaml.safe_dump(manifest))


def content_seeing(seen: list[range]) -> MapContent:
    """Images that see the given ranges of 200 points."""
    return MapContent(
        image_names=tuple(f'{index}.jpg' for index in range(len(seen))),
        camera_from_sfm=(rigid3d_from([1, 0, 0, 0], [0, 0, 0]),) * len(seen),
        points=np.zeros((200, 3)),
        descriptors=np.ones((200, 4)),
        observation_offsets=np.cumsum([0, *map(len, seen)], dtype=np.int64),
        observation_points=np.array([point for one in seen for point in one], dtype=np.int32),
        global_descriptors=np.ones((len(seen), 4), dtype=np.float32),
        codebook=np.ones((1, 4), dtype=np.float32),
    )


def test_a_good_map_is_sound(posed_map: BuiltMap) -> None:
    report = check_map(posed_map.path)

    assert report.problems == report.warnings == report.weak_bridges == ()
    assert report.components == (8,)
    assert report.counts == load_map(posed_map.path).manifest.counts


@pytest.mark.parametrize('name', ['points.npy', 'sfm/points3D.bin', 'manifest.yaml'])
def test_a_damaged_file_is_a_problem(posed_map: BuiltMap, tmp_path: Path, name: str) -> None:
    damaged = tmp_path / 'map'
    shutil.copytree(posed_map.path, damaged)
    (damaged / name).write_bytes((damaged / name).read_bytes()[:-7])

    (problem,) = check_map(damaged).problems

    assert name in problem


@pytest.mark.parametrize('name', ['images.bin', 'points3D.bin', 'cameras.bin'])
def test_a_truncated_model_that_the_manifest_vouches_for_is_a_problem(
    posed_map: BuiltMap, tmp_path: Path, name: str
) -> None:
    shutil.copytree(posed_map.path, tmp_path / 'map')
    truncate(tmp_path / 'map', f'{SFM}/{name}')

    (problem,) = check_map(tmp_path / 'map').problems

    assert name in problem


def test_a_missing_map_is_a_problem(tmp_path: Path) -> None:
    assert len(check_map(tmp_path / 'nowhere').problems) == 1


def test_a_strange_file_is_a_warning(posed_map: BuiltMap, tmp_path: Path) -> None:
    copy = tmp_path / 'map'
    shutil.copytree(posed_map.path, copy)
    (copy / 'notes.txt').touch()

    report = check_map(copy)

    assert report.problems == ()
    assert len(report.warnings) == 1
    assert 'notes.txt' in report.warnings[0]


def test_parts_that_share_nothing_are_a_problem(tmp_path: Path) -> None:
    seen = [range(100), range(60), range(100, 200)]
    save_map(tmp_path / 'map', content_seeing(seen), MANIFEST_TO_BE, None)

    report = check_map(tmp_path / 'map')

    assert report.components == (2, 1)
    assert len(report.problems) == 1


def test_parts_that_given_poses_hold_together_are_no_problem(tmp_path: Path) -> None:
    seen = [range(100), range(60), range(100, 200)]
    posed = replace(MANIFEST_TO_BE, build={'options': {'poses': 3}})
    save_map(tmp_path / 'map', content_seeing(seen), posed, None)

    report = check_map(tmp_path / 'map')

    assert report.components == (2, 1)
    assert report.problems == ()
    assert report.warnings


def test_a_weak_bridge_is_found(tmp_path: Path) -> None:
    seen = [range(100), range(95), range(90, 200), range(95, 200)]
    save_map(tmp_path / 'map', content_seeing(seen), MANIFEST_TO_BE, None)

    report = check_map(tmp_path / 'map')

    assert report.problems == ()
    (bridge,) = report.weak_bridges
    assert (bridge.first, bridge.second, bridge.shared_points) == ('0.jpg', '2.jpg', 10)


def test_counts_points_per_image(tmp_path: Path) -> None:
    seen = [range(100), range(60), range(200)]
    save_map(tmp_path / 'map', content_seeing(seen), MANIFEST_TO_BE, None)

    assert check_map(tmp_path / 'map').points_per_image == (60, 100, 200)


def test_an_unscaled_map_is_a_warning(tmp_path: Path) -> None:
    unscaled = replace(MANIFEST_TO_BE, frame=MapFrame())
    save_map(tmp_path / 'map', content_seeing([range(200)] * 2), unscaled, None)

    assert any('metric' in warning for warning in check_map(tmp_path / 'map').warnings)


def test_an_empty_map_is_a_problem(tmp_path: Path) -> None:
    empty = replace(content_seeing([]), observation_points=np.zeros(0, dtype=np.int32))
    save_map(tmp_path / 'map', empty, MANIFEST_TO_BE, None)

    assert len(check_map(tmp_path / 'map').problems) == 1


def saved_otherwise(
    posed_map: BuiltMap, path: Path, change: Callable[[MapContent], MapContent]
) -> Path:
    """The map with other arrays beside the same COLMAP model, and sums that fit."""
    manifest, content = load_content(posed_map.path)
    save_map(path, change(content), manifest, pycolmap.Reconstruction(posed_map.path / SFM))
    return path


def with_a_point_moved(content: MapContent) -> MapContent:
    points = content.points.copy()
    points[17] += [0.0, 0.0, 1e-3]
    return replace(content, points=points)


def with_two_points_exchanged(content: MapContent) -> MapContent:
    points = content.points.copy()
    points[[3, 400]] = points[[400, 3]]
    return replace(content, points=points)


def with_an_image_moved(content: MapContent) -> MapContent:
    poses = list(content.camera_from_sfm)
    poses[5] = rigid3d_from([1, 0, 0, 0], [1e-3, 0, 0]) * poses[5]
    return replace(content, camera_from_sfm=tuple(poses))


def with_an_image_turned(content: MapContent) -> MapContent:
    poses = list(content.camera_from_sfm)
    turned = rigid3d_from([1, 0, 0, 1e-4], [0, 0, 0]) * poses[5]
    poses[5] = turned
    return replace(content, camera_from_sfm=tuple(poses))


def with_an_observation_less(content: MapContent) -> MapContent:
    offsets = content.observation_offsets.copy()
    offsets[6:] -= 1
    return replace(
        content,
        observation_offsets=offsets,
        observation_points=np.delete(content.observation_points, content.observation_offsets[5]),
    )


def with_an_image_renamed(content: MapContent) -> MapContent:
    names = list(content.image_names)
    names[5] = 'another.png'
    return replace(content, image_names=tuple(names))


def test_a_bundle_written_again_is_consistent(posed_map: BuiltMap, tmp_path: Path) -> None:
    assert check_map(saved_otherwise(posed_map, tmp_path / 'map', lambda same: same)).problems == ()


@pytest.mark.parametrize('scale', [1e-3, 1.0, 250.0])
def test_a_bundle_in_another_frame_is_consistent(
    posed_map: BuiltMap, tmp_path: Path, scale: float
) -> None:
    path = saved_otherwise(posed_map, tmp_path / 'map', lambda same: same)
    frame = MapFrame(scale, (0.8, 0.0, 0.6, 0.0), (4e6, -5e5, 30.0), metric=True, source='survey')
    save_frame(path, frame, {'method': 'survey'})

    assert check_map(path).problems == ()


@pytest.mark.parametrize(
    ('change', 'named'),
    [
        (with_a_point_moved, 'row 17'),
        (with_two_points_exchanged, '2 of'),
        (with_an_image_moved, 'view 05.png'),
        (with_an_image_turned, 'view 05.png'),
        (with_an_observation_less, 'view 05.png'),
        (with_an_image_renamed, 'another.png'),
    ],
)
def test_arrays_that_are_not_of_the_model_are_a_problem(
    posed_map: BuiltMap,
    tmp_path: Path,
    change: Callable[[MapContent], MapContent],
    named: str,
) -> None:
    path = saved_otherwise(posed_map, tmp_path / 'map', change)

    (problem,) = check_map(path).problems

    assert named in problem


def test_a_wrong_covisibility_is_a_problem(posed_map: BuiltMap, tmp_path: Path) -> None:
    path = saved_otherwise(posed_map, tmp_path / 'map', lambda same: same)
    counts = np.load(path / 'covisibility_counts.npy')
    counts[0] += 1
    np.save(path / 'covisibility_counts.npy', counts)
    manifest = yaml.safe_load((path / MANIFEST).read_text())
    entry = manifest['files']['covisibility_counts.npy']
    entry['sha256'] = sha256_of(path / 'covisibility_counts.npy')
    (path / MANIFEST).write_text(yaml.safe_dump(manifest))

    (problem,) = check_map(path).problems

    assert 'covisibility' in problem


def test_points_that_look_like_nothing_are_a_problem(posed_map: BuiltMap, tmp_path: Path) -> None:
    def blank(content: MapContent) -> MapContent:
        descriptors = np.array(content.descriptors)
        descriptors[:5] = 0.0
        return replace(content, descriptors=descriptors)

    (problem,) = check_map(saved_otherwise(posed_map, tmp_path / 'map', blank)).problems

    assert '5 of' in problem


def test_points_that_nobody_sees_are_a_warning(tmp_path: Path) -> None:
    save_map(tmp_path / 'map', content_seeing([range(150)] * 2), MANIFEST_TO_BE, None)

    report = check_map(tmp_path / 'map')

    assert report.problems == ()
    assert any('50 of 200' in warning for warning in report.warnings)


def test_a_map_that_lies_on_its_side_is_a_warning(posed_map: BuiltMap, tmp_path: Path) -> None:
    path = saved_otherwise(posed_map, tmp_path / 'map', lambda same: same)
    upright = check_map(path).warnings
    save_frame(path, MapFrame(1.0, (0.8, 0.6, 0.0, 0.0), metric=True), {})

    assert upright == ()
    (warning,) = check_map(path).warnings
    assert 'upright' in warning


@pytest.mark.parametrize(
    ('alignment', 'warnings'),
    [
        ({}, 0),
        ({'method': 'distances', 'scale_sigma': 0.01, 'warnings': []}, 0),
        ({'scale_sigma': 0.1}, 1),
        ({'scale_sigma': 0.1, 'warnings': ['the cameras lie on a line']}, 2),
        ({'scale_sigma': 'much', 'warnings': {'a': 1}}, 0),
        ({'scale_sigma': float('nan'), 'warnings': [1, [2]]}, 0),
    ],
)
def test_what_the_alignment_says_of_itself_is_passed_on(
    posed_map: BuiltMap, tmp_path: Path, alignment: dict[str, object], warnings: int
) -> None:
    path = saved_otherwise(posed_map, tmp_path / 'map', lambda same: same)
    save_frame(path, MapFrame(metric=True), alignment)

    assert len(check_map(path).warnings) == warnings


@pytest.mark.parametrize(
    ('build', 'warnings'),
    [
        ({'report': {'warnings': ['camera 1: folded']}}, ['build: camera 1: folded']),
        ({'report': {'warnings': []}, 'changes': []}, []),
        (
            {'changes': [{'what': 'merge'}, {'warnings': ['camera 2: odd']}]},
            ['change: camera 2: odd'],
        ),
        ({'report': {'warnings': ['\x1b[2J' + 'a' * 1000]}}, ['build: ?[2J' + 'a' * 193 + '...']),
        ({'report': {'warnings': 'all'}, 'changes': {'warnings': ['a']}}, []),
        ({'report': ['warnings'], 'changes': [1, ['warnings'], {'warnings': {'a': 1}}]}, []),
        ({'report': {'warnings': [1, None, ['a']]}}, []),
    ],
)
def test_what_the_build_warned_of_is_repeated(
    posed_map: BuiltMap, tmp_path: Path, build: dict[str, object], warnings: list[str]
) -> None:
    manifest, content = load_content(posed_map.path)
    save_map(tmp_path / 'map', content, replace(manifest, build=build), None)

    found = check_map(tmp_path / 'map').warnings

    assert [one for one in found if one.startswith(('build: ', 'change: '))] == warnings


def test_says_what_was_not_checked(posed_map: BuiltMap, tmp_path: Path) -> None:
    manifest, content = load_content(posed_map.path)
    save_map(tmp_path / 'bare', content, manifest, None)

    assert check_map(posed_map.path).not_checked == (NOT_LOCALIZED,)
    assert check_map(tmp_path / 'bare').not_checked == (NOT_LOCALIZED, NO_MODEL)


def test_bytes_per_point_are_those_of_the_files(posed_map: BuiltMap) -> None:
    per_point = check_map(posed_map.path).bytes_per_point

    points = load_map(posed_map.path).num_points
    files = [file for file in posed_map.path.rglob('*') if file.is_file()]
    size = sum(file.stat().st_size for file in files if file.name != MANIFEST)
    model = sum(file.stat().st_size for file in (posed_map.path / SFM).iterdir())
    assert per_point['sfm'] == pytest.approx(model / points)
    assert per_point['run time'] == pytest.approx((size - model) / points)
