# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`evaluate matching` and `evaluate localization`: the parts and the whole against the truth."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from gam_relocalizer.cli.options import GlobalWeightsOption
from gam_relocalizer.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from rich.progress import TaskID

    from gam_relocalizer.mapping import progress as mapping_progress
    from gam_relocalizer.matching.matcher import Matcher
    from gam_relocalizer.scene_map import SceneMap

app = typer.Typer(help='Measure how good the parts are.', no_args_is_help=True)


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


@app.command()
def localization(  # noqa: PLR0913 - one argument per option
    maps: Annotated[
        list[Path], typer.Option('--map', help='A map bundle; may be given repeatedly.')
    ],
    queries: Annotated[
        list[Path], typer.Option(help='The folder of images to localize, one per --map.')
    ],
    truth: Annotated[
        list[Path],
        typer.Option(
            help='Their true poses, one file per --map: lines `name qw qx qy qz tx ty tz`, '
            'camera_from_world. Images it does not name are left out.'
        ),
    ],
    *,
    camera: Annotated[
        list[str] | None,
        typer.Option(
            help='Their camera, one per --map: file or text `MODEL WIDTH HEIGHT PARAMS...`; by '
            'default the one that took the images of the map.'
        ),
    ] = None,
    reference: Annotated[
        list[Path] | None,
        typer.Option(
            help='True poses of the images of the map, one file per --map: lays a map that is not '
            'metric over the truth by a similarity.'
        ),
    ] = None,
    matcher: Annotated[
        list[str] | None,
        typer.Option(
            help='Name of a matcher, repeatedly, by default all of the table; the last one is '
            'also that of the rows IR, CC and SR.'
        ),
    ] = None,
    global_weights: GlobalWeightsOption = None,
    retrieved: Annotated[int, typer.Option(min=1, help='Reference images retrieved, R.')] = 10,
    out: Annotated[
        Path | None,
        typer.Option(help='Folder for localization.md, localization.json and figures.'),
    ] = None,
) -> None:
    """Localize images with known poses: matchers and ways to choose scenes, compared.

    Recall is the share of the images within a position and an angle of the truth; once for all
    poses that were found, as in papers, and once for those that the verdict accepted.
    """
    from gam_relocalizer.evaluation.localization import evaluate_set, read_query_set
    from gam_relocalizer.evaluation.localization_report import (
        DEFAULT_MATCHERS,
        LocalizationReport,
        markdown,
        write_report,
    )
    from gam_relocalizer.features.registry import create_extractor, global_descriptor_of
    from gam_relocalizer.matching.registry import create_matcher

    cameras: Sequence[str | None] = camera or [None] * len(maps)
    references: Sequence[Path | None] = reference or [None] * len(maps)
    _check_sets(maps, queries=queries, truth=truth, camera=cameras, reference=references)
    query_sets = [
        read_query_set(*one) for one in zip(maps, queries, truth, cameras, references, strict=True)
    ]
    _check_global_weights(global_weights, [one.scene_map for one in query_sets])
    if out is not None:
        _prepare_folder(out)
    evaluations = []
    for query_set in query_sets:
        scene_map, manifest = query_set.scene_map, query_set.scene_map.manifest
        extractor = manifest.extractor.name
        describer = global_descriptor_of(
            scene_map, global_weights if manifest.retrieval_weights_sha256 else None
        )
        matchers = {
            name: create_matcher(name, extractor=extractor) for name in matcher or DEFAULT_MATCHERS
        }
        with _progress_bars(scene_map.path.resolve().name) as progress:
            evaluations.append(
                evaluate_set(
                    query_set,
                    create_extractor(extractor),
                    describer,
                    matchers,
                    retrieved,
                    progress,
                )
            )
    report = LocalizationReport(evaluations, retrieved)
    typer.echo(markdown(report), nl=False)
    if out is not None:
        write_report(out, report)


def _check_sets(maps: Sequence[Path], **given: Sequence[object]) -> None:
    for name, values in given.items():
        if len(values) != len(maps):
            msg = (
                f'every --map needs its own --{name}, in the same order: found {len(maps)} maps '
                f'and {len(values)} of --{name}'
            )
            raise UsageError(msg)


def _check_global_weights(weights: Path | None, scene_maps: Sequence[SceneMap]) -> None:
    if weights is not None and not any(one.manifest.retrieval_weights_sha256 for one in scene_maps):
        msg = f'{weights}: none of the maps has a global descriptor with weights; leave them out'
        raise UsageError(msg)


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
