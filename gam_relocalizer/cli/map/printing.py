# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What the `map` commands print: progress on stderr, results on stdout."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.progress import TaskID

    from gam_relocalizer.mapping import progress as mapping_progress

_LISTED_NAMES = 10
MapArgument = Annotated[Path, typer.Argument(metavar='MAP', help='A map bundle.')]


@contextmanager
def progress_bars() -> Iterator[mapping_progress.Progress]:
    """One bar per step, on stderr, so that stdout carries only the result."""
    bars = Progress(
        TextColumn('{task.description:<8}'),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=Console(stderr=True),
    )
    tasks: dict[str, TaskID] = {}

    def advance(step: str, done: int, total: int) -> None:
        if step not in tasks:
            tasks[step] = bars.add_task(step)
        bars.update(tasks[step], completed=done, total=total)

    with bars:
        yield advance


def print_table(title: str, rows: dict[str, str]) -> None:
    """Prints rows of a name and a value on stdout."""
    table = Table(title=title, show_header=False, title_justify='left')
    for name, value in rows.items():
        table.add_row(name, value)
    Console(soft_wrap=True).print(table, markup=False, highlight=False)


def some_of(names: list[str]) -> str:
    """The first few names, and how many there are."""
    shown = ', '.join(names[:_LISTED_NAMES])
    return shown if len(names) <= _LISTED_NAMES else f'{shown}, ... ({len(names)})'
