# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import time
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
from live_robot import (
    NodeProcess,
    Robot,
    camera_info,
    image_message,
    time_message,
    wait_for,
)
from sensor_msgs.msg import CompressedImage
from std_msgs.msg import Header

from gam_relocalizer.ros.conversions import nanoseconds_from

if TYPE_CHECKING:
    from collections.abc import Callable

    from tiny_place import TinyPlace

RATE_HZ = 30
FLOOD_S = 6
WARM_UP = 9
MEBIBYTE = 2**20


def own_bytes(node: NodeProcess) -> int:
    """What is resident, without the files and the shared memory of DDS."""
    lines = Path(f'/proc/{node.process.pid}/status').read_text(encoding='utf-8').splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith('RssAnon:'))


def test_a_flood_of_images_is_thinned_to_the_newest(
    start_node: Callable[..., NodeProcess], robot: Robot, tiny_place: TinyPlace
) -> None:
    node = start_node('--map', str(tiny_place.map_path), base_frame="''", period=0.01)
    robot.camera_info = camera_info(tiny_place.camera)
    robot.connect(node)
    for tenths in range(1, 1 + WARM_UP):  # the libraries have then what they allocate once
        robot.ask(image_message(tiny_place.queries[0][0], tenths / 10))
    before = own_bytes(node)
    image = image_message(tiny_place.queries[0][0], 0.0)
    for number in range(1, RATE_HZ * FLOOD_S):
        image.header.stamp.sec = number
        robot.show(image)
        time.sleep(1 / RATE_HZ)
    answered_in_time = len(robot.heard.statuses)
    wait_for(lambda: robot.verdict_on(image), 'the verdict on the last image')
    tried = [nanoseconds_from(status.header.stamp) for status in robot.heard.statuses]
    assert tried == sorted(set(tried))
    # only the attempt that was under way, one that it made wait, and the newest image are left
    assert len(tried) - answered_in_time <= 3
    assert own_bytes(node) - before < 100 * MEBIBYTE
    assert node.stop() == 0


def test_compressed_images_of_a_sensor_data_publisher(
    start_node: Callable[..., NodeProcess], robot: Robot, tiny_place: TinyPlace
) -> None:
    node = start_node(
        '--map',
        str(tiny_place.map_path),
        base_frame="''",
        image_transport='compressed',
        image_reliability='best_effort',
        remap=['image:=/front/image'],
    )
    robot.camera_info = camera_info(tiny_place.camera)
    robot.connect(node, compressed=True)
    encoded = cv2.imencode('.png', tiny_place.queries[0][0][..., ::-1])[1].tobytes()
    stamps = count(1)

    def accepted() -> bool:
        header = Header(stamp=time_message(next(stamps)), frame_id='camera')
        robot.show(CompressedImage(header=header, format='png', data=encoded))
        time.sleep(0.1)
        return any(status.accepted for status in robot.heard.statuses)

    wait_for(accepted, 'a fix')
    assert node.stop() == 0
