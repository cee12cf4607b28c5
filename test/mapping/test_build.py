# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import shutil
from contextlib import ExitStack
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pycolmap
import pytest
from corner_room import CAMERA, CornerRoom, looking_into_the_corner
from full_disk import files_no_larger_than

from gam_relocalizer.cameras import parse_camera
from gam_relocalizer.errors import (
    CameraError,
    MapBuildError,
    MapError,
    PosesFileError,
    UsageError,
)
from gam_relocalizer.features import create_extractor
from gam_relocalizer.geometry import pose_error, rigid3d_from
from gam_relocalizer.image_set import ImageSet
from gam_relocalizer.mapping.build import MapBuildOptions, build_map
from gam_relocalizer.scene_map import load_map

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from conftest import BuiltMap, Room

    from gam_relocalizer.scene_map import SceneMap


def distance_to_walls(points: np.ndarray) -> np.ndarray:
    """The walls are the planes x = 0, y = 0 and z = 0."""
    return np.abs(points).min(axis=1)


def aligned_errors(
    scene_map: SceneMap, truth: Mapping[str, pycolmap.Rigid3d]
) -> tuple[np.ndarray, np.ndarray]:
    """Position and rotation errors after the best similarity between the camera centres."""
    centres = np.array([one.tgt_origin_in_src() for one in scene_map.camera_from_map])
    true_centres = np.array([truth[name].tgt_origin_in_src() for name in scene_map.image_names])
    room_from_map = pycolmap.estimate_sim3d(centres, true_centres)
    errors = [
        pose_error(room_from_map.transform_camera_world(camera_from_map), truth[name])
        for name, camera_from_map in zip(
            scene_map.image_names, scene_map.camera_from_map, strict=True
        )
    ]
    return np.array([e.position for e in errors]), np.array([e.rotation_deg for e in errors])


def test_points_lie_on_the_walls(posed_map: BuiltMap) -> None:
    points = load_map(posed_map.path).points

    assert len(points) > 300
    assert np.median(distance_to_walls(points)) < 0.02


def test_given_poses_are_kept(posed_map: BuiltMap, room: Room) -> None:
    scene_map = load_map(posed_map.path)

    assert set(scene_map.image_names) == set(room.poses)
    for name, camera_from_map in zip(scene_map.image_names, scene_map.camera_from_map, strict=True):
        error = pose_error(camera_from_map, room.poses[name])
        assert error.position < 1e-6
        assert error.rotation_deg < 1e-6


def test_rows_of_points_are_the_points_of_the_colmap_model_in_order_of_sight(
    posed_map: BuiltMap,
) -> None:
    scene_map = load_map(posed_map.path)
    model = pycolmap.Reconstruction(posed_map.path / 'sfm')

    assert sorted(model.point3D_ids()) == list(range(1, len(scene_map.points) + 1))
    np.testing.assert_allclose(
        scene_map.points,
        [model.point3D(row + 1).xyz for row in range(len(scene_map.points))],
        atol=1e-6,
    )
    first_seen = np.full(len(scene_map.points), scene_map.num_images)
    for image in reversed(range(scene_map.num_images)):
        first_seen[scene_map.points_seen_by(image)] = image
    assert (np.diff(first_seen) >= 0).all()


def test_poses_far_from_their_origin_give_the_same_accuracy(
    posed_map: BuiltMap, room: Room, tmp_path: Path
) -> None:
    utm_from_room = np.array([500_123.25, 4_000_987.5, 212.75])
    room_from_utm = pycolmap.Rigid3d(pycolmap.Rotation3d(), -utm_from_room)
    poses = {name: pose * room_from_utm for name, pose in room.poses.items()}
    images = ImageSet.of_folder(room.images, CAMERA, poses)

    build_map(images, tmp_path / 'map', MapBuildOptions(max_keypoints=600))

    near, far = load_map(posed_map.path), load_map(tmp_path / 'map')
    assert np.abs(far.manifest.frame.translation - utm_from_room).max() < 1000
    assert np.median(distance_to_walls(far.points - utm_from_room)) == pytest.approx(
        np.median(distance_to_walls(near.points)), rel=0.02
    )
    for name, camera_from_map in zip(far.image_names, far.camera_from_map, strict=True):
        error = pose_error(camera_from_map, poses[name])
        assert error.position < 1e-5
        assert error.rotation_deg < 1e-6


def test_poses_near_their_origin_keep_it(posed_map: BuiltMap) -> None:
    assert load_map(posed_map.path).manifest.frame.translation == (0, 0, 0)


