# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The node as a process, and what it uses as Linux tells it; for the benchmarks of the node."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

ANSWER_LIMIT_S = 60.0
STOP_LIMIT_S = 20.0
_TICKS_PER_S = os.sysconf('SC_CLK_TCK')
_KIBIBYTES_PER_MEBIBYTE = 1024


def cpu_seconds(pid: int) -> float:
    """Processor time of all threads so far [s]."""
    # the name of the command is in parentheses and may hold blanks
    fields = Path(f'/proc/{pid}/stat').read_text(encoding='ascii').rpartition(')')[2].split()
    user, system = int(fields[11]), int(fields[12])
    return (user + system) / _TICKS_PER_S


@dataclass(frozen=True)
class Resources:
    """What could leak.

    Attributes:
        own_mib: Memory of its own: resident, without files and shared memory [MiB].
        resident_mib: All of it that is resident [MiB].
        threads: Number of threads.
        files: Number of open file descriptors.
    """

    own_mib: float
    resident_mib: float
    threads: int
    files: int


def resources(pid: int) -> Resources:
    """What a process holds now."""
    lines = Path(f'/proc/{pid}/status').read_text(encoding='utf-8').splitlines()
    fields = {name: value.split() for name, _, value in (line.partition(':') for line in lines)}
    return Resources(
        own_mib=int(fields['RssAnon'][0]) / _KIBIBYTES_PER_MEBIBYTE,
        resident_mib=int(fields['VmRSS'][0]) / _KIBIBYTES_PER_MEBIBYTE,
        threads=int(fields['Threads'][0]),
        files=len(list(Path(f'/proc/{pid}/fd').iterdir())),
    )


@contextmanager
def node_process(command: Sequence[str], log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A process that ends as a launch file ends it.

    Args:
        command: What to run.
        log: File for what it says.
    """
    with log.open('wb') as output:
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)
    try:
        yield process
        process.send_signal(signal.SIGINT)
        process.wait(STOP_LIMIT_S)
    finally:
        process.kill()
        process.wait()


def wait_for(
    condition: Callable[[], object], what: str, process: subprocess.Popen[bytes], log: Path
) -> None:
    """Waits; ends the benchmark with the log when the process has ended, or takes too long."""
    give_up = time.monotonic() + ANSWER_LIMIT_S
    while not condition():
        if process.poll() is not None or time.monotonic() > give_up:
            sys.exit(f'{log.read_text(encoding="utf-8")}\nwaited for {what} in vain')
        time.sleep(0.01)
