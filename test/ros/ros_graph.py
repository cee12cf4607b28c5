# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Two nodes that talk over DDS, spun by the test itself: a part under test, and the world."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import pytest
import rclpy
from geometry_msgs.msg import Transform, TransformStamped, Vector3
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import Header

from gam_relocalizer.ros.conversions import pose_message, stamp_from

if TYPE_CHECKING:
    from collections.abc import Callable

    import pycolmap

LIMIT_S = 30.0


class Graph:
    """The nodes `own` and `world`."""

    def __init__(self) -> None:
        self.own = rclpy.create_node('own')
        self.world = rclpy.create_node('world')
        self._executor = SingleThreadedExecutor()
        for node in (self.own, self.world):
            self._executor.add_node(node)

    def spin_until(self, condition: Callable[[], object], what: str) -> None:
        give_up = time.monotonic() + LIMIT_S
        while not condition():
            if time.monotonic() > give_up:
                pytest.fail(f'{what}: not within {LIMIT_S} s')
            self._executor.spin_once(timeout_sec=0.01)

    def close(self) -> None:
        self._executor.shutdown()
        self.own.destroy_node()
        self.world.destroy_node()


def transform_message(
    parent: str, child: str, parent_from_child: pycolmap.Rigid3d, stamp_ns: int = 0
) -> TransformStamped:
    pose = pose_message(parent_from_child)
    x, y, z = pose.position.x, pose.position.y, pose.position.z
    return TransformStamped(
        header=Header(stamp=stamp_from(stamp_ns), frame_id=parent),
        child_frame_id=child,
        transform=Transform(translation=Vector3(x=x, y=y, z=z), rotation=pose.orientation),
    )
