# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`evaluate matching`: matchers against the tracks of maps."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from gam_relocalizer.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from rich.progress import TaskID

    from gam_relocalizer.mapping import progress as mapping_progress
    from gam_relocalizer.matching.matcher import Matcher

app = typer.Typer(help='Measure how good the parts are.', no_args_is_help=True)


@app.callback()
def _root() -> None:
    pass


@app.command()
def matching(
    maps: Annotated[
        list[Path],
        typer.Option('--map', help='A map bundle with its COLMAP model; may be given repeatedly.'),
    ],
    images: Annotated[
        list[Path],
        typer.Option(help='The folder of images that the map was built from, one per --map.'),
    ],
    matcher: Annotated[
        list[str] | None,
        typer.Option(help='Name of a matcher, repeatedly; by default all of the two tables.'),
    ] = None,
    keypoints: Annotated[
        int | None, typer.Option(min=1, help='Use the best so many keypoints of an image.')
    ] = None,
    every: Annotated[
        int, typer.Option(min=1, help='Take every so many-th image of a map as a query.')
    ] = 1,
    neighbours: Annotated[
        str | None,
        typer.Option(
            metavar='MATCHER',
            help='Also draw the figure over k = 1..8 for this learned matcher (the paper: bmnet); '
            'needs --out.',
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help='Folder for matching.md, matching.json and neighbours.png.'),
    ] = None,
) -> None:
    """Compare matchers: every image of a map against the map without it.

    Precision and recall tell how many of the true correspondences, those of the tracks, are found;
    the errors are those of the poses from the matches. The mean counts every map the same.
    """
    from gam_relocalizer.evaluation.matching import EvaluationOptions, evaluate_map
    from gam_relocalizer.evaluation.matching_report import (
        DEFAULT_MATCHERS,
        MatchingReport,
        markdown,
        write_report,
    )
    from gam_relocalizer.mapping.leave_one_out import read_reference_images
    from gam_relocalizer.scene_map import load_map

    _check_pairs(maps, images)
    if neighbours is not None and out is None:
        msg = '--neighbours draws a figure: tell with --out in which folder to put it'
        raise UsageError(msg)
    names = tuple(dict.fromkeys(matcher or DEFAULT_MATCHERS))
    matchers = _create_matchers(names, neighbours)
    scene_maps = [load_map(path) for path in maps]
    if out is not None:
        _prepare_folder(out)
    options = EvaluationOptions(keypoints, every)
    evaluations = []
    for scene_map, folder in zip(scene_maps, images, strict=True):
        with _progress_bars(scene_map.path.resolve().name) as progress:
            references = read_reference_images(scene_map, folder, progress)
            evaluations.append(evaluate_map(references, matchers, options, progress))
    report = MatchingReport(evaluations, names, options, neighbours)
    typer.echo(markdown(report), nl=False)
    if out is not None:
        write_report(out, report)


def _check_pairs(maps: Sequence[Path], images: Sequence[Path]) -> None:
    if len(maps) != len(images):
        msg = (
            f'every --map needs the --images it was built from, in the same order: found '
            f'{len(maps)} maps and {len(images)} folders of images'
        )
        raise UsageError(msg)
    for folder in images:
        if not folder.is_dir():
            msg = f'{folder}: no such folder of images'
            raise UsageError(msg)


def _create_matchers(names: Sequence[str], swept: str | None) -> dict[str, Matcher]:
    """The matchers by name, and those of the figure by the name of their candidacy."""
    from gam_relocalizer.evaluation.neighbours import CANDIDACIES
    from gam_relocalizer.matching.registry import create_matcher

    matchers: dict[str, Matcher] = {name: create_matcher(name) for name in names}
    if swept is not None:
        matchers |= {
            one.name: create_matcher(swept, neighbours=one.neighbours, ratio=one.ratio)
            for one in CANDIDACIES
        }
    return matchers


def _prepare_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as err:
        msg = f'{out}: is no folder and cannot be made one: {err.strerror}'
        raise UsageError(msg) from err


@contextmanager
def _progress_bars(name: str) -> Iterator[mapping_progress.Progress]:
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
