# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The node under the load of a robot: 1280x720 at 30 Hz; prints a Markdown table.

The real node runs in a process of its own, by default settings of DDS, with the map of the demo. A
robot (`load_robot.py`) publishes images as sensor data, odometry and /tf. Two runs for raw images
and two for compressed ones: one with a period so long that after the first attempt there is
nothing but input, for the callback and the processor; one with the default period, for memory.
Exits with 1 when a target is missed.

    python benchmarks/node_load.py --minutes 30
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from load_robot import CAMERA_INFO_TOPIC, DOMAIN_ID, IMAGE_TOPIC, render_views, robot_in
from process_usage import cpu_seconds, node_process, resources, wait_for
from scipy.stats import theilslopes
from timed_node import CallbackTimes

from gam_relocalizer.demo.shipped import demo_map_path
from gam_relocalizer.geometry import write_text
from gam_relocalizer.ros.parameters import NodeParameters

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from load_robot import Robot, View

TRANSPORTS = ('raw', 'compressed')
# So long that only the first attempt falls into the run [s].
ONCE = 3600.0
SETTLE_S = 5.0
# Of the run with attempts: what the libraries allocate once is there after it [s].
WARM_UP_S = 60.0

MOST_CALLBACK_MS = 2.0
MOST_CPU_PERCENT = 15.0
LEAST_ARRIVING = 0.95
MOST_GROWTH_MIB = 10.0


@dataclass(frozen=True)
class Input:
    """What images that are not tried cost.

    Attributes:
        images_per_s: That reached the node.
        images_sent_per_s: By the robot.
        cpu_percent: Of one core, the whole process.
        take_ms: Median of taking an image out of DDS: copied, deserialised.
        take_95_ms: 95 % are quicker.
        callback_ms: Median of the node's own callback.
        callback_95_ms: 95 % are quicker.
        image_ms: Median of both together.
    """

    images_per_s: float
    images_sent_per_s: float
    cpu_percent: float
    take_ms: float
    take_95_ms: float
    callback_ms: float
    callback_95_ms: float
    image_ms: float


@dataclass(frozen=True)
class Memory:
    """What the node holds while it relocalizes.

    Attributes:
        minutes: How long it was watched.
        attempts: Of the node in this time.
        fixes: Accepted ones.
        cpu_percent: Of one core, attempts included.
        begin_mib: Memory of its own after the warm-up [MiB]: resident, not shared, no files;
            median of the first tenth of the time.
        end_mib: The same of the last tenth.
        slope_mib_per_min: In between, the median slope (Theil-Sen).
    """

    minutes: float
    attempts: int
    fixes: int
    cpu_percent: float
    begin_mib: float
    end_mib: float
    slope_mib_per_min: float


@dataclass(frozen=True)
class Row:
    """Both runs with one transport."""

    transport: str
    input: Input
    memory: Memory

    @property
    def missed(self) -> list[str]:
        """The targets that were missed."""
        checks = {
            f'{LEAST_ARRIVING:.0%} of the images': (
                self.input.images_per_s >= LEAST_ARRIVING * self.input.images_sent_per_s
            ),
            f'{MOST_CALLBACK_MS:.0f} ms median': self.input.image_ms < MOST_CALLBACK_MS,
            f'{MOST_CPU_PERCENT:.0f} % of a core': self.input.cpu_percent < MOST_CPU_PERCENT,
            f'{MOST_GROWTH_MIB:.0f} MiB growth': self.growth_mib < MOST_GROWTH_MIB,
            'a fix': self.memory.fixes > 0,
        }
        return [f'{self.transport}: {name}' for name, is_met in checks.items() if not is_met]

    @property
    def growth_mib(self) -> float:
        """By the slope, over the time watched [MiB]."""
        return self.memory.slope_mib_per_min * self.memory.minutes


