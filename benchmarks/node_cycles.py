# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The node up and down again and again, and map after map, in one process; prints tables.

In every cycle the node is configured, activated, makes an attempt on the images of a robot
(`load_robot.py`: 1280x720 at 30 Hz, which go on coming), is deactivated and cleaned up, all by the
services of a managed node. After that it stays active and gets its map anew by `~/load_map`. Exits
with 1 when memory grows, or threads or files become more.

    python benchmarks/node_cycles.py
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from load_robot import CAMERA_INFO_TOPIC, DOMAIN_ID, IMAGE_TOPIC, render_views, robot_in
from process_usage import Resources, node_process, resources, wait_for
from scipy.stats import theilslopes

from gam_relocalizer.demo.shipped import demo_map_path
from gam_relocalizer.geometry import write_text
from gam_relocalizer_msgs.srv import LoadMap

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from load_robot import Robot

NODE = '/gam_relocalizer'
UP = (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE)
DOWN = (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP)
# What the libraries allocate once is there after so many rounds.
WARM_UP = 20
# Far below one map or one network per round.
MOST_SLOPE_MIB = 0.1


@dataclass(frozen=True)
class Series:
    """What the process held after every round.

    Attributes:
        name: Of what was done in a round.
        seconds: How long all rounds took.
        rounds: One for each, in their order.
    """

    name: str
    seconds: float
    rounds: tuple[Resources, ...]

    @property
    def slope_mib(self) -> float:
        """Growth of its own memory per round after the warm-up (Theil-Sen) [MiB]."""
        own_mib = [one.own_mib for one in self._warm]
        return float(theilslopes(own_mib).slope) if len(own_mib) > 1 else 0.0

    @property
    def is_flat(self) -> bool:
        """Whether nothing leaks."""
        first, last = self._warm[0], self._warm[-1]
        holds_more = last.threads > first.threads or last.files > first.files
        return self.slope_mib < MOST_SLOPE_MIB and not holds_more

    @property
    def _warm(self) -> tuple[Resources, ...]:
        return self.rounds[min(WARM_UP, len(self.rounds) // 2) :]


def main() -> None:
    """Does all rounds, prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--cycles', type=int, default=200, help='times up and down')
    parser.add_argument('--reloads', type=int, default=100, help='times another map')
    parser.add_argument('--out', type=Path, default=Path('build', 'benchmarks', 'node_cycles.json'))
    arguments = parser.parse_args()
    os.environ.setdefault('ROS_DOMAIN_ID', DOMAIN_ID)
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    series = _run(arguments.cycles, arguments.reloads)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    report = [asdict(one) | {'slope_mib': one.slope_mib, 'is_flat': one.is_flat} for one in series]
    write_text(arguments.out, f'{json.dumps(report, indent=2)}\n')
    print('\n\n'.join(map(_table, series)))
    sys.exit(not all(one.is_flat for one in series))


def _run(cycles: int, reloads: int) -> list[Series]:
    parameters = {'map': demo_map_path(), 'autostart': 'false', 'period': '0.2'}
    arguments = [word for item in parameters.items() for word in ('-p', '{}:={}'.format(*item))]
    command = [
        *(sys.executable, '-m', 'gam_relocalizer', 'node', '--ros-args', *arguments),
        *('-r', f'image:={IMAGE_TOPIC}', '-r', f'camera_info:={CAMERA_INFO_TOPIC}'),
    ]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log = folder / 'node.log'
        with (
            robot_in(folder, render_views(), compressed=False) as robot,
            node_process(command, log) as process,
        ):
            caller = _Caller(robot, lambda what, done: wait_for(done, what, process, log))
            series = [_rounds('cycle', cycles, process.pid, caller.cycle)]
            caller.change(*UP)
            series.append(_rounds('reload', reloads, process.pid, caller.reload))
    return [one for one in series if one.rounds]


def _rounds(name: str, count: int, pid: int, work: Callable[[], None]) -> Series:
    begin, rounds = time.monotonic(), []
    for _ in range(count):
        work()
        rounds.append(resources(pid))
    return Series(name, time.monotonic() - begin, tuple(rounds))


class _Caller:
    """Uses the services of the node."""

    def __init__(self, robot: Robot, wait: Callable[[str, Callable[[], object]], None]) -> None:
        self._robot = robot
        self._wait = wait
        self._change = robot.node.create_client(ChangeState, f'{NODE}/change_state')
        self._load = robot.node.create_client(LoadMap, f'{NODE}/load_map')
        for client in (self._change, self._load):
            wait('a service of the node', client.service_is_ready)
        time.sleep(1.0)  # the node has not found this end yet, and would have nobody to answer

    def cycle(self) -> None:
        """Up, an attempt, and down."""
        self.change(*UP)
        self._wait_for_attempts(1)
        self.change(*DOWN)

    def reload(self) -> None:
        """The map anew, while attempts go on; then one with it."""
        answer = self._call(self._load, LoadMap.Request(path=str(demo_map_path())))
        if not answer.success:
            sys.exit(f'the map was not loaded: {answer.message}')
        self._wait_for_attempts(1)

    def change(self, *transitions: int) -> None:
        """One transition after the other."""
        for transition in transitions:
            request = ChangeState.Request(transition=Transition(id=transition))
            if not self._call(self._change, request).success:
                sys.exit(f'transition {transition} failed')

    def _wait_for_attempts(self, count: int) -> None:
        heard = self._robot.heard
        until = heard.attempts + count
        self._wait('an attempt', lambda: heard.attempts >= until)

    def _call(self, client: Any, request: object) -> Any:  # noqa: ANN401 - of two services
        future = client.call_async(request)
        self._wait(f'an answer of {client.srv_name}', future.done)
        return future.result()


def _table(series: Series) -> str:
    """Every tenth of the rounds."""
    step = max(1, len(series.rounds) // 10)
    head = f'| {series.name}s | memory [MiB] | resident [MiB] | threads | files |'
    shown = [(number, series.rounds[number - 1]) for number in _shown(len(series.rounds), step)]
    lines = [
        f'| {number} | {one.own_mib:.1f} | {one.resident_mib:.1f} | {one.threads} | {one.files} |'
        for number, one in shown
    ]
    verdict = 'flat' if series.is_flat else 'NOT FLAT'
    said = (
        f'{series.slope_mib:+.4f} MiB per {series.name} after the warm-up (target: under '
        f'{MOST_SLOPE_MIB}), {series.seconds / len(series.rounds):.1f} s each: {verdict}'
    )
    return '\n'.join([head, '|---' * 5 + '|', *lines, '', said])


def _shown(count: int, step: int) -> Sequence[int]:
    return (
        [1, *np.arange(step, count + 1, step).tolist()] if step > 1 else list(range(1, count + 1))
    )


if __name__ == '__main__':
    main()
