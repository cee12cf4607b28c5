# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`evaluate localization`."""

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

    import pycolmap

    from gam_relocalizer.evaluation.query_set import QuerySet


def localization(  # noqa: PLR0913 - one argument per option
    maps: MapsOption,
    *,
    queries: QueriesOption = None,
    truth: TruthOption = None,
    query_list: QueryListOption = None,
    dataset: DatasetOption = None,
    layout: LayoutOption = None,
    camera: CameraOption = None,
    reference: ReferenceOption = None,
    every: EveryOption = 1,
    results: Annotated[
        list[str] | None,
        typer.Option(
            metavar='NAME=FILE',
            help='Poses of the same images that another localizer found, as hloc writes them: a '
            'row NAME in the tables. One file per --map for every NAME.',
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
        typer.Option(help='Folder for localization.md, localization.json, figures and submission.'),
    ] = None,
) -> None:
    """Localize images with known poses: matchers and ways to choose scenes, compared.

    Recall is the share of the images within a position and an angle of the truth; once for all
    poses that were found, as in papers, and once for those that the verdict accepted. Without a
    truth the poses are counted, and written as the long-term localization benchmark wants them.
    """
    from gam_relocalizer.evaluation.localization import evaluate_set
    from gam_relocalizer.evaluation.localization_report import (
        DEFAULT_MATCHERS,
        LocalizationReport,
        markdown,
        write_report,
    )
    from gam_relocalizer.evaluation.submission import (
        SUBMISSION,
        submission_names,
        write_submission,
    )
    from gam_relocalizer.features.registry import create_extractor, global_descriptor_of
    from gam_relocalizer.matching.registry import create_matcher

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
    others = _read_others(results or [], maps, query_sets)
    submitted = submission_names(name for one in query_sets if not one.truth for name in one.names)
    if out is not None:
        prepare_folder(out)
    evaluations = []
    for query_set, found_by_others in zip(query_sets, others, strict=True):
        scene_map, manifest = query_set.scene_map, query_set.scene_map.manifest
        extractor = manifest.extractor.name
        describer = global_descriptor_of(
            scene_map, global_weights if manifest.retrieval_weights_sha256 else None
        )
        matchers = {
            name: create_matcher(name, extractor=extractor) for name in matcher or DEFAULT_MATCHERS
        }
        with progress_bars(scene_map.path.resolve().name) as progress:
            evaluations.append(
                evaluate_set(
                    query_set,
                    create_extractor(extractor),
                    describer,
                    matchers,
                    retrieved,
                    progress,
                    found_by_others,
                )
            )
    report = LocalizationReport(evaluations, retrieved)
    typer.echo(markdown(report), nl=False)
    if out is not None:
        write_report(out, report)
        if submitted:
            write_submission(out / SUBMISSION, evaluations, submitted)


def _read_others(
    results: Sequence[str], maps: Sequence[Path], query_sets: Sequence[QuerySet]
) -> list[dict[str, dict[str, pycolmap.Rigid3d]]]:
    """Per set, what others found: poses by name of the localizer and of the image."""
    from gam_relocalizer.evaluation.submission import read_results

    files: dict[str, list[Path]] = {}
    for given in results:
        name, equals, file = given.partition('=')
        if not (name and equals and file):
            msg = f'--results {given}: expected NAME=FILE'
            raise UsageError(msg)
        files.setdefault(name, []).append(Path(file))
    if files and not all(query_set.truth for query_set in query_sets):
        msg = '--results: poses of others can only be scored where the truth is known'
        raise UsageError(msg)
    for name, of_name in files.items():
        check_one_per_map(maps, f'--results {name}=', of_name)
    return [
        {name: read_results(of_name[index], one.names) for name, of_name in files.items()}
        for index, one in enumerate(query_sets)
    ]
