# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`evaluate matching`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gam_relocalizer.cli.evaluate.outputs import prepare_folder, progress_bars
from gam_relocalizer.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from gam_relocalizer.matching.matcher import Matcher


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
        typer.Option(help='Folder for matching.html, matching.md, matching.json and figures.'),
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
        prepare_folder(out)
    options = EvaluationOptions(keypoints, every)
    evaluations = []
    for scene_map, folder in zip(scene_maps, images, strict=True):
        with progress_bars(scene_map.path.resolve().name) as progress:
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
