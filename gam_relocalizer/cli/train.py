# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`gam_relocalizer train`: train BMNet on synthetic graphs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

if TYPE_CHECKING:
    from rich.progress import TaskID

    from gam_relocalizer.training.metrics import MatchMetrics

SMOOTHING = 0.02


class _Display:
    """Progress of a run on the terminal."""

    def __init__(self, progress: Progress, task: TaskID) -> None:
        self._progress = progress
        self._task = task
        self._loss: float | None = None

    def on_step(self, step: int, loss: float) -> None:
        """Move the bar."""
        self._loss = loss if self._loss is None else self._loss + SMOOTHING * (loss - self._loss)
        self._progress.update(self._task, completed=step, loss=f'loss {self._loss:.4f}')

    def on_validation(self, step: int, metrics: MatchMetrics) -> None:
        """Print a line."""
        self._progress.print(
            f'step {step}: precision {metrics.precision:.3f}, recall {metrics.recall:.3f}, '
            f'average precision {metrics.average_precision:.3f}',
            highlight=False,
        )


def train(
    *,
    out: Annotated[Path, typer.Option(help='Directory for checkpoint, log, curves and weights.')],
    steps: Annotated[int, typer.Option(min=1, help='Steps of the optimiser.')] = 9_600,
    seed: Annotated[int, typer.Option(min=0, help='Of weights and graphs.')] = 0,
    resume: Annotated[
        bool, typer.Option('--resume', help='Continue from the checkpoint in the directory.')
    ] = False,
) -> None:
    """Train the matching network on synthetic graphs (no images needed, one or two CPU cores)."""
    from gam_relocalizer.training.loop import WEIGHTS_NAME, Trainer, TrainingOptions

    trainer = Trainer(TrainingOptions(steps=steps, seed=seed), out)
    if resume:
        trainer.resume()
    console = Console()
    columns = (
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn('{task.fields[loss]}'),
    )
    with Progress(*columns, console=console) as progress:
        task = progress.add_task('train', total=steps, completed=trainer.step, loss='')
        metrics = trainer.run(_Display(progress, task))
    console.print(
        f'trained {trainer.step} steps: average precision {metrics.average_precision:.3f}; '
        f'weights in {out / WEIGHTS_NAME}',
        highlight=False,
        soft_wrap=True,
    )
