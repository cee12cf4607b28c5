# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`map build`, `map info` and `map check`."""

from __future__ import annotations

import json
from contextlib import contextmanager
from dataclasses import asdict
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from gam_relocalizer.cli.options import GlobalWeightsOption

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.progress import TaskID

    from gam_relocalizer.mapping import progress as mapping_progress
    from gam_relocalizer.mapping.check import CheckReport
    from gam_relocalizer.mapping.report import BuildReport
    from gam_relocalizer.scene_map import Manifest

app = typer.Typer(help='Build, inspect and check maps.', no_args_is_help=True)

_LISTED_NAMES = 10
MapArgument = Annotated[Path, typer.Argument(metavar='MAP', help='A map bundle.')]


class Mapper(str, Enum):
    """The ways to recover poses when none are given."""

    INCREMENTAL = 'incremental'
    GLOBAL = 'global'


@app.command()
def build(  # noqa: PLR0913 - one argument per option
    images: Annotated[Path, typer.Option(help='Folder of images, searched with sub-folders.')],
    out: Annotated[Path, typer.Option(help='The map bundle to write; replaced if it is one.')],
    camera: Annotated[
        str,
        typer.Option(
            help='`MODEL WIDTH HEIGHT PARAMS...` of COLMAP, or a file with that line. '
            'Without it the camera is guessed and refined.'
        ),
    ] = '',
    poses: Annotated[
        Path | None,
        typer.Option(
            help='File of lines `name qw qx qy qz tx ty tz` (camera_from_world); the map then '
            'lies in the frame and scale of these poses.'
        ),
    ] = None,
    extractor: Annotated[str, typer.Option(help='Local features: xfeat or sift.')] = 'xfeat',
    mapper: Annotated[Mapper, typer.Option(help='Used without poses.')] = Mapper.INCREMENTAL,
    max_keypoints: Annotated[int, typer.Option(min=1, help='Features per image.')] = 2048,
    *,
    global_descriptor: Annotated[
        str,
        typer.Option(
            '--global', help='What images are retrieved by: vlad, or netvlad with its weights.'
        ),
    ] = 'vlad',
    global_weights: GlobalWeightsOption = None,
    refine_camera: Annotated[
        bool, typer.Option('--refine-camera', help='Refine the given camera as well.')
    ] = False,
    metric: Annotated[
        bool, typer.Option(help='Whether one unit of the given poses is a metre.')
    ] = True,
) -> None:
    """Builds a map bundle from a folder of images."""
    from gam_relocalizer.cameras import parse_camera
    from gam_relocalizer.geometry import read_poses
    from gam_relocalizer.mapping.build import MapBuildOptions, build_map

    options = MapBuildOptions(
        camera=parse_camera(camera) if camera else None,
        poses=read_poses(poses) if poses is not None else None,
        poses_are_metric=metric,
        refine_camera=refine_camera,
        extractor=extractor,
        max_keypoints=max_keypoints,
        mapper=mapper.value,
        global_descriptor=global_descriptor,
        global_weights=global_weights,
    )
    with _progress_bars() as progress:
        report = build_map(images, out, options, progress)
    _print_build(report, out)


@app.command()
def info(
    path: MapArgument,
    *,
    as_json: Annotated[bool, typer.Option('--json', help='The whole manifest as JSON.')] = False,
) -> None:
    """Says what a map is and how it was made."""
    from gam_relocalizer.scene_map import read_manifest

    manifest = read_manifest(path)
    if as_json:
        typer.echo(json.dumps({'map_id': manifest.map_id, **asdict(manifest)}, indent=2))
    else:
        _print_manifest(manifest, path)


@app.command()
def check(path: MapArgument) -> None:
    """Checks every file of a map and how well it holds together; exits with 1 on problems."""
    from gam_relocalizer.mapping.check import check_map

    report = check_map(path)
    _print_check(report, path)
    if report.problems:
        raise typer.Exit(1)


@contextmanager
def _progress_bars() -> Iterator[mapping_progress.Progress]:
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


def _table(title: str, rows: dict[str, str]) -> None:
    table = Table(title=title, show_header=False, title_justify='left')
    for name, value in rows.items():
        table.add_row(name, value)
    Console(soft_wrap=True).print(table, markup=False, highlight=False)


def _print_build(report: BuildReport, out: Path) -> None:
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
        **{f'images that {why}': _some(names) for why, names in left_out.items() if names},
        **{f'camera {i}': line for i, line in enumerate(report.cameras, start=1)},
        'seconds': ', '.join(f'{step} {spent:.1f}' for step, spent in report.seconds.items()),
    }
    if report.other_models:
        sizes = ', '.join(map(str, report.other_models))
        rows['dropped models'] = f'separate pieces of {sizes} images'
    _table(f'{out}', rows)


def _print_manifest(manifest: Manifest, path: Path) -> None:
    frame = manifest.frame
    options = manifest.build.get('options', {})
    report = manifest.build.get('report', {})
    weights_sha256 = manifest.retrieval_weights_sha256
    weights = f', weights with sha256 {weights_sha256[:12]}...' if weights_sha256 else ''
    rows = {
        'map id': manifest.map_id,
        'extractor': f'{manifest.extractor.name}, {manifest.extractor.dimension}-D',
        'retrieval': f'{manifest.retrieval}{weights}',
        **{name: str(count) for name, count in manifest.counts.items()},
        'scale': f'{frame.scale:.6g} ({"metric" if frame.metric else "not metric"})',
        'frame from': frame.source,
        'size': f'{sum(entry.size for entry in manifest.files.values()) / 2**20:.1f} MiB',
        **{f'option {name}': str(value) for name, value in options.items()},
    }
    if 'mean_reprojection_error' in report:
        rows['mean reprojection error'] = f'{report["mean_reprojection_error"]:.2f} px'
    _table(f'{path}', rows)


def _print_check(report: CheckReport, path: Path) -> None:
    least, median, most = report.points_per_image
    rows = {
        'map id': report.map_id,
        **{name: str(count) for name, count in report.counts.items()},
        'points per image': f'{least} to {most}, median {median}',
        'separate parts': str(len(report.components)),
        'weak bridges': str(len(report.weak_bridges)),
    }
    if report.map_id:
        _table(f'{path}', rows)
    for warning in report.warnings:
        typer.echo(f'warning: {warning}')
    for problem in report.problems:
        typer.echo(f'problem: {problem}')
    if not report.problems:
        typer.echo('the map is sound')


def _some(names: list[str]) -> str:
    shown = ', '.join(names[:_LISTED_NAMES])
    return shown if len(names) <= _LISTED_NAMES else f'{shown}, ... ({len(names)})'
