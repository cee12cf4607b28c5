# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Reads rosbag2 recordings (sqlite3 and mcap, directory or single file) without ROS."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from gam_relocalizer.errors import BagError, RelocalizerError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

IMAGE = 'sensor_msgs/msg/Image'
COMPRESSED_IMAGE = 'sensor_msgs/msg/CompressedImage'
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
IMAGE_TYPES = (IMAGE, COMPRESSED_IMAGE)
STORAGE_SUFFIXES = ('.mcap', '.db3')
NANOSECONDS = 1_000_000_000


@dataclass(frozen=True)
class Topic:
    """A topic of a bag."""

    name: str
    type: str
    count: int

    def __str__(self) -> str:
        return f'{self.name} ({self.type}, {self.count} messages)'


@dataclass(frozen=True)
class BagMessage:
    """A message as recorded.

    Attributes:
        topic: Its topic.
        log_ns: When the recorder received it [ns].
        value: The message; fields are named as in ROS, arrays are NumPy's.
    """

    topic: Topic
    log_ns: int
    value: Any

    @property
    def stamp_ns(self) -> int:
        """The header's stamp [ns]."""
        return nanoseconds(self.value.header.stamp)


def nanoseconds(stamp: Any) -> int:  # noqa: ANN401 - a builtin_interfaces/Time of any library
    """A ROS time as one integer [ns]."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


class Bag:
    """An open bag; made by `open_bag`."""

    def __init__(self, path: Path, reader: AnyReader) -> None:
        self.path = path
        self._reader = reader
        self.topics = {
            name: Topic(name, info.msgtype or 'several types', info.msgcount)
            for name, info in sorted(reader.topics.items())
        }

    @property
    def time_range(self) -> tuple[int, int]:
        """First and last log time [ns]."""
        return self._reader.start_time, self._reader.end_time

    def messages(self, topics: Collection[str]) -> Iterator[BagMessage]:
        """Streams the messages of some topics in the order of their log times.

        Two streams may not run through one open bag at the same time.

        Raises:
            BagError: The recording is damaged.
        """
        for topic, log_ns, raw in self.raw_messages(topics):
            with _damage_is_named(self.path):
                value = self._reader.deserialize(raw, topic.type)
            yield BagMessage(topic, log_ns, value)

    def raw_messages(self, topics: Collection[str]) -> Iterator[tuple[Topic, int, bytes]]:
        """As `messages`, but each with its log time [ns] and as serialised (CDR).

        Raises:
            BagError: The recording is damaged.
        """
        connections = [c for c in self._reader.connections if c.topic in topics]
        if not connections:
            return
        stream = self._reader.messages(connections)
        while True:
            with _damage_is_named(self.path):
                try:
                    connection, log_ns, raw = next(stream)
                except StopIteration:
                    return
            yield self.topics[connection.topic], log_ns, bytes(raw)

    def require(self, name: str, types: Collection[str], option: str) -> Topic:
        """The topic of that name.

        Raises:
            BagError: No such topic, or it has none of the types; lists what the bag has.
        """
        topic = self.topics.get(name)
        if topic is None:
            msg = f'{self.path}: no topic {name} ({option}); {self._contents()}'
            raise BagError(msg)
        if topic.type not in types:
            msg = f'{self.path}: {topic} cannot serve as {option}, which takes {", ".join(types)}'
            raise BagError(msg)
        return topic

    def only(self, types: Collection[str], option: str) -> Topic:
        """The one topic with one of the types.

        Raises:
            BagError: None, or several: then `option` has to choose.
        """
        found = self.of_types(types)
        if not found:
            msg = f'{self.path}: no topic of type {" or ".join(types)}; {self._contents()}'
            raise BagError(msg)
        if len(found) > 1:
            names = ', '.join(map(str, found))
            msg = f'{self.path}: several topics could serve, choose one with {option}: {names}'
            raise BagError(msg)
        return found[0]

    def of_types(self, types: Collection[str]) -> list[Topic]:
        """All topics with one of the types."""
        return [topic for topic in self.topics.values() if topic.type in types]

    def _contents(self) -> str:
        if not self.topics:
            return 'the bag has no topics at all'
        return f'the bag has {", ".join(map(str, self.topics.values()))}'


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Opens a rosbag2: a directory with or without metadata.yaml, or one .mcap or .db3 file.

    Raises:
        BagError: Missing, not a bag, damaged, or of a storage that cannot be read.
    """
    files = _storage_files(path)
    with _damage_is_named(path):
        reader = AnyReader(files, default_typestore=get_typestore(Stores.ROS2_JAZZY))
        reader.open()
    try:
        with _damage_is_named(path):
            bag = Bag(path, reader)
        yield bag
    finally:
        reader.close()


def find_image_topic(bag: Bag, wanted: str | None) -> Topic:
    """The topic with the images: the wanted one, or the only one there is.

    Raises:
        BagError: No such topic, or several to choose from.
    """
    option = '--image-topic'
    return bag.require(wanted, IMAGE_TYPES, option) if wanted else bag.only(IMAGE_TYPES, option)


def find_camera_info_topic(bag: Bag, image_topic: str, wanted: str | None) -> Topic:
    """The topic with the calibration of an image topic.

    It is the wanted one, else `camera_info` beside the image topic or above it (image transports
    append to the topic's name), else the only one there is.

    Raises:
        BagError: No such topic, or several to choose from.
    """
    option = '--camera-info-topic'
    if wanted:
        return bag.require(wanted, (CAMERA_INFO,), option)
    names = {topic.name: topic for topic in bag.of_types((CAMERA_INFO,))}
    for folder in PurePosixPath(image_topic).parents:
        if topic := names.get(str(folder / 'camera_info')):
            return topic
    return bag.only((CAMERA_INFO,), f'{option}, or give the camera with --camera')


def _storage_files(path: Path) -> list[Path]:
    """What to hand to the reader: the bag itself, or the files of a bag without metadata."""
    if not path.exists():
        msg = f'{path}: no such bag; expected a rosbag2 directory, or a .mcap or .db3 file'
        raise BagError(msg)
    if path.is_file():
        if path.suffix not in STORAGE_SUFFIXES:
            msg = (
                f'{path}: not a rosbag2 file (.mcap or .db3); convert a ROS 1 bag with '
                f'`rosbags-convert`'
            )
            raise BagError(msg)
        return [path]
    if (path / 'metadata.yaml').is_file():
        return [path]
    files = sorted(file for file in path.iterdir() if file.suffix in STORAGE_SUFFIXES)
    if not files:
        msg = f'{path}: not a rosbag2: neither metadata.yaml nor a .mcap or .db3 file in it'
        raise BagError(msg)
    return files


@contextmanager
def _damage_is_named(path: Path) -> Iterator[None]:
    """Bags are untrusted, and the reader meets damage with whatever its parsers happen to raise."""
    try:
        yield
    except RelocalizerError:
        raise
    except Exception as err:
        detail = str(err) or type(err).__name__
        msg = (
            f'{path}: cannot be read as a rosbag2: {detail}; it may be damaged or truncated (try '
            f'`mcap recover` on a .mcap file, `ros2 bag reindex` on a directory)'
        )
        raise BagError(msg) from err
