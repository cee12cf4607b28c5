# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from signal import SIGINT, SIGTERM, Signals
from typing import TYPE_CHECKING

import pytest
from live_robot import NodeProcess, Robot, camera_info, image_message

if TYPE_CHECKING:
    from collections.abc import Callable

    from tiny_place import TinyPlace

SIGNALS = [(SIGINT,), (SIGTERM,), (SIGINT, SIGINT, SIGTERM)]


def assert_clean_end(node: NodeProcess, signals: tuple[Signals, ...]) -> None:
    assert node.stop(*signals) == 0, node.log
    assert 'Traceback' not in node.log


@pytest.mark.parametrize('signals', SIGNALS)
def test_a_signal_during_an_attempt_ends_the_node_cleanly(
    start_node: Callable[..., NodeProcess],
    robot: Robot,
    tiny_place: TinyPlace,
    signals: tuple[Signals, ...],
) -> None:
    node = start_node('--map', str(tiny_place.map_path), base_frame="''")
    robot.camera_info = camera_info(tiny_place.camera)
    robot.connect(node)
    for stamp in (1.0, 2.0):
        robot.ask(image_message(tiny_place.queries[0][0], stamp))
    # the calibration is known, so the next image is under way as soon as it is there
    robot.show(image_message(tiny_place.queries[0][0], 3.0))
    assert_clean_end(node, signals)


def test_a_signal_while_waiting_ends_the_node_cleanly(
    start_node: Callable[..., NodeProcess], monkeypatch: pytest.MonkeyPatch
) -> None:
    # as under a bare service: ROS does not start where it knows no place for its logs
    for place in ('HOME', 'ROS_HOME', 'ROS_LOG_DIR'):
        monkeypatch.delenv(place, raising=False)
    node = start_node()
    node.wait_for_log('not configured')
    assert_clean_end(node, (SIGTERM,))
