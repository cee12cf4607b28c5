# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from lifecycle_msgs.msg import Transition
from live_robot import NodeProcess, Robot, camera_info

from gam_relocalizer_msgs.srv import LoadMap

if TYPE_CHECKING:
    from collections.abc import Callable

    from tiny_place import TinyPlace

# After the first rounds the libraries have what they allocate once.
WARM_UP, ROUNDS = 4, 12
# Half of the rounds with the smallest network left behind in each would be twice as much [MiB].
MARGIN_MIB = 2.0
KIBIBYTES_PER_MEBIBYTE = 1024


@dataclass(frozen=True)
class Held:
    """What the process of a node holds."""

    own_mib: float
    threads: int
    files: int


def held_by(node: NodeProcess) -> Held:
    folder = Path('/proc', str(node.process.pid))
    lines = (folder / 'status').read_text(encoding='utf-8').splitlines()
    fields = {name: value.split() for name, _, value in (line.partition(':') for line in lines)}
    return Held(
        own_mib=int(fields['RssAnon'][0]) / KIBIBYTES_PER_MEBIBYTE,
        threads=int(fields['Threads'][0]),
        files=len(list((folder / 'fd').iterdir())),
    )


def assert_flat(rounds: list[Held]) -> None:
    """The second half of the rounds after the warm-up must not hold more than the first half."""
    first, second = rounds[WARM_UP : WARM_UP + ROUNDS // 2], rounds[WARM_UP + ROUNDS // 2 :]
    memory = [one.own_mib for one in rounds]
    # the least of each: what is held for a moment is chance
    growth = min(one.own_mib for one in second) - min(one.own_mib for one in first)
    assert growth < MARGIN_MIB, memory
    assert second[-1].threads == first[-1].threads, rounds
    assert second[-1].files == first[-1].files, rounds


@pytest.fixture
def freed_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Large arrays go back to the system as soon as they are freed, instead of some time."""
    monkeypatch.setenv('MALLOC_MMAP_THRESHOLD_', '65536')
    monkeypatch.setenv('MALLOC_TRIM_THRESHOLD_', '65536')
    monkeypatch.setenv('MALLOC_ARENA_MAX', '1')


@pytest.mark.usefixtures('freed_at_once')
def test_up_and_down_leaves_nothing_behind(
    start_node: Callable[..., NodeProcess], robot: Robot, tiny_place: TinyPlace
) -> None:
    node = start_node('--map', str(tiny_place.map_path), autostart=False)
    robot.camera_info = camera_info(tiny_place.camera)
    rounds = []
    for _ in range(WARM_UP + ROUNDS):
        assert robot.change_state(Transition.TRANSITION_CONFIGURE)
        assert robot.change_state(Transition.TRANSITION_ACTIVATE)
        robot.mount_camera()
        robot.connect(node)
        robot.ask(robot.shot(tiny_place.queries[0][0]))
        assert robot.change_state(Transition.TRANSITION_DEACTIVATE)
        assert robot.change_state(Transition.TRANSITION_CLEANUP)
        robot.wait_until_alone()
        rounds.append(held_by(node))
    assert_flat(rounds)
    node.end_cleanly()


@pytest.mark.usefixtures('freed_at_once')
def test_map_after_map_leaves_none_behind(
    start_node: Callable[..., NodeProcess], robot: Robot, tiny_place: TinyPlace
) -> None:
    node = start_node('--map', str(tiny_place.map_path))
    robot.camera_info = camera_info(tiny_place.camera)
    robot.mount_camera()
    robot.connect(node)
    request = LoadMap.Request(path=str(tiny_place.map_path))
    rounds = []
    for _ in range(WARM_UP + ROUNDS):
        answer = robot.call(LoadMap, robot.topic('load_map'), request)
        assert answer.success, answer.message
        robot.ask(robot.shot(tiny_place.queries[0][0]))
        rounds.append(held_by(node))
    assert_flat(rounds)
    node.end_cleanly()
