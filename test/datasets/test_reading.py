# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from miniature_datasets import (
    COUNT,
    EUROC_NS_APART,
    FIRST_NS,
    FOCAL,
    pose,
    same_poses,
    write_cambridge,
    write_euroc,
    write_kitti,
    write_seven_scenes,
    write_tum,
)

from gam_relocalizer.cameras import format_camera
from gam_relocalizer.datasets.layout import Layout, Split, detect_layout
from gam_relocalizer.datasets.reading import read_dataset
from gam_relocalizer.errors import DatasetError, UsageError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from gam_relocalizer.image_set import ImageSet

WRITERS = {
    Layout.CAMBRIDGE: write_cambridge,
    Layout.SEVEN_SCENES: write_seven_scenes,
    Layout.TUM: write_tum,
    Layout.EUROC: write_euroc,
    Layout.KITTI: write_kitti,
}


def the_camera(images: ImageSet) -> str:
    lines = {format_camera(camera) for camera in images.cameras.values()}
    assert set(images.cameras) == set(images.names)
    assert len(lines) == 1
    return lines.pop()


def replace_line(file: Path, number: int, text: str) -> str:
    """Changes a line, counted from 1; returns how errors name it."""
    lines = file.read_text().splitlines()
    lines[number - 1] = text
    file.write_text('\n'.join(lines) + '\n')
    return f'{file.name}:{number}'


def replace_word(file: Path, number: int, column: int, word: str, separator: str = ' ') -> str:
    words = file.read_text().splitlines()[number - 1].split(separator)
    words[column] = word
    return replace_line(file, number, separator.join(words))


@pytest.mark.parametrize('layout', Layout)
def test_the_layout_is_found_by_its_files(layout: Layout, tmp_path: Path) -> None:
    WRITERS[layout](tmp_path)

    assert detect_layout(tmp_path) is layout


@pytest.mark.parametrize('layout', [Layout.TUM, Layout.EUROC, Layout.KITTI])
def test_layouts_of_one_sequence_have_no_test_images(layout: Layout, tmp_path: Path) -> None:
    WRITERS[layout](tmp_path)

    with pytest.raises(UsageError):
        read_dataset(tmp_path, layout, Split.TEST)


@pytest.mark.parametrize('layout', Layout)
def test_the_folder_is_only_read(layout: Layout, tmp_path: Path) -> None:
    WRITERS[layout](tmp_path)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob('*')}

    read_dataset(tmp_path)

    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob('*')} == before


@pytest.mark.parametrize('layout', Layout)
def test_images_that_are_all_missing_are_an_error(layout: Layout, tmp_path: Path) -> None:
    WRITERS[layout](tmp_path)
    for image in tmp_path.rglob('*.png'):
        image.unlink()

    with pytest.raises(DatasetError):
        read_dataset(tmp_path)


@pytest.mark.parametrize('layout', Layout)
def test_an_empty_folder_is_an_error_in_every_layout(layout: Layout, tmp_path: Path) -> None:
    with pytest.raises(DatasetError):
        read_dataset(tmp_path, layout)


def test_no_folder_and_an_unknown_one_are_errors(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / 'nowhere'):
        with pytest.raises(DatasetError):
            read_dataset(folder)


def test_a_folder_of_two_layouts_has_to_be_told_apart(tmp_path: Path) -> None:
    poses = write_tum(tmp_path)
    write_cambridge(tmp_path)

    with pytest.raises(DatasetError, match='cambridge, tum'):
        read_dataset(tmp_path)
    assert same_poses(read_dataset(tmp_path, Layout.TUM).camera_from_world, poses)


def test_cambridge_has_positions_and_rotations_of_cameras(tmp_path: Path) -> None:
    poses = write_cambridge(tmp_path)

    train, test = (read_dataset(tmp_path, split=split) for split in Split)

    assert same_poses({**train.camera_from_world, **test.camera_from_world}, poses)
    assert test.names == (f'seq1/frame{COUNT - 1:05d}.png',)
    assert len(train.names) == COUNT - 1
    assert train.metric
    assert the_camera(train) == 'RADIAL 384 288 340 192 144 0 0'


def test_the_radial_term_of_visualsfm_takes_distortion_off(tmp_path: Path) -> None:
    radial = -0.04
    write_cambridge(tmp_path, radial)
    camera = next(iter(read_dataset(tmp_path).cameras.values()))
    measured = np.random.default_rng(0).uniform(-0.4, 0.4, (50, 2))

    undistorted = measured * (1 + radial * (measured**2).sum(axis=1, keepdims=True))
    pixels = camera.img_from_cam(np.column_stack([undistorted, np.ones(50)]))

    assert np.abs((pixels - [192.0, 144.0]) / FOCAL - measured).max() < 1e-4


