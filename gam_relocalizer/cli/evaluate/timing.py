# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`evaluate timing`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gam_relocalizer.cli.evaluate.outputs import prepare_folder, progress_bars
from gam_relocalizer.cli.evaluate.query_options import (
    CameraOption,
    DatasetOption,
    EveryOption,
    LayoutOption,
    MapsOption,
    QueriesOption,
    QueryListOption,
    QueryOptions,
    ReferenceOption,
    TruthOption,
    check_global_weights,
    check_one_per_map,
    read_query_sets,
)
from gam_relocalizer.cli.options import GlobalWeightsOption
from gam_relocalizer.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from gam_relocalizer.evaluation.query_set import QuerySet
    from gam_relocalizer.evaluation.timing import SetTiming


def timing(  # noqa: PLR0913 - one argument per option
    maps: MapsOption,
    *,
    images: Annotated[
        list[Path] | None,
        typer.Option(
            help='The folder of images that the map was built from, one per --map: also times '
            'matching with these images, as others localize. The map must be one of XFeat.'
        ),
    ] = None,
    queries: QueriesOption = None,
    truth: TruthOption = None,
    query_list: QueryListOption = None,
    dataset: DatasetOption = None,
    layout: LayoutOption = None,
    camera: CameraOption = None,
    reference: ReferenceOption = None,
    every: EveryOption = 1,
    retrieved: Annotated[
        list[int] | None,
        typer.Option(
            min=1,
            help='Number of retrieved reference images, R, repeatedly; by default 1, 2, 3, 5, 10, '
            '15, 20. The default of the localizer, 10, is always among them.',
        ),
    ] = None,
    global_weights: GlobalWeightsOption = None,
    out: Annotated[
        Path | None,
        typer.Option(help='Folder for timing.md, timing.json, timing.png and timing.html.'),
    ] = None,
) -> None:
    """Time the parts of a query, and error and time over the number of retrieved images.

    With --images the same is measured for what others do, with the same local features: match the
    query with each retrieved image and lift the matches to the points of the map.
    """
    from gam_relocalizer.evaluation.timing import DEFAULT_COUNTS, counts_of, machine_facts
    from gam_relocalizer.evaluation.timing_report import TimingReport, markdown, write_report

    query_sets = read_query_sets(
        QueryOptions(
            maps=maps,
            queries=queries,
            truth=truth,
            query_list=query_list,
            dataset=dataset,
            layout=layout,
            camera=camera,
            reference=reference,
            every=every,
        )
    )
    check_global_weights(global_weights, [one.scene_map for one in query_sets])
    if images:
        _check_images(images, maps, query_sets)
    else:
        typer.echo('no --images: nothing to compare with, only the localizer is timed', err=True)
    if out is not None:
        prepare_folder(out)
    counts = counts_of(retrieved or DEFAULT_COUNTS)
    folders: Sequence[Path | None] = images or [None] * len(maps)
    timings = [
        _time_set(query_set, folder, counts, global_weights)
        for query_set, folder in zip(query_sets, folders, strict=True)
    ]
    report = TimingReport(timings, machine_facts())
    typer.echo(markdown(report), nl=False)
    if out is not None:
        write_report(out, report)


def _check_images(
    images: Sequence[Path], maps: Sequence[Path], query_sets: Sequence[QuerySet]
) -> None:
    """Before anything is timed, for that takes long."""
    from gam_relocalizer.evaluation.image_matching import check_features

    check_one_per_map(maps, '--images', images)
    for folder, query_set in zip(images, query_sets, strict=True):
        check_features(query_set.scene_map)
        if not folder.is_dir():
            msg = f'{folder}: no such folder of images'
            raise UsageError(msg)


def _time_set(
    query_set: QuerySet, images: Path | None, counts: tuple[int, ...], global_weights: Path | None
) -> SetTiming:
    from gam_relocalizer.evaluation.timing import time_set
    from gam_relocalizer.features.registry import create_extractor, global_descriptor_of
    from gam_relocalizer.mapping.leave_one_out import read_reference_images
    from gam_relocalizer.matching.registry import DEFAULT_MATCHER, create_matcher

    scene_map, manifest = query_set.scene_map, query_set.scene_map.manifest
    name = manifest.extractor.name
    describer = global_descriptor_of(
        scene_map, global_weights if manifest.retrieval_weights_sha256 else None
    )
    with progress_bars(scene_map.path.resolve().name) as progress:
        references = None if images is None else read_reference_images(scene_map, images, progress)
        return time_set(
            query_set,
            create_extractor(name),
            describer,
            create_matcher(DEFAULT_MATCHER, extractor=name),
            counts,
            references,
            progress,
        )