def test_words_of_a_map_are_exact_in_half_precision(posed_map: BuiltMap) -> None:
    words = load_map(posed_map.path).codebook

    np.testing.assert_array_equal(words.astype(np.float16), words)


def test_recovers_the_poses_up_to_a_similarity(free_map: BuiltMap, room: Room) -> None:
    scene_map = load_map(free_map.path)

    position, rotation_deg = aligned_errors(scene_map, room.poses)

    assert len(position) == len(room.poses)
    assert position.max() < 0.03
    assert rotation_deg.max() < 1.0


def test_observations_are_where_the_points_project(posed_map: BuiltMap, room: Room) -> None:
    scene_map = load_map(posed_map.path)

    for image, camera_from_map in enumerate(scene_map.camera_from_map):
        seen = scene_map.points[scene_map.points_seen_by(image)]
        pixels = CAMERA.img_from_cam(camera_from_map * seen)
        assert ((pixels > -4) & (pixels < [CAMERA.width + 4, CAMERA.height + 4])).all()
    assert scene_map.manifest.build['images'] == room.images.name


def test_descriptors_recognise_their_points(posed_map: BuiltMap, room: Room) -> None:
    scene_map = load_map(posed_map.path)
    image = cv2.imread(str(room.images / scene_map.image_names[3]))
    features = create_extractor('xfeat', 600).extract(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
    seen = scene_map.points_seen_by(3)
    descriptors = scene_map.descriptors_of(seen)

    pixels = CAMERA.img_from_cam(scene_map.camera_from_map[3] * scene_map.points[seen])
    best = (descriptors @ features.descriptors.T).argmax(axis=1)
    distances = np.linalg.norm(features.keypoints[best] - pixels, axis=1)

    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), 1.0, atol=2e-3)
    assert np.mean(distances < 4.0) > 0.9


def test_report_agrees_with_the_map(posed_map: BuiltMap) -> None:
    report, scene_map = posed_map.report, load_map(posed_map.path)

    assert report.images_given == report.images_registered == scene_map.num_images
    assert report.points == len(scene_map.points)
    assert report.observations == scene_map.manifest.counts['observations']
    assert report.mean_track_length == pytest.approx(report.observations / report.points)
    assert 0 < report.mean_reprojection_error < 1.5
    assert scene_map.manifest.build['report']['points'] == report.points


def test_frame_of_given_poses_is_metric_and_that_of_sfm_is_not(
    posed_map: BuiltMap, free_map: BuiltMap
) -> None:
    assert load_map(posed_map.path).manifest.frame.metric
    assert not load_map(free_map.path).manifest.frame.metric


@pytest.mark.parametrize('with_poses', [True, False])
def test_same_images_same_map(
    room: Room, posed_map: BuiltMap, free_map: BuiltMap, tmp_path: Path, *, with_poses: bool
) -> None:
    first = posed_map if with_poses else free_map
    poses = room.poses if with_poses else None
    images = ImageSet.of_folder(room.images, CAMERA, poses)

    build_map(images, tmp_path / 'again', MapBuildOptions(max_keypoints=600))

    assert (tmp_path / 'again' / 'points.npy').read_bytes() == (
        first.path / 'points.npy'
    ).read_bytes()
    assert load_map(tmp_path / 'again').manifest.map_id == load_map(first.path).manifest.map_id


def test_finds_the_focal_length_without_a_camera(room: Room, tmp_path: Path) -> None:
    report = build_map(
        ImageSet.of_folder(room.images), tmp_path / 'map', MapBuildOptions(max_keypoints=600)
    )

    (camera,) = report.cameras
    assert parse_camera(camera).mean_focal_length() == pytest.approx(340.0, rel=0.03)


def test_refines_a_wrong_focal_length_with_given_poses(room: Room, tmp_path: Path) -> None:
    wrong = parse_camera('SIMPLE_PINHOLE 384 288 360 192 144')
    images = ImageSet.of_folder(room.images, wrong, room.poses)
    options = MapBuildOptions(refine_camera=True, max_keypoints=600)

    report = build_map(images, tmp_path / 'map', options)

    assert parse_camera(report.cameras[0]).mean_focal_length() == pytest.approx(340.0, rel=0.01)


def test_global_mapper_recovers_the_poses(room: Room, tmp_path: Path) -> None:
    options = MapBuildOptions(mapper='global', max_keypoints=600)

    build_map(ImageSet.of_folder(room.images, CAMERA), tmp_path / 'map', options)

    position, _ = aligned_errors(load_map(tmp_path / 'map'), room.poses)
    assert len(position) == len(room.poses)
    assert position.max() < 0.03


