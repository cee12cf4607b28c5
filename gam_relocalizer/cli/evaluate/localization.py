# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`evaluate localization`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gam_relocalizer.cli.evaluate.outputs import prepare_folder, progress_bars
from gam_relocalizer.cli.options import GlobalWeightsOption
from gam_relocalizer.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from gam_relocalizer.scene_map import SceneMap


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
        prepare_folder(out)
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
        with progress_bars(scene_map.path.resolve().name) as progress:
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
