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
    from collections.abc import Iterator, Mapping, Sequence

    from rich.progress import TaskID

    from gam_relocalizer.mapping import progress as mapping_progress
    from gam_relocalizer.mapping.report import BuildReport
    from gam_relocalizer.mapping.workspace import Workspace

_LISTED_NAMES = 10
_UNITS = {'extract': 'images', 'match': 'pairs', 'verify': 'pairs', 'sfm': 'images'}
MapArgument = Annotated[Path, typer.Argument(metavar='MAP', help='A map bundle.')]
# As a full path: a new map takes the place of the folder that `.` stood for.
OutOption = Annotated[
    Path,
    typer.Option(help='The map bundle to write; replaced if it is one.', resolve_path=True),
]
BitsOption = Annotated[
    int,
    typer.Option('--descriptor-bits', help='Kept of each number of a local descriptor: 16, or 8.'),
]
DiscardOption = Annotated[
    bool,
    typer.Option(
        '--discard-work',
        help='Remove the folder OUT.work, with the finished steps, when the map is complete.',
    ),
]


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


def print_warnings(warnings: Sequence[str]) -> None:
    """Prints what is to be looked at, a line each."""
    for warning in warnings:
        typer.echo(f'warning: {warning}')


def print_build(
    report: BuildReport,
    out: Path,
    workspace: Workspace | None,
    more: Mapping[str, str] | None = None,
) -> None:
    """Prints what came of a build or an import, and what to look at.

    Args:
        report: Its numbers.
        out: The map.
        workspace: Where its finished steps are, if anywhere.
        more: Further rows of the table.
    """
    left_out = {
        'found no place': list(report.unregistered),
        'could not be read': list(report.unreadable),
        'have no pose': list(report.without_pose),
    }
    rows = {
        'images in the map': f'{report.images_registered} of {report.images_given}',
        'image pairs': f'{report.pairs_verified} of {report.pairs_matched} show the same thing',
        'points': f'{report.points}',
        'observations': f'{report.observations}, {report.mean_track_length:.1f} per point',
        'mean reprojection error': f'{report.mean_reprojection_error:.2f} px',
        **{f'images that {why}': some_of(names) for why, names in left_out.items() if names},
        **{f'camera {i}': line for i, line in enumerate(report.cameras, start=1)},
        'seconds': ', '.join(f'{step} {spent:.1f}' for step, spent in report.seconds.items()),
    }
    if not report.pairs_matched:
        del rows['image pairs']
    if report.other_models:
        sizes = ', '.join(map(str, report.other_models))
        rows['dropped models'] = f'separate pieces of {sizes} images'
    if any(report.reused.values()):
        rows['from the workspace'] = ', '.join(
            f'{step} {count} {_UNITS[step]}' for step, count in report.reused.items() if count
        )
    if workspace is not None and workspace.path.exists():
        rows['workspace'] = (
            f'{workspace.path.name}, {workspace.size / 2**20:.0f} MiB: finished steps, for a '
            f'further build; may be deleted'
        )
    print_table(f'{out}', {**rows, **(more or {})})
    print_warnings(report.warnings)