def main() -> None:
    """Runs everything, prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--minutes', type=float, default=1.0, help='how long memory is watched')
    parser.add_argument('--seconds', type=float, default=20.0, help='how long input is measured')
    parser.add_argument('--transports', nargs='+', choices=TRANSPORTS, default=list(TRANSPORTS))
    parser.add_argument('--out', type=Path, default=Path('build', 'benchmarks', 'node_load.json'))
    arguments = parser.parse_args()
    os.environ.setdefault('ROS_DOMAIN_ID', DOMAIN_ID)
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    views = render_views()
    rows = []
    for transport in arguments.transports:
        measured = _measure_input(transport, views, arguments.seconds)
        rows.append(Row(transport, measured, _watch(transport, views, arguments.minutes)))
    missed = [target for row in rows for target in row.missed]
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    report = {'rows': [asdict(row) for row in rows], 'missed': missed}
    write_text(arguments.out, f'{json.dumps(report, indent=2)}\n')
    print(_table(rows))
    print(f'\nmissed: {"; ".join(missed) or "nothing"}')
    sys.exit(bool(missed))


@dataclass(frozen=True)
class _Run:
    """The node, and what can be seen of it."""

    pid: int
    times: CallbackTimes
    robot: Robot


@contextmanager
def _node_under_load(transport: str, views: Sequence[View], period_s: float) -> Iterator[_Run]:
    """From the first attempt on."""
    compressed = transport == 'compressed'
    topic = IMAGE_TOPIC + ('/compressed' if compressed else '')
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        times = CallbackTimes.create(folder / 'times')
        parameters = {
            'map': demo_map_path(),
            'period': f'{period_s:.1f}',
            'image_transport': transport,
        }
        arguments = [word for item in parameters.items() for word in ('-p', '{}:={}'.format(*item))]
        command = [
            sys.executable,
            str(Path(__file__).with_name('timed_node.py')),
            *(str(folder / 'times'), topic, '--ros-args', *arguments),
            *('-r', f'image:={IMAGE_TOPIC}', '-r', f'camera_info:={CAMERA_INFO_TOPIC}'),
        ]
        with (
            robot_in(folder, views, compressed=compressed) as robot,
            node_process(command, folder / 'node.log') as process,
        ):
            wait_for(lambda: robot.heard.attempts, 'an attempt', process, folder / 'node.log')
            time.sleep(SETTLE_S)
            yield _Run(process.pid, times, robot)


def _measure_input(transport: str, views: Sequence[View], seconds: float) -> Input:
    with _node_under_load(transport, views, ONCE) as run:
        begin, cpu = time.monotonic(), cpu_seconds(run.pid)
        count, sent = run.times.count, run.robot.images_sent
        time.sleep(seconds)
        elapsed = time.monotonic() - begin
        sent = run.robot.images_sent - sent
        images, cpu = run.times.count - count, cpu_seconds(run.pid) - cpu
        taken, handled = run.times.since(count)
    return Input(
        images_per_s=images / elapsed,
        images_sent_per_s=sent / elapsed,
        cpu_percent=100 * cpu / elapsed,
        take_ms=_milliseconds(taken, 50),
        take_95_ms=_milliseconds(taken, 95),
        callback_ms=_milliseconds(handled, 50),
        callback_95_ms=_milliseconds(handled, 95),
        image_ms=_milliseconds(taken + handled, 50),
    )


def _milliseconds(seconds: np.ndarray, percent: float) -> float:
    return float(1e3 * np.percentile(seconds, percent)) if len(seconds) else float('nan')


def _watch(transport: str, views: Sequence[View], minutes: float) -> Memory:
    with _node_under_load(transport, views, NodeParameters().period) as run:
        time.sleep(WARM_UP_S)
        begin, cpu = time.monotonic(), cpu_seconds(run.pid)
        attempts, fixes = run.robot.heard.attempts, run.robot.heard.fixes
        samples = []
        while (elapsed := time.monotonic() - begin) < 60 * minutes:
            samples.append((elapsed / 60, resources(run.pid).own_mib))
            time.sleep(1.0)
        cpu = cpu_seconds(run.pid) - cpu
        times, own_mib = np.array(samples).T
        tenth = max(1, len(own_mib) // 10)
        return Memory(
            minutes=minutes,
            attempts=run.robot.heard.attempts - attempts,
            fixes=run.robot.heard.fixes - fixes,
            cpu_percent=100 * cpu / elapsed,
            begin_mib=float(np.median(own_mib[:tenth])),
            end_mib=float(np.median(own_mib[-tenth:])),
            slope_mib_per_min=float(theilslopes(own_mib, times).slope),
        )


def _table(rows: Sequence[Row]) -> str:
    """A line per measure, a column per transport."""
    measures: dict[str, Callable[[Row], str]] = {
        f'images sent / that reach the node [1/s] (target: {LEAST_ARRIVING:.0%})': lambda row: (
            f'{row.input.images_sent_per_s:.1f} / {row.input.images_per_s:.1f}'
        ),
        'an image taken from DDS, median / 95 % [ms]': lambda row: (
            f'{row.input.take_ms:.2f} / {row.input.take_95_ms:.2f}'
        ),
        'its callback, median / 95 % [ms]': lambda row: (
            f'{row.input.callback_ms:.3f} / {row.input.callback_95_ms:.3f}'
        ),
        f'both, median [ms] (target: under {MOST_CALLBACK_MS:.0f})': lambda row: (
            f'{row.input.image_ms:.2f}'
        ),
        f'CPU without attempts [% of a core] (target: under {MOST_CPU_PERCENT:.0f})': lambda row: (
            f'{row.input.cpu_percent:.1f}'
        ),
        f'CPU with an attempt each {NodeParameters().period:g} s [% of a core]': lambda row: (
            f'{row.memory.cpu_percent:.0f}'
        ),
        'attempts / fixes while memory is watched': lambda row: (
            f'{row.memory.attempts} / {row.memory.fixes}'
        ),
        'memory after the warm-up / at the end [MiB]': lambda row: (
            f'{row.memory.begin_mib:.0f} / {row.memory.end_mib:.0f}'
        ),
        'slope of memory [MiB/min]': lambda row: f'{row.memory.slope_mib_per_min:+.3f}',
        f'growth in {rows[0].memory.minutes:g} min by it [MiB] (target: under '
        f'{MOST_GROWTH_MIB:.0f})': lambda row: f'{row.growth_mib:+.1f}',
    }
    head = f'| | {" | ".join(row.transport for row in rows)} |'
    lines = [f'| {name} | {" | ".join(map(of, rows))} |' for name, of in measures.items()]
    return '\n'.join([head, '|---' * (len(rows) + 1) + '|', *lines])


if __name__ == '__main__':
    main()
