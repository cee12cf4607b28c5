# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Options that say what is to be localized in what, and the sets of queries that they mean."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gam_relocalizer.datasets.layout import Layout
from gam_relocalizer.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from gam_relocalizer.evaluation.query_set import QuerySet
    from gam_relocalizer.scene_map import SceneMap

MapsOption = Annotated[
    list[Path], typer.Option('--map', help='A map bundle; may be given repeatedly.')
]
QueriesOption = Annotated[
    list[Path] | None,
    typer.Option(
        help='The folder of images to localize, one per --map; with --truth or --query-list.'
    ),
]
TruthOption = Annotated[
    list[Path] | None,
    typer.Option(
        help='Their true poses, one file per --map: lines `name qw qx qy qz tx ty tz`, '
        'camera_from_world. Images it does not name are left out.'
    ),
]
QueryListOption = Annotated[
    list[Path] | None,
    typer.Option(
        help='Which images of --queries, and their cameras, one file per --map: lines `name MODEL '
        'WIDTH HEIGHT PARAMS...`, as of Aachen Day-Night. Needs no truth.'
    ),
]
DatasetOption = Annotated[
    list[Path] | None,
    typer.Option(
        help='Instead of --queries: a dataset, one per --map; its test images, or all of a single '
        'sequence.'
    ),
]
LayoutOption = Annotated[
    list[Layout] | None,
    typer.Option(help='Of the datasets, one per --map; by default found by their files.'),
]
CameraOption = Annotated[
    list[str] | None,
    typer.Option(
        help='The camera, one per --map: file or text `MODEL WIDTH HEIGHT PARAMS...`; by default '
        'that of the dataset, else the one that took the images of the map.'
    ),
]
ReferenceOption = Annotated[
    list[Path] | None,
    typer.Option(
        help='True poses of the images of the map, one file per --map: lays a map that is not '
        'metric over the truth by a similarity.'
    ),
]
EveryOption = Annotated[int, typer.Option(min=1, help='Take every so many-th image as a query.')]


@dataclass(frozen=True)
class QueryOptions:
    """The options of this module; a list holds one entry per map, in the same order."""

    maps: Sequence[Path]
    queries: Sequence[Path] | None = None
    truth: Sequence[Path] | None = None
    query_list: Sequence[Path] | None = None
    dataset: Sequence[Path] | None = None
    layout: Sequence[Layout] | None = None
    camera: Sequence[str] | None = None
    reference: Sequence[Path] | None = None
    every: int = 1


def read_query_sets(given: QueryOptions) -> list[QuerySet]:
    """One set of queries per map; reads all but the images.

    Raises:
        UsageError: Options that do not fit together.
        UsageError, PosesFileError, CameraError, DatasetError, MapError: See `read_query_set`,
            `read_listed_queries` and `read_dataset_queries`.
    """
    from gam_relocalizer.evaluation.query_set import (
        read_dataset_queries,
        read_listed_queries,
        read_query_set,
    )

    _check(given)
    nothing: Sequence[None] = [None] * len(given.maps)
    cameras, references = given.camera or nothing, given.reference or nothing
    if given.dataset:
        layouts = given.layout or nothing
        datasets = zip(given.maps, given.dataset, layouts, cameras, references, strict=True)
        return [read_dataset_queries(*one, given.every) for one in datasets]
    folders, truths = given.queries or (), given.truth or nothing
    if given.query_list:
        lists = zip(given.maps, folders, given.query_list, truths, references, strict=True)
        return [read_listed_queries(*one, given.every) for one in lists]
    plain = zip(given.maps, folders, given.truth or (), cameras, references, strict=True)
    return [read_query_set(*one, given.every) for one in plain]


def check_global_weights(weights: Path | None, scene_maps: Sequence[SceneMap]) -> None:
    """Refuses weights of a global descriptor that none of the maps has.

    Raises:
        UsageError: There are such weights.
    """
    if weights is not None and not any(one.manifest.retrieval_weights_sha256 for one in scene_maps):
        msg = f'{weights}: none of the maps has a global descriptor with weights; leave them out'
        raise UsageError(msg)


def _check(given: QueryOptions) -> None:
    if given.dataset:
        why = 'a --dataset knows its images and where they were taken'
        _refuse(given, why, 'queries', 'truth', 'query_list')
    else:
        _refuse(given, 'only a --dataset has a layout', 'layout')
        if not given.queries:
            msg = 'say what to localize: --dataset, or --queries with --truth or --query-list'
            raise UsageError(msg)
        if not (given.truth or given.query_list):
            msg = '--queries needs --truth, the true poses, or --query-list, images without any'
            raise UsageError(msg)
    if given.query_list:
        _refuse(given, 'a --query-list holds the cameras', 'camera')
    for option in fields(given):
        values = getattr(given, option.name)
        if option.name not in {'maps', 'every'} and values:
            check_one_per_map(given.maps, _flag(option.name), values)


def check_one_per_map(maps: Sequence[Path], flag: str, values: Sequence[object]) -> None:
    """Refuses an option that was not given once per map.

    Raises:
        UsageError: Their numbers differ.
    """
    if len(values) != len(maps):
        msg = (
            f'every --map needs its own {flag}, in the same order: found {len(maps)} maps and '
            f'{len(values)} of {flag}'
        )
        raise UsageError(msg)


def _refuse(given: QueryOptions, why: str, *names: str) -> None:
    present = [_flag(name) for name in names if getattr(given, name)]
    if present:
        msg = f'{why}; leave out {" and ".join(present)}'
        raise UsageError(msg)


def _flag(name: str) -> str:
    return f'--{name.replace("_", "-")}'