def test_cambridge_without_its_model_leaves_the_cameras_open(tmp_path: Path) -> None:
    write_cambridge(tmp_path)
    (tmp_path / 'reconstruction.nvm').unlink()

    assert read_dataset(tmp_path).cameras == {}


def test_an_image_that_is_not_on_disk_is_listed_all_the_same(tmp_path: Path) -> None:
    write_cambridge(tmp_path)
    (tmp_path / 'seq1/frame00002.png').unlink()

    images = read_dataset(tmp_path)

    assert 'seq1/frame00002.png' in images.names
    assert 'seq1/frame00002.png' not in images.cameras


def test_seven_scenes_has_matrices_of_cameras_and_a_nominal_camera(tmp_path: Path) -> None:
    poses = write_seven_scenes(tmp_path)

    train, test = (read_dataset(tmp_path, split=split) for split in Split)

    assert same_poses({**train.camera_from_world, **test.camera_from_world}, poses)
    assert {name[:6] for name in train.names} == {'seq-01'}
    assert {name[:6] for name in test.names} == {'seq-02'}
    assert the_camera(train) == 'SIMPLE_PINHOLE 640 480 525 320 240'
    assert Layout.SEVEN_SCENES.camera_is_nominal


@pytest.mark.parametrize('number', ['nan', '-1.#IND', 'inf'])
def test_frames_of_seven_scenes_that_were_lost_have_no_pose(number: str, tmp_path: Path) -> None:
    poses = write_seven_scenes(tmp_path)
    lost = next(iter(poses))
    row = ' '.join([number] * 4) + '\n'
    (tmp_path / lost.replace('.color.png', '.pose.txt')).write_text(4 * row)

    images = read_dataset(tmp_path)

    assert lost in images.names
    assert lost not in images.camera_from_world
    assert len(images.camera_from_world) == len(images.names) - 1


def test_tum_goes_by_time_and_by_the_name_of_its_folder(tmp_path: Path) -> None:
    poses = write_tum(tmp_path / 'rgbd_dataset_freiburg1_room')

    images = read_dataset(tmp_path / 'rgbd_dataset_freiburg1_room')

    assert same_poses(images.camera_from_world, poses)
    assert len(images.names) == COUNT  # the last comes when the truth is over
    words = the_camera(images).split()
    assert words[0] == 'FULL_OPENCV'
    assert np.allclose(
        [float(word) for word in words[3:]],
        [517.3, 516.5, 319.1, 255.8, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633, 0, 0, 0],
        rtol=0,
        atol=1e-9,
    )


@pytest.mark.parametrize(('folder', 'model'), [('freiburg3_x', 'PINHOLE'), ('kitchen', None)])
def test_the_other_cameras_of_tum(folder: str, model: str | None, tmp_path: Path) -> None:
    write_tum(tmp_path / folder)

    cameras = read_dataset(tmp_path / folder).cameras

    assert {camera.model_name for camera in cameras.values()} == ({model} if model else set())


def test_euroc_has_poses_of_the_body(tmp_path: Path) -> None:
    poses = write_euroc(tmp_path)

    for folder in (tmp_path, tmp_path / 'mav0'):
        images = read_dataset(folder)
        assert same_poses(images.camera_from_world, poses)
        assert all((images.folder / name).is_file() for name in images.names)
        words = the_camera(images).split()
        assert words[0] == 'OPENCV'
        assert np.allclose(
            [float(word) for word in words[3:]],
            [FOCAL, FOCAL, 192, 144, -0.02, 0.003, 0.0002, 0.00002],
            rtol=0,
            atol=1e-9,
        )