def test_sift_makes_a_map(room: Room, tmp_path: Path) -> None:
    images = ImageSet.of_folder(room.images, CAMERA, room.poses)
    options = MapBuildOptions(extractor='sift', max_keypoints=600)

    build_map(images, tmp_path / 'map', options)

    scene_map = load_map(tmp_path / 'map')
    assert scene_map.manifest.extractor.name == 'sift'
    assert np.median(distance_to_walls(scene_map.points)) < 0.01


def test_names_what_was_left_out_and_why(room: Room, tmp_path: Path) -> None:
    images = tmp_path / 'images'
    shutil.copytree(room.images, images)
    (images / 'broken.jpg').write_bytes(b'no image')
    (images / 'no pose.png').write_bytes((images / 'view 00.png').read_bytes())
    cv2.imwrite(str(images / 'black.png'), np.zeros((288, 384), dtype=np.uint8))
    poses = {**room.poses, 'broken.jpg': room.poses['view 00.png']}
    poses['black.png'] = poses['elsewhere.png'] = room.poses['view 01.png']

    report = build_map(
        ImageSet.of_folder(images, CAMERA, poses),
        tmp_path / 'map',
        MapBuildOptions(max_keypoints=600),
    )

    assert list(report.unreadable) == ['broken.jpg']
    assert report.without_pose == ('no pose.png',)
    assert report.unregistered == ('black.png',)
    assert (report.images_registered, report.images_given) == (8, 11)


def test_the_folder_of_images_is_only_read(room: Room, tmp_path: Path) -> None:
    images = tmp_path / 'images'
    shutil.copytree(room.images, images)
    images.chmod(0o555)
    before = {path: path.stat().st_mtime_ns for path in (images, *images.iterdir())}

    build_map(
        ImageSet.of_folder(images, CAMERA),
        tmp_path / 'map',
        MapBuildOptions(max_keypoints=300),
    )

    assert {path: path.stat().st_mtime_ns for path in (images, *images.iterdir())} == before
    images.chmod(0o755)


def test_leaves_nothing_behind_but_the_map(
    room: Room, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / 'temporary').mkdir()
    monkeypatch.setattr('tempfile.tempdir', str(tmp_path / 'temporary'))
    images = ImageSet.of_folder(room.images, CAMERA, room.poses)

    build_map(images, tmp_path / 'map', MapBuildOptions(max_keypoints=300))

    assert sorted(path.name for path in tmp_path.iterdir()) == ['map', 'temporary']
    assert list((tmp_path / 'temporary').iterdir()) == []


def test_what_is_no_image_is_named_and_left_out(room: Room, tmp_path: Path) -> None:
    images = tmp_path / 'images'
    shutil.copytree(room.images, images)
    (images / 'empty.jpg').touch()
    (images / 'text.png').write_text('no image')
    with (images / 'huge.bmp').open('wb') as file:
        file.truncate(2**40)  # takes no space
    image_set = ImageSet.of_folder(images, CAMERA)
    (images / 'view 00.png').unlink()

    report = build_map(image_set, tmp_path / 'map', MapBuildOptions(max_keypoints=300))

    assert sorted(report.unreadable) == ['empty.jpg', 'huge.bmp', 'text.png', 'view 00.png']
    assert all(name in reason for name, reason in report.unreadable.items())
    assert report.images_registered == 7


def test_a_full_disk_leaves_the_old_map(room: Room, posed_map: BuiltMap, tmp_path: Path) -> None:
    shutil.copytree(posed_map.path, tmp_path / 'map')
    images = ImageSet.of_folder(room.images, CAMERA, room.poses)

    def fill_disk(step: str, *_: int) -> None:
        if step == 'save':
            disk.enter_context(files_no_larger_than(10_000))

    with ExitStack() as disk, pytest.raises(MapError, match='cannot be written'):
        build_map(images, tmp_path / 'map', MapBuildOptions(max_keypoints=300), fill_disk)

    assert load_map(tmp_path / 'map').manifest.map_id == load_map(posed_map.path).manifest.map_id
    assert [path.name for path in tmp_path.iterdir()] == ['map']


def write_noise(folder: Path, count: int) -> None:
    folder.mkdir()
    for index in range(count):
        noise = np.random.default_rng(index).integers(0, 256, (96, 128, 3), dtype=np.uint8)
        cv2.imwrite(str(folder / f'{index}.png'), noise)


def test_unrelated_images_are_refused(tmp_path: Path) -> None:
    (tmp_path / 'images').mkdir()
    for seed in range(5):
        image = CornerRoom(seed).render(looking_into_the_corner(0.2 * seed))
        cv2.imwrite(str(tmp_path / 'images' / f'{seed}.png'), image)

    with pytest.raises(MapBuildError, match='10 image pairs'):
        build_map(ImageSet.of_folder(tmp_path / 'images'), tmp_path / 'map')
    assert not (tmp_path / 'map').exists()


