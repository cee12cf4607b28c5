# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import shutil
from contextlib import suppress
from typing import TYPE_CHECKING

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recorded_drive import BagWriter, stamp_of, write_bag
from rosbags.rosbag2 import StoragePlugin

from gam_relocalizer.errors import BagError
from gam_relocalizer.replay.bag import find_camera_info_topic, find_image_topic, open_bag

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


def read_all(path: Path) -> list[int]:
    with open_bag(path) as bag:
        return [message.stamp_ns for message in bag.messages(['/camera/image'])]


def fill_images(bag: BagWriter) -> None:
    for index in range(30):
        bag.image(index)


def fill_truth(bag: BagWriter) -> None:
    for index in range(5):
        bag.truth(index)


STORAGES = [StoragePlugin.MCAP, StoragePlugin.SQLITE3]


@pytest.fixture(params=STORAGES, ids=['mcap', 'sqlite3'])
def images_bag(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return write_bag(tmp_path / 'images', fill_images, request.param)


def test_streams_messages_in_time_order(images_bag: Path) -> None:
    assert read_all(images_bag) == [stamp_of(index) for index in range(30)]


def test_reads_bag_without_metadata(images_bag: Path) -> None:
    (images_bag / 'metadata.yaml').unlink()
    assert len(read_all(images_bag)) == 30


def test_reads_single_file(images_bag: Path, tmp_path: Path) -> None:
    (file,) = (file for file in images_bag.iterdir() if file.suffix in {'.mcap', '.db3'})
    alone = tmp_path / f'alone{file.suffix}'
    shutil.copy(file, alone)
    assert len(read_all(alone)) == 30


def test_lists_topics_with_types_and_counts(images_bag: Path) -> None:
    with open_bag(images_bag) as bag:
        (topic,) = bag.topics.values()
    assert (topic.name, topic.type, topic.count) == ('/camera/image', 'sensor_msgs/msg/Image', 30)


def cut_to(file: Path, share: float) -> None:
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])


@pytest.mark.parametrize(
    'damage',
    [
        lambda file: cut_to(file, 0.0),
        lambda file: cut_to(file, 0.001),
        lambda file: cut_to(file, 0.5),
        lambda file: file.write_bytes(b'no bag at all, but a text'),
        lambda file: file.unlink(),
    ],
    ids=['empty', 'header-only', 'half', 'text', 'missing'],
)
@pytest.mark.parametrize('keep_metadata', [True, False], ids=['metadata', 'bare'])
def test_damaged_bag_is_named(
    images_bag: Path, damage: Callable[[Path], None], keep_metadata: object
) -> None:
    (file,) = (file for file in images_bag.iterdir() if file.suffix in {'.mcap', '.db3'})
    damage(file)
    if not keep_metadata:
        (images_bag / 'metadata.yaml').unlink()
    with pytest.raises(BagError, match='images'):
        read_all(images_bag)


def test_mcap_without_its_end_is_named(tmp_path: Path) -> None:
    path = write_bag(tmp_path / 'images', fill_images)
    cut_to(path / 'images.mcap', 0.99)
    with pytest.raises(BagError, match='mcap recover'):
        read_all(path)


@pytest.fixture(scope='module', params=STORAGES, ids=['mcap', 'sqlite3'])
def intact_file(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('intact')
    path = write_bag(folder / 'few', fill_truth, request.param)
    (file,) = (file for file in path.iterdir() if file.suffix in {'.mcap', '.db3'})
    return file


@settings(max_examples=30)
@given(st.floats(0.0, 1.0), st.binary(min_size=1, max_size=64))
def test_any_damage_is_either_survived_or_named(
    intact_file: Path, place: float, garbage: bytes
) -> None:
    data = bytearray(intact_file.read_bytes())
    begin = int(place * (len(data) - len(garbage)))
    data[begin : begin + len(garbage)] = garbage
    damaged = intact_file.with_name(f'damaged{intact_file.suffix}')
    damaged.write_bytes(data)
    with suppress(BagError), open_bag(damaged) as bag:
        for _ in bag.messages(bag.topics):
            pass


@pytest.mark.parametrize(
    'text',
    ['', '[', 'rosbag2_bagfile_information: 3', 'rosbag2_bagfile_information:\n  version: 9'],
)
def test_damaged_metadata_is_named(images_bag: Path, text: str) -> None:
    (images_bag / 'metadata.yaml').write_text(text, encoding='utf-8')
    with pytest.raises(BagError, match='images'):
        read_all(images_bag)


@pytest.mark.parametrize('name', ['nowhere', 'folder', 'ros1.bag'])
def test_what_is_no_bag_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / 'folder').mkdir()
    (tmp_path / 'ros1.bag').write_bytes(b'#ROSBAG V2.0\n')
    with pytest.raises(BagError, match=name), open_bag(tmp_path / name):
        pass