def test_truth_is_interpolated_at_the_time_of_an_image(tmp_path: Path) -> None:
    write_euroc(tmp_path)
    truth = tmp_path / 'mav0/state_groundtruth_estimate0/data.csv'
    replace_word(truth, 3, 0, str(FIRST_NS + EUROC_NS_APART // 2), ',')

    found = read_dataset(tmp_path).camera_from_world[f'{FIRST_NS + EUROC_NS_APART}.png']

    # a third of the way from the changed sample, which is of frame 1, to that of frame 2
    error = np.linalg.norm(found.tgt_origin_in_src() - pose(1).tgt_origin_in_src())
    whole = np.linalg.norm(pose(2).tgt_origin_in_src() - pose(1).tgt_origin_in_src())
    assert abs(error / whole - 1 / 3) < 0.05


def test_images_in_a_long_gap_of_the_truth_have_no_pose(tmp_path: Path) -> None:
    poses = write_euroc(tmp_path)
    truth = tmp_path / 'mav0/state_groundtruth_estimate0/data.csv'
    for number in (4, 5):
        replace_line(truth, number, '')

    images = read_dataset(tmp_path)

    unknown = [f'{FIRST_NS + EUROC_NS_APART * index}.png' for index in (2, 3)]
    assert len(images.names) == COUNT
    assert same_poses(
        images.camera_from_world, {n: p for n, p in poses.items() if n not in unknown}
    )


def test_euroc_of_a_fisheye_camera(tmp_path: Path) -> None:
    write_euroc(tmp_path)
    sensor = tmp_path / 'mav0/cam0/sensor.yaml'
    sensor.write_text(
        '%YAML:1.0\n' + sensor.read_text().replace('radial-tangential', 'equidistant')
    )

    assert the_camera(read_dataset(tmp_path)).startswith('OPENCV_FISHEYE 384 288')


def test_kitti_has_poses_of_camera_0_and_images_of_camera_2(tmp_path: Path) -> None:
    poses = write_kitti(tmp_path)

    for folder in (tmp_path, tmp_path / 'sequences' / '07'):
        images = read_dataset(folder)
        assert same_poses(images.camera_from_world, poses)
        assert the_camera(images) == 'PINHOLE 384 288 340 340 192 144'


def test_grey_images_of_kitti_are_taken_where_there_are_no_others(tmp_path: Path) -> None:
    write_kitti(tmp_path)
    sequence = tmp_path / 'sequences' / '07'
    (sequence / 'image_2').rename(sequence / 'image_0')

    images = read_dataset(tmp_path)

    offset = images.camera_from_world['image_0/000000.png'] * pose(0).inverse()
    assert np.abs(offset.translation - [-0.06, 0.001, -0.003]).max() < 1e-9


def test_several_sequences_of_kitti_have_to_be_told_apart(tmp_path: Path) -> None:
    write_kitti(tmp_path)
    (tmp_path / 'sequences/08').mkdir()
    (tmp_path / 'sequences/08/calib.txt').touch()

    with pytest.raises(DatasetError, match='sequences/07, sequences/08'):
        read_dataset(tmp_path)


def _wrong_columns(
    file: str, number: int, text: str = '1 2 x', place: str = ''
) -> Callable[[Path], str]:
    """A changed line, and how the error names its place if not by file and line."""

    def damage(folder: Path) -> str:
        where = replace_line(folder / file, number, text)
        return place or where

    return damage


def _wrong_word(
    file: str, number: int, column: int, word: str, separator: str = ' '
) -> Callable[[Path], str]:
    return lambda folder: replace_word(folder / file, number, column, word, separator)


def _missing(file: str) -> Callable[[Path], str]:
    def remove(folder: Path) -> str:
        (folder / file).unlink()
        return (folder / file).name

    return remove


TRUTH = 'mav0/state_groundtruth_estimate0/data.csv'
SENSOR = 'mav0/cam0/sensor.yaml'
FRAME = 'seq-01/frame-000001.pose.txt'
CALIB = 'sequences/07/calib.txt'


@pytest.mark.parametrize(
    ('layout', 'damage'),
    [
        (Layout.CAMBRIDGE, _wrong_columns('dataset_train.txt', 5)),
        (Layout.CAMBRIDGE, _wrong_columns('dataset_train.txt', 4, 'a.png 1 2 3')),
        (Layout.CAMBRIDGE, _wrong_word('dataset_train.txt', 6, 1, 'nan')),
        (Layout.CAMBRIDGE, _wrong_word('dataset_train.txt', 6, 4, '7')),
        (Layout.CAMBRIDGE, _wrong_word('dataset_train.txt', 6, 0, '../x.png')),
        (Layout.CAMBRIDGE, _wrong_word('dataset_train.txt', 6, 0, 'seq1/frame00001.png')),
        (Layout.CAMBRIDGE, _wrong_columns('reconstruction.nvm', 5)),
        (Layout.CAMBRIDGE, _wrong_columns('reconstruction.nvm', 3, 'many')),
        (Layout.CAMBRIDGE, _wrong_columns('reconstruction.nvm', 5, 'a -1 1 0 0 0 0 0 0 0 0')),
        (Layout.SEVEN_SCENES, _missing('TrainSplit.txt')),
        (Layout.SEVEN_SCENES, _wrong_columns('TrainSplit.txt', 1, 'sequence7')),
        (Layout.SEVEN_SCENES, _wrong_columns('TrainSplit.txt', 1, '../seq-01')),
        (Layout.SEVEN_SCENES, _missing(FRAME)),
        (Layout.SEVEN_SCENES, _wrong_columns(FRAME, 2)),
        (Layout.SEVEN_SCENES, _wrong_columns(FRAME, 2, '', 'pose.txt')),
        (Layout.SEVEN_SCENES, _wrong_columns(FRAME, 2, '1 1 1 0', 'pose.txt:1')),
        (Layout.SEVEN_SCENES, _wrong_columns(FRAME, 4, '0 0 1 1', 'pose.txt:1')),
        (Layout.TUM, _missing('rgb.txt')),
        (Layout.TUM, _wrong_columns('rgb.txt', 2, '1305031102.1')),
        (Layout.TUM, _wrong_columns('rgb.txt', 2, 'x rgb/1.png')),
        (Layout.TUM, _wrong_columns('rgb.txt', 2, '1e999999 rgb/1.png')),
        (Layout.TUM, _wrong_columns('rgb.txt', 2, 'nan rgb/1.png')),
        (Layout.TUM, _wrong_columns('rgb.txt', 2, '1 /etc/1.png')),
        (Layout.TUM, _wrong_columns('groundtruth.txt', 2)),
        (Layout.TUM, _wrong_word('groundtruth.txt', 2, 3, 'inf')),
        (Layout.TUM, _wrong_word('groundtruth.txt', 2, 7, '7')),
        (Layout.EUROC, _missing(TRUTH)),
        (Layout.EUROC, _wrong_word(TRUTH, 3, 5, 'nan', ',')),
        (Layout.EUROC, _wrong_word(TRUTH, 3, 4, '7', ',')),
        (Layout.EUROC, _wrong_columns('mav0/cam0/data.csv', 2, '17')),
        (Layout.EUROC, _missing(SENSOR)),
        (Layout.EUROC, _wrong_columns(SENSOR, 2, '{', 'sensor.yaml')),
        (Layout.EUROC, _wrong_columns(SENSOR, 5, '  data: [1, 2, 3]', 'sensor.yaml')),
        (Layout.EUROC, _wrong_columns(SENSOR, 5, f'  data: {[1] * 16}', 'sensor.yaml')),
        (Layout.EUROC, _wrong_columns(SENSOR, 6, 'resolution: 17', 'sensor.yaml')),
        (Layout.EUROC, _wrong_columns(SENSOR, 7, 'camera_model: omni', 'sensor.yaml')),
        (Layout.EUROC, _wrong_columns(SENSOR, 8, 'intrinsics: [0, 0, 0, 0]', 'sensor.yaml')),
        (Layout.EUROC, _wrong_columns(SENSOR, 9, 'distortion_model: strange', 'sensor.yaml')),
        (Layout.KITTI, _wrong_columns(CALIB, 2, 'P2: 1 2 3')),
        (Layout.KITTI, _wrong_columns(CALIB, 2, 'P2: ' + '1 ' * 12)),
        (Layout.KITTI, _wrong_columns(CALIB, 2, 'P3: ' + '1 ' * 12, 'calib.txt')),
        (Layout.KITTI, _missing('sequences/07/times.txt')),
        (Layout.KITTI, _missing('poses/07.txt')),
        (Layout.KITTI, _wrong_columns('poses/07.txt', 2)),
        (Layout.KITTI, _wrong_columns('poses/07.txt', 2, '', '07.txt')),
        (Layout.KITTI, _wrong_word('poses/07.txt', 3, 0, 'nan')),
        (Layout.KITTI, _wrong_word('poses/07.txt', 3, 0, '7')),
    ],
)
def test_errors_name_the_file_and_line(
    layout: Layout, damage: Callable[[Path], str], tmp_path: Path
) -> None:
    WRITERS[layout](tmp_path)
    place = damage(tmp_path)

    with pytest.raises(DatasetError) as caught:
        read_dataset(tmp_path, layout)

    assert place in str(caught.value)


@pytest.mark.parametrize('content', [b'\xff\xfe\x00\xd8' * 9, b'1 ' * 2**20])
def test_files_that_are_no_text_are_errors(content: bytes, tmp_path: Path) -> None:
    write_tum(tmp_path)
    (tmp_path / 'groundtruth.txt').write_bytes(content)

    with pytest.raises(DatasetError, match=r'groundtruth\.txt'):
        read_dataset(tmp_path)
