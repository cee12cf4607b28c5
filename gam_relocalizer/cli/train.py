# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`gam_relocalizer train`: train a matching network, or fine-tune it on a map."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from gam_relocalizer.errors import UsageError

if TYPE_CHECKING:
    from rich.progress import TaskID

    from gam_relocalizer.mapping.leave_one_out import ReferenceImages
    from gam_relocalizer.training.loop import Trainer
    from gam_relocalizer.training.metrics import MatchMetrics
    from gam_relocalizer.training.sources import MapUse

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
    matcher: Annotated[str, typer.Option(help='The matcher to train the network of.')] = 'gam',
    maps: Annotated[
        list[Path] | None,
        typer.Option('--map', help='A map to learn from; starts from the shipped weights.'),
    ] = None,
    images: Annotated[
        list[Path] | None,
        typer.Option(help='The folder of images that the map was built from, one for each --map.'),
    ] = None,
    from_scratch: Annotated[
        bool, typer.Option('--from-scratch', help='Start from random weights with maps as well.')
    ] = False,
    steps: Annotated[
        int | None,
        typer.Option(min=1, help='Steps of the optimiser; 1000 from shipped weights, else 9600.'),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help='Of weights and graphs.')] = 0,
    resume: Annotated[
        bool, typer.Option('--resume', help='Continue from the checkpoint in the directory.')
    ] = False,
) -> None:
    """Train a matching network on synthetic graphs, or fine-tune it on maps (CPU will do)."""
    from gam_relocalizer.matching.registry import LEARNED_MATCHERS
    from gam_relocalizer.training.loop import Trainer, check_unused
    from gam_relocalizer.training.recipes import fine_tuning, recipe

    maps, images = maps or [], images or []
    if len(maps) != len(images):
        msg = (
            f'{len(maps)} --map and {len(images)} --images: give each map the folder of images '
            'that it was built from'
        )
        raise UsageError(msg)
    fine_tunes = bool(maps) and not from_scratch
    options = fine_tuning(matcher) if fine_tunes else recipe(matcher)
    start = LEARNED_MATCHERS[matcher].shipped if fine_tunes else None
    options = replace(options, seed=seed, steps=steps or options.steps)
    if not resume:
        check_unused(out)
    with _progress() as progress:
        references = [_read(*pair, progress) for pair in zip(maps, images, strict=True)]
        trainer = Trainer(options, out, references, start)
        if resume:
            trainer.resume()
        for use in trainer.map_uses:
            progress.print(_use_told(use), markup=False, highlight=False)
        _run(trainer, options.steps, progress)
    _print_result(out)


def _progress() -> Progress:
    return Progress(
        TextColumn('{task.description}'),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn('{task.fields[loss]}'),
        console=Console(stderr=True),
    )


def _read(map_path: Path, images: Path, progress: Progress) -> ReferenceImages:
    from gam_relocalizer.mapping.leave_one_out import read_reference_images
    from gam_relocalizer.scene_map import load_map

    task = progress.add_task(f'read {map_path.name}', total=None, loss='')

    def on_image(step: str, done: int, total: int) -> None:  # noqa: ARG001
        progress.update(task, completed=done, total=total)

    return read_reference_images(load_map(map_path), images, on_image)


def _use_told(use: MapUse) -> str:
    told = f'{use.name}: {use.queries} images to learn from, {use.held_out} held out to validate on'
    if use.left_out:
        told += f', {use.left_out} left out that share too little with the others'
    return told


def _run(trainer: Trainer, steps: int, progress: Progress) -> None:
    task = progress.add_task('train', total=steps, completed=trainer.step, loss='')
    with _stopped_by_interrupt(trainer, progress):
        trainer.run(_Display(progress, task))


@contextmanager
def _stopped_by_interrupt(trainer: Trainer, progress: Progress) -> Iterator[None]:
    """Lets the first interrupt end the run after a whole step, and a second one at once."""

    def stop(*_: object) -> None:
        signal.signal(signal.SIGINT, at_once)
        trainer.stop()

    at_once = signal.signal(signal.SIGINT, stop)
    try:
        yield
    except KeyboardInterrupt:
        progress.print('stopped; the same command with --resume goes on from the last checkpoint')
        raise
    finally:
        signal.signal(signal.SIGINT, at_once)


def _print_result(out: Path) -> None:
    from gam_relocalizer.training.loop import WEIGHTS_NAME, read_log

    records = read_log(out)
    first, last = records[0], records[-1]
    told = f'trained {last["step"]} steps: average precision {last["average_precision"]:.3f}'
    if first['step'] == 0:
        told += f' after {first["average_precision"]:.3f} at the start'
    told += f'; weights in {out / WEIGHTS_NAME}'
    if first['step'] == 0 and last['average_precision'] <= first['average_precision']:
        told += '; these are no better: rather keep those that the run started from'
    Console().print(told, markup=False, highlight=False, soft_wrap=True)
