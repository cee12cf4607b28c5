# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What all evaluations share: a folder for their results, and bars of progress."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from gam_relocalizer.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from rich.progress import TaskID

    from gam_relocalizer.mapping import progress as mapping_progress


def prepare_folder(out: Path) -> None:
    """Makes the folder for results, unless it is there.

    Raises:
        UsageError: It cannot be made.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as err:
        msg = f'{out}: is no folder and cannot be made one: {err.strerror}'
        raise UsageError(msg) from err


@contextmanager
def progress_bars(name: str) -> Iterator[mapping_progress.Progress]:
    """One bar per step, on stderr, so that stdout carries only the tables."""
    bars = Progress(
        TextColumn('{task.description}', markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(elapsed_when_finished=True),
        console=Console(stderr=True),
    )
    tasks: dict[str, TaskID] = {}

    def advance(step: str, done: int, total: int) -> None:
        if step not in tasks:
            tasks[step] = bars.add_task(f'{name}: {step}')
        bars.update(tasks[step], completed=done, total=total)

    with bars:
        yield advance