@pytest.mark.parametrize('count', [1, 2])
def test_too_few_images_are_refused(tmp_path: Path, count: int) -> None:
    write_noise(tmp_path / 'images', count)

    with pytest.raises(MapBuildError, match='at least 3'):
        build_map(ImageSet.of_folder(tmp_path / 'images'), tmp_path / 'map')


def test_poses_in_the_wrong_convention_are_refused(room: Room, tmp_path: Path) -> None:
    inverted = {name: pose.inverse() for name, pose in room.poses.items()}
    images = ImageSet.of_folder(room.images, CAMERA, inverted)

    with pytest.raises(MapBuildError, match='camera_from_world'):
        build_map(images, tmp_path / 'map', MapBuildOptions(max_keypoints=600))


def test_poses_of_other_images_are_refused_before_any_work(room: Room, tmp_path: Path) -> None:
    poses = {'other.png': rigid3d_from([1, 0, 0, 0], [0, 0, 0])}

    with pytest.raises(PosesFileError, match=r'other\.png.*view 00\.png'):
        build_map(ImageSet.of_folder(room.images, CAMERA, poses), tmp_path / 'map')


def test_camera_of_another_size_is_refused(room: Room, tmp_path: Path) -> None:
    camera = parse_camera('SIMPLE_PINHOLE 640 480 500 320 240')

    with pytest.raises(CameraError, match='384 x 288'):
        build_map(ImageSet.of_folder(room.images, camera), tmp_path / 'map')


def test_output_that_is_no_map_is_refused_before_any_work(room: Room, tmp_path: Path) -> None:
    (tmp_path / 'photos').mkdir()
    steps: list[str] = []

    with pytest.raises(MapError):
        build_map(
            ImageSet.of_folder(room.images),
            tmp_path / 'photos',
            MapBuildOptions(),
            lambda step, done, total: steps.append(f'{step} {done} {total}'),
        )
    assert steps == []


def test_output_among_the_images_is_refused(room: Room, tmp_path: Path) -> None:
    shutil.copytree(room.images, tmp_path / 'images')

    with pytest.raises(UsageError, match='outside'):
        build_map(ImageSet.of_folder(tmp_path / 'images'), tmp_path / 'images' / 'map')
    assert not (tmp_path / 'images' / 'map').exists()


def test_output_below_a_file_is_refused(room: Room, tmp_path: Path) -> None:
    (tmp_path / 'file').touch()

    with pytest.raises(MapError):
        build_map(ImageSet.of_folder(room.images), tmp_path / 'file' / 'map')


@pytest.mark.parametrize(
    'options',
    [
        MapBuildOptions(mapper='magic'),
        MapBuildOptions(extractor='magic'),
        MapBuildOptions(descriptor_bits=7),
    ],
)
def test_unknown_options_are_refused(room: Room, tmp_path: Path, options: MapBuildOptions) -> None:
    with pytest.raises(UsageError, match=r'magic|7 bits'):
        build_map(ImageSet.of_folder(room.images), tmp_path / 'map', options)


def test_folder_without_images_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError):
        ImageSet.of_folder(tmp_path)


@pytest.mark.parametrize('name', [b'#1.png', b'two\nlines.png', b'latin-\xe9.png'])
def test_names_that_a_poses_file_cannot_hold_are_refused(tmp_path: Path, name: bytes) -> None:
    (tmp_path / 'images').mkdir()
    (tmp_path / 'images' / os.fsdecode(name)).touch()

    with pytest.raises(UsageError, match='rename'):
        build_map(ImageSet.of_folder(tmp_path / 'images'), tmp_path / 'map')


def test_progress_reaches_the_end_of_every_step(room: Room, tmp_path: Path) -> None:
    last: dict[str, tuple[int, int]] = {}

    def remember(step: str, done: int, total: int) -> None:
        last[step] = (done, total)

    images = ImageSet.of_folder(room.images, CAMERA, room.poses)
    options = MapBuildOptions(max_keypoints=300)
    build_map(images, tmp_path / 'map', options, remember)

    assert list(last) == ['extract', 'match', 'verify', 'sfm', 'save']
    assert all(done == total for done, total in last.values())


def test_colmap_keeps_quiet(room: Room, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    images = ImageSet.of_folder(room.images, CAMERA, room.poses)
    options = MapBuildOptions(max_keypoints=300)

    build_map(images, tmp_path / 'map', options)

    assert capfd.readouterr() == ('', '')
