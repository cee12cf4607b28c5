# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from itertools import count
from typing import TYPE_CHECKING

from live_robot import camera_info, image_message

if TYPE_CHECKING:
    from collections.abc import Callable

    from live_robot import NodeProcess, Robot
    from tiny_place import TinyPlace


def test_images_whose_stamps_jump_back_start_anew(
    start_node: Callable[..., NodeProcess], robot: Robot, tiny_place: TinyPlace
) -> None:
    node = start_node('--map', str(tiny_place.map_path), base_frame="''")
    robot.camera_info = camera_info(tiny_place.camera)
    robot.connect(node)
    robot.wait_for_first_fix(tiny_place.queries[0][0], count(100.0))
    for stamp in (50.0, 51.0):
        image = image_message(tiny_place.queries[0][0], stamp)
        robot.ask(image)
        robot.fix_of(image)
    assert node.log.count('`base_frame` is empty') == 1
    assert node.stop() == 0