def test_error_of_the_reader_of_messages_passes_unchanged(images_bag: Path) -> None:
    with pytest.raises(ZeroDivisionError), open_bag(images_bag) as bag:
        _ = [1 // 0 for _ in bag.messages(['/camera/image'])]


def fill_cameras(bag: BagWriter) -> None:
    bag.image(0, '/front/image_raw')
    bag.compressed_image(0, '/rear/image_raw/compressed')
    bag.camera_info(0, '/front/camera_info')
    bag.camera_info(0, '/rear/camera_info')
    bag.truth(0)


@pytest.fixture
def cameras_bag(tmp_path: Path) -> Path:
    return write_bag(tmp_path / 'cameras', fill_cameras)


def test_takes_the_only_image_topic(images_bag: Path) -> None:
    with open_bag(images_bag) as bag:
        assert find_image_topic(bag, None).name == '/camera/image'


def test_several_image_topics_are_listed_with_the_option(cameras_bag: Path) -> None:
    with open_bag(cameras_bag) as bag, pytest.raises(BagError) as caught:
        find_image_topic(bag, None)
    for part in ('/front/image_raw', '/rear/image_raw/compressed', '--image-topic'):
        assert part in str(caught.value)


def test_missing_topic_lists_what_the_bag_has(cameras_bag: Path) -> None:
    with open_bag(cameras_bag) as bag, pytest.raises(BagError) as caught:
        find_image_topic(bag, '/left/image')
    for part in ('/left/image', '/front/image_raw', '/ground_truth', 'PoseStamped', '1 message'):
        assert part in str(caught.value)


def test_topic_of_another_type_is_refused(cameras_bag: Path) -> None:
    with open_bag(cameras_bag) as bag, pytest.raises(BagError, match='PoseStamped'):
        find_image_topic(bag, '/ground_truth')


def test_bag_without_images_lists_what_it_has(tmp_path: Path) -> None:
    path = write_bag(tmp_path / 'poses', lambda bag: bag.truth(0))
    with open_bag(path) as bag, pytest.raises(BagError, match='/ground_truth'):
        find_image_topic(bag, None)


def test_empty_bag_says_so(tmp_path: Path) -> None:
    path = write_bag(tmp_path / 'empty', lambda _bag: None)
    with open_bag(path) as bag, pytest.raises(BagError, match='no topics'):
        find_image_topic(bag, None)


@pytest.mark.parametrize(
    ('image_topic', 'expected'),
    [
        ('/front/image_raw', '/front/camera_info'),
        ('/rear/image_raw/compressed', '/rear/camera_info'),
    ],
)
def test_calibration_is_found_beside_the_images(
    cameras_bag: Path, image_topic: str, expected: str
) -> None:
    with open_bag(cameras_bag) as bag:
        assert find_camera_info_topic(bag, image_topic, None).name == expected


def test_calibration_can_be_chosen(cameras_bag: Path) -> None:
    with open_bag(cameras_bag) as bag:
        topic = find_camera_info_topic(bag, '/front/image_raw', '/rear/camera_info')
    assert topic.name == '/rear/camera_info'


def test_unclear_calibration_names_both_options(cameras_bag: Path) -> None:
    with open_bag(cameras_bag) as bag, pytest.raises(BagError) as caught:
        find_camera_info_topic(bag, '/top/image_raw', None)
    for part in ('/front/camera_info', '/rear/camera_info', '--camera-info-topic', '--camera'):
        assert part in str(caught.value)
