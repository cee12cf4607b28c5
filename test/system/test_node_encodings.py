# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Images in every encoding, seen by a running node: the pose is right, and so are the colours."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from live_robot import (
    BASE_FROM_CAMERA,
    CAMERA_FRAME,
    Robot,
    camera_info,
    image_message,
    node_process,
    running_node,
    spinning_node,
    time_message,
    wait_for,
)
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header

from gam_relocalizer.images import ENCODINGS
from gam_relocalizer.localization.result import Status
from gam_relocalizer.ros.debug_image import GREEN

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from numpy.typing import NDArray
    from tiny_place import TinyPlace

    Stored = NDArray[np.uint8] | NDArray[np.uint16]

# where the red, green and blue pixels of a pattern are, row by row
BAYER = {'rggb': (0, 1, 1, 2), 'bggr': (2, 1, 1, 0), 'gbrg': (1, 2, 0, 1), 'grbg': (1, 0, 2, 1)}
GREY_ENCODINGS = {'mono8', 'mono16', '8UC1'}
PICTURES = 20


def opaque(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    alpha = np.random.default_rng(0).integers(0, 256, rgb.shape[:2], dtype=np.uint8)
    return np.dstack([rgb, alpha])


def swapped(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.ascontiguousarray(rgb[..., ::-1])


def grey(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def mosaic(rgb: NDArray[np.uint8], pattern: str) -> NDArray[np.uint8]:
    stored = np.empty(rgb.shape[:2], np.uint8)
    for position, channel in enumerate(BAYER[pattern]):
        row, column = divmod(position, 2)
        stored[row::2, column::2] = rgb[row::2, column::2, channel]
    return stored


def of_16_bit(stored: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """With lower bytes that are noise: in the wrong byte order the picture is noise."""
    noise = np.random.default_rng(0).integers(0, 256, stored.shape, dtype=np.uint16)
    return np.asarray(stored.astype(np.uint16) * 256 + noise, dtype=np.uint16)


def yuv(rgb: NDArray[np.uint8], code: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(rgb, code), dtype=np.uint8)


STORED: Mapping[str, Callable[[NDArray[np.uint8]], Stored]] = {
    'mono8': grey,
    'mono16': lambda rgb: of_16_bit(grey(rgb)),
    'rgb8': lambda rgb: rgb,
    'bgr8': swapped,
    'rgba8': opaque,
    'bgra8': lambda rgb: opaque(swapped(rgb)),
    '8UC1': grey,
    '8UC3': swapped,
    **{f'bayer_{pattern}8': lambda rgb, p=pattern: mosaic(rgb, p) for pattern in BAYER},
    **{f'bayer_{pattern}16': lambda rgb, p=pattern: of_16_bit(mosaic(rgb, p)) for pattern in BAYER},
    'yuv422': lambda rgb: yuv(rgb, cv2.COLOR_RGB2YUV_UYVY),
    'uyvy': lambda rgb: yuv(rgb, cv2.COLOR_RGB2YUV_UYVY),
    'yuv422_yuy2': lambda rgb: yuv(rgb, cv2.COLOR_RGB2YUV_YUY2),
    'yuyv': lambda rgb: yuv(rgb, cv2.COLOR_RGB2YUV_YUY2),
}
WIDE = [name for name in STORED if name.endswith('16')]


def encoded_image(
    rgb: NDArray[np.uint8],
    stamp: float,
    encoding: str,
    *,
    padding: int = 0,
    is_bigendian: bool = False,
) -> Image:
    """A picture in an encoding, with rows that end in so many bytes of noise."""
    stored = STORED[encoding](rgb)
    if is_bigendian != (sys.byteorder == 'big'):
        stored = stored.byteswap()
    rows = np.ascontiguousarray(stored).view(np.uint8).reshape(len(stored), -1)
    noise = np.random.default_rng(1).integers(0, 256, (len(rows), padding), dtype=np.uint8)
    padded = np.hstack([rows, noise])
    message = image_message(padded, stamp, encoding=encoding)
    message.width, message.is_bigendian = rgb.shape[1], int(is_bigendian)
    return message


@pytest.fixture(scope='module')
def robot(tiny_place: TinyPlace, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    log = tmp_path_factory.mktemp('node') / 'node.log'
    with running_node(log, tiny_place) as (_, robot):
        yield robot


@pytest.fixture(scope='module')
def pictures(robot: Robot) -> list[Image]:
    """What the node shows of the images that it tried: as it has decoded them."""
    heard: list[Image] = []
    topic = robot.topic('debug_image')
    robot.node.create_subscription(Image, topic, heard.append, qos_profile_sensor_data)
    wait_for(lambda: robot.node.count_publishers(topic), 'the debug image')
    return heard


def assert_seen_right(robot: Robot, tiny_place: TinyPlace, encoding: str, **layout: Any) -> None:  # noqa: ANN401 - of encoded_image
    # another image each time, so that no pose is that of the case before
    number = int(next(robot.stamps) * 4) % len(tiny_place.queries)
    rgb, camera_from_map = tiny_place.queries[number]
    image = encoded_image(rgb, next(robot.stamps), encoding, **layout)
    status = robot.ask(image)
    assert status.accepted, status.reason
    robot.assert_at(image, BASE_FROM_CAMERA * camera_from_map)


@pytest.mark.parametrize('encoding', STORED)
def test_an_image_in_any_encoding_gives_the_pose(
    robot: Robot, tiny_place: TinyPlace, encoding: str
) -> None:
    assert_seen_right(robot, tiny_place, encoding)


@pytest.mark.parametrize('encoding', WIDE)
def test_the_byte_order_of_16_bit_is_heeded(
    robot: Robot, tiny_place: TinyPlace, encoding: str
) -> None:
    assert_seen_right(robot, tiny_place, encoding, is_bigendian=True)


@pytest.mark.parametrize('encoding', ['mono8', 'mono16', 'bgr8', 'bayer_rggb8', 'yuv422'])
def test_padding_of_the_rows_is_skipped(robot: Robot, tiny_place: TinyPlace, encoding: str) -> None:
    assert_seen_right(robot, tiny_place, encoding, padding=37)


def test_no_encoding_is_left_out_here() -> None:
    assert set(STORED) == set(ENCODINGS)


@pytest.mark.parametrize('encoding', sorted(set(STORED) - GREY_ENCODINGS))
def test_colours_are_those_of_the_scene(
    robot: Robot, pictures: list[Image], tiny_place: TinyPlace, encoding: str
) -> None:
    # not of the size of the calibration, so there is no pose, but a picture that is not too large
    # for a best-effort topic
    rgb = cv2.resize(tiny_place.queries[0][0], None, fx=0.5, fy=0.5)

    def picture() -> Image | None:
        image = encoded_image(rgb, next(robot.stamps), encoding)
        robot.ask(image)
        del pictures[:-PICTURES]
        return next((p for p in pictures if p.header.stamp == image.header.stamp), None)

    drawn = wait_for(picture, 'the picture of an attempt')
    shown = np.frombuffer(drawn.data, np.uint8).reshape(rgb.shape).astype(float)
    untouched = ~(shown == GREEN).all(axis=2)
    untouched[:40] = False  # the verdict in words
    for channel in range(3):
        difference = np.abs(shown - rgb)[untouched][:, channel]
        assert np.median(difference) < 6
        # as in a photograph: the wrong channel would be further off
        assert difference.mean() < np.abs(shown[..., channel] - rgb[..., channel - 1]).mean()


def broken(image: Image, **changes: object) -> Image:
    for name, value in changes.items():
        setattr(image, name, value)
    return image


@pytest.mark.parametrize(
    ('encoding', 'changes', 'word'),
    [
        ('rgb8', {'encoding': '32FC1'}, '32FC1'),
        ('rgb8', {'encoding': 'nv21'}, 'nv21'),
        ('rgb8', {'encoding': ''}, 'encoding'),
        ('rgb8', {'step': 1919}, 'step'),
        ('rgb8', {'height': 481}, 'truncated'),
        ('mono8', {'height': 0}, '640 x 0'),
        ('rgb8', {'width': 2**31, 'step': 2**32 - 1}, '2147483648 x 480'),
        ('rgb8', {'height': 2**32 - 1, 'width': 2**32 - 1, 'step': 0}, '4294967295'),
        ('yuv422', {'width': 639}, 'odd'),
        ('mono16', {'data': b'\0' * 1000}, 'truncated'),
        ('rgb8', {'data': b''}, 'found 0'),
    ],
)
def test_what_cannot_be_decoded_is_a_reason(
    robot: Robot, tiny_place: TinyPlace, encoding: str, changes: dict[str, object], word: str
) -> None:
    rgb = tiny_place.queries[0][0]
    image = broken(encoded_image(rgb, next(robot.stamps), encoding), **changes)
    status = robot.refusal_of(image, lambda: robot.shot(rgb))
    assert status.status == Status.UNDECODABLE_IMAGE.value
    assert word in status.reason
    assert '/image' in status.reason


def compressed(
    robot: Robot, encoded: bytes | NDArray[np.uint8], compression: str = ''
) -> CompressedImage:
    header = Header(stamp=time_message(next(robot.stamps)), frame_id=CAMERA_FRAME)
    return CompressedImage(header=header, format=compression, data=bytes(encoded))


def as_file(pixels: Stored, suffix: str) -> bytes:
    return cv2.imencode(suffix, pixels)[1].tobytes()


@pytest.fixture(scope='module')
def far_robot(tiny_place: TinyPlace, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    """Its camera sends compressed images, beside the topic that `image` is mapped to."""
    log = tmp_path_factory.mktemp('node') / 'node.log'
    remap = ['image:=/front/image']
    with (
        node_process(
            log, '--map', str(tiny_place.map_path), image_transport='compressed', remap=remap
        ) as node,
        spinning_node('robot') as own,
    ):
        robot = Robot(own)
        robot.mount_camera()
        robot.connect(node, compressed=True)
        robot.camera_info = camera_info(tiny_place.camera)
        png = as_file(swapped(tiny_place.queries[0][0]), '.png')
        wait_for(lambda: robot.ask(compressed(robot, png)).accepted, 'the first fix')
        yield robot


@pytest.mark.parametrize(
    ('suffix', 'store'),
    [
        ('.jpg', swapped),
        ('.png', swapped),
        ('.jpg', grey),
        ('.png', lambda rgb: of_16_bit(grey(rgb))),
        ('.png', lambda rgb: opaque(swapped(rgb))),
    ],
    ids=['jpeg', 'png', 'grey jpeg', 'png of 16 bit', 'png with alpha'],
)
def test_a_compressed_image_gives_the_pose(
    far_robot: Robot,
    tiny_place: TinyPlace,
    suffix: str,
    store: Callable[[NDArray[np.uint8]], Stored],
) -> None:
    rgb, camera_from_map = tiny_place.queries[1]
    image = compressed(far_robot, as_file(store(rgb), suffix), suffix[1:])
    status = far_robot.ask(image)
    assert status.accepted, status.reason
    far_robot.assert_at(image, BASE_FROM_CAMERA * camera_from_map)


def test_a_damaged_compressed_image_is_a_reason(far_robot: Robot, tiny_place: TinyPlace) -> None:
    png = as_file(swapped(tiny_place.queries[0][0]), '.png')
    for damaged in (b'', b'no picture', png[:100], b'\0' * 1000):
        status = far_robot.refusal_of(
            compressed(far_robot, damaged), lambda: compressed(far_robot, png)
        )
        assert status.status == Status.UNDECODABLE_IMAGE.value
        assert '/front/image/compressed' in status.reason
