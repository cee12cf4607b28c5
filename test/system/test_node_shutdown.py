# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""A signal ends the node with exit code 0, without a complaint, and leaves nobody behind."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from signal import SIGINT, SIGTERM, Signals
from typing import TYPE_CHECKING

import pytest
from builtin_interfaces.msg import Duration
from lifecycle_msgs.msg import Transition, TransitionEvent
from live_robot import (
    LIMIT_S,
    REPOSITORY,
    NodeProcess,
    Robot,
    camera_info,
    image_message,
    wait_for,
)

from gam_relocalizer_msgs.srv import LoadMap, LocalizeImage, Relocalize

if TYPE_CHECKING:
    from collections.abc import Callable

    from tiny_place import TinyPlace

SIGNALS = [(SIGINT,), (SIGTERM,), (SIGINT, SIGINT, SIGTERM)]
LONG_S = 3600


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
    node.end_cleanly(*signals)


def test_a_signal_while_waiting_ends_the_node_cleanly(
    start_node: Callable[..., NodeProcess], monkeypatch: pytest.MonkeyPatch
) -> None:
    # as under a bare service: ROS does not start where it knows no place for its logs
    for place in ('HOME', 'ROS_HOME', 'ROS_LOG_DIR'):
        monkeypatch.delenv(place, raising=False)
    node = start_node()
    node.wait_for_log('not configured')
    node.end_cleanly(SIGTERM)


@pytest.mark.parametrize('signals', [(SIGINT,), (SIGTERM,)])
def test_a_signal_while_the_map_is_loaded_ends_the_node_cleanly(
    start_node: Callable[..., NodeProcess],
    robot: Robot,
    tiny_place: TinyPlace,
    signals: tuple[Signals, ...],
) -> None:
    node = start_node('--map', str(tiny_place.map_path), autostart=False)
    events: list[TransitionEvent] = []
    topic = robot.topic('transition_event')
    robot.node.create_subscription(TransitionEvent, topic, events.append, 10)

    def is_heard() -> bool:
        assert robot.change_state(Transition.TRANSITION_CONFIGURE)
        assert robot.change_state(Transition.TRANSITION_CLEANUP)
        return 'unconfigured' in [event.goal_state.label for event in events]

    wait_for(is_heard, 'the states of the node')
    events.clear()
    robot.request_state(Transition.TRANSITION_CONFIGURE)
    wait_for(lambda: events, 'the configuration')
    assert events[0].goal_state.label == 'configuring'
    node.end_cleanly(*signals)


@pytest.mark.parametrize('signals', [(SIGINT,), (SIGTERM,)])
def test_a_signal_while_requests_wait_ends_the_node_cleanly(
    start_node: Callable[..., NodeProcess],
    robot: Robot,
    tiny_place: TinyPlace,
    signals: tuple[Signals, ...],
) -> None:
    node = start_node('--map', str(tiny_place.map_path), period=float(LONG_S))
    robot.mount_camera()
    robot.camera_info = camera_info(tiny_place.camera)
    robot.connect(node)
    image = image_message(tiny_place.queries[0][0], 1.0)
    patient = Relocalize.Request(timeout=Duration(sec=LONG_S))
    requests = [
        (Relocalize, 'relocalize', patient),
        (LoadMap, 'load_map', LoadMap.Request(path=str(tiny_place.map_path))),
        (
            LocalizeImage,
            'localize_image',
            LocalizeImage.Request(image=image, camera_info=robot.camera_info),
        ),
    ]
    for kind, name, _ in requests:  # both ends know each other after one answer
        robot.call(kind, robot.topic(name), unanswerable(kind))
    clients = [robot.node.create_client(kind, robot.topic(name)) for kind, name, _ in requests]
    for client, (_, _, request) in zip(clients, requests, strict=True):
        assert client.wait_for_service(LIMIT_S)
        client.call_async(request)
    node.end_cleanly(*signals)


def unanswerable(kind: type) -> object:
    """A request that is refused at once."""
    request = kind.Request()
    if kind is Relocalize:
        request.timeout = Duration(nanosec=1)
    return request


@pytest.mark.parametrize('library', ['numpy', 'pycolmap', 'torch'])
@pytest.mark.parametrize('number', [SIGINT, SIGTERM])
def test_a_signal_while_it_starts_ends_the_node_quietly(library: str, number: Signals) -> None:
    command = [sys.executable, str(REPOSITORY / 'scripts' / 'node')]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    loaded = Path(f'/proc/{process.pid}/maps')
    wait_for(lambda: library in loaded.read_text(encoding='utf-8'), library)
    process.send_signal(number)
    _, said = process.communicate(timeout=LIMIT_S)
    assert (process.returncode, 'Traceback' in said) == (0, False), said
