# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`map info` and `map check`."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gam_relocalizer.cli.map.outputs import check_folder_to_write
from gam_relocalizer.cli.map.printing import MapArgument, print_table, progress_bars, some_of
from gam_relocalizer.cli.options import GlobalWeightsOption

if TYPE_CHECKING:
    from collections.abc import Mapping

    from gam_relocalizer.mapping.check import CheckReport
    from gam_relocalizer.scene_map import Manifest

CHECK_FILE = 'check.json'
COVERAGE_FILE = 'coverage.png'
_LARGEST_FILES = 4
_MOST_WARNINGS = 12


def info(
    path: MapArgument,
    *,
    as_json: Annotated[
        bool, typer.Option('--json', help='The whole manifest, sizes and bounds as JSON.')
    ] = False,
) -> None:
    """Says what a map is and how it was made."""
    from gam_relocalizer.errors import MapError
    from gam_relocalizer.mapping.facts import bounds_of, bytes_per_point_by_file, plain
    from gam_relocalizer.scene_map import load_map, read_manifest

    manifest = read_manifest(path)
    try:
        bounds = bounds_of(load_map(path))
    except MapError:  # what is wrong with the other files, `map check` tells
        bounds = {}
    if as_json:
        content = {
            'map_id': manifest.map_id,
            'bounds': bounds,
            'bytes_per_point': bytes_per_point_by_file(manifest),
            **asdict(replace(manifest, build={}, alignment={})),
            'build': plain(manifest.build),
            'alignment': plain(manifest.alignment),
        }
        typer.echo(json.dumps(content, indent=2))
    else:
        _print_manifest(manifest, bounds, path)


def check(
    path: MapArgument,
    images: Annotated[
        Path | None,
        typer.Option(
            help='The folder of images that the map was built from: each is then localized in the '
            'map without it.'
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help=f'Folder for {CHECK_FILE} and, with --images, {COVERAGE_FILE}.'),
    ] = None,
    every: Annotated[
        int, typer.Option(min=1, help='Localize every so many-th image only; with --images.')
    ] = 1,
    global_weights: GlobalWeightsOption = None,
    *,
    as_json: Annotated[bool, typer.Option('--json', help='Everything found, as JSON.')] = False,
) -> None:
    """Checks every file of a map, how well it holds together, and where it works.

    Exits with 1 on problems; a pose accepted in a wrong place is one.
    """
    from gam_relocalizer.errors import UsageError
    from gam_relocalizer.mapping.check import check_map

    if images is None and (every != 1 or global_weights is not None):
        msg = f'{"--every" if every != 1 else "--global-weights"} needs --images'
        raise UsageError(msg)
    if out is not None:
        check_folder_to_write(out, '--out')
    report = check_map(path)
    if images is not None and report.loadable:
        report = _with_coverage(report, path, images, every, global_weights)
    if out is not None:
        _write_check(report, path, out)
    if as_json:
        typer.echo(json.dumps(report.as_dict(), indent=2))
    else:
        _print_check(report, path)
    if report.problems:
        raise typer.Exit(1)


def _with_coverage(
    report: CheckReport, path: Path, images: Path, every: int, global_weights: Path | None
) -> CheckReport:
    from gam_relocalizer.mapping.trials import measure_coverage
    from gam_relocalizer.scene_map import load_map

    with progress_bars() as progress:
        coverage = measure_coverage(
            load_map(path), images, every=every, global_weights=global_weights, progress=progress
        )
    return report.with_coverage(coverage)


def _write_check(report: CheckReport, path: Path, out: Path) -> None:
    from gam_relocalizer.geometry import write_text
    from gam_relocalizer.mapping.pictures import coverage_figure
    from gam_relocalizer.plots import write_picture
    from gam_relocalizer.scene_map import load_map

    out.mkdir(parents=True, exist_ok=True)
    write_text(out / CHECK_FILE, json.dumps(report.as_dict(), indent=2) + '\n')
    if report.coverage is not None:
        write_picture(out / COVERAGE_FILE, coverage_figure(load_map(path), report.coverage))


def _print_manifest(manifest: Manifest, bounds: Mapping[str, Any], path: Path) -> None:
    from gam_relocalizer.mapping.facts import (
        RUN_TIME,
        bytes_per_point,
        bytes_per_point_by_file,
        mapping_in,
        number_in,
        text_of,
    )
    from gam_relocalizer.scene_map import SFM

    frame = manifest.frame
    unit = 'm' if frame.metric else 'map units'
    options, report = mapping_in(manifest.build, 'options'), mapping_in(manifest.build, 'report')
    weights_sha256 = manifest.retrieval_weights_sha256
    weights = f', weights with sha256 {weights_sha256[:12]}...' if weights_sha256 else ''
    bytes_of = bytes_per_point(manifest)
    largest = list(bytes_per_point_by_file(manifest).items())[:_LARGEST_FILES]
    mean_error = number_in(report, 'mean_reprojection_error')
    cameras = report.get('cameras', ())
    rows: dict[str, object] = {
        'map id': manifest.map_id,
        'extractor': f'{manifest.extractor.name}, {manifest.extractor.dimension}-D, '
        f'{manifest.descriptor_bits} bits a number',
        'retrieval': f'{manifest.retrieval}{weights}',
        **{name: str(count) for name, count in manifest.counts.items()},
        **{f'{name} span': _box_text(box, unit) for name, box in bounds.items()},
        'scale': f'{frame.scale:.6g} ({"metric" if frame.metric else "not metric"})',
        'frame from': frame.source,
        **_alignment_rows(manifest.alignment),
        'size': f'{sum(entry.size for entry in manifest.files.values()) / 2**20:.1f} MiB',
        'bytes per point': f'{bytes_of[RUN_TIME]:.1f} at run time, {bytes_of[SFM]:.1f} {SFM}/',
        'largest files': ', '.join(f'{name} {size:.1f}' for name, size in largest),
        **{f'option {name}': value for name, value in options.items() if _is_told(name, value)},
        **_camera_rows(cameras if isinstance(cameras, (list, tuple)) else ()),
        **({} if mean_error is None else {'mean reprojection error': f'{mean_error:.2f} px'}),
        **_change_rows(manifest.build.get('changes')),
    }
    print_table(f'{path}', {text_of(name): text_of(value) for name, value in rows.items()})


def _box_text(box: Mapping[str, list[float]], unit: str) -> str:
    extent, low, high = (
        [f'{value:.2f}' for value in box[name]] for name in ('extent', 'low', 'high')
    )
    return f'{" x ".join(extent)} {unit}, from ({", ".join(low)}) to ({", ".join(high)})'


def _alignment_rows(alignment: Mapping[str, Any]) -> dict[str, str]:
    """What is known of the alignment; lists are for `--json`."""
    rows = {}
    for name, value in alignment.items():
        if isinstance(value, (str, bool, int)):
            rows[f'alignment {name}'] = str(value)
        elif isinstance(value, float):
            rows[f'alignment {name}'] = f'{value:.4g}'
    return rows


def _is_told(name: str, value: object) -> bool:
    """Whether an option of the build is worth a row: cameras have rows of their own."""
    return name != 'cameras' and value is not None


def _camera_rows(cameras: list[Any] | tuple[Any, ...]) -> dict[str, object]:
    return {f'camera {number}': line for number, line in enumerate(cameras, start=1)}


def _change_rows(changes: object) -> dict[str, str]:
    """What was done to the map after it was built, one row each."""
    steps = changes if isinstance(changes, list) else []
    rows = {}
    for number, step in enumerate(steps, start=1):
        words = step.items() if isinstance(step, dict) else [('', step)]
        simple = [
            (name, value)
            for name, value in words
            if isinstance(value, (str, int, float)) and value != ''
        ]
        rows[f'change {number}'] = ', '.join(f'{name} {value}'.strip() for name, value in simple)
    return rows


def _print_check(report: CheckReport, path: Path) -> None:
    least, median, most = report.points_per_image
    rows = {
        'map id': report.map_id,
        **{name: str(count) for name, count in report.counts.items()},
        'points per image': f'{least} to {most}, median {median}',
        'separate parts': str(len(report.components)),
        'weak bridges': str(len(report.weak_bridges)),
        'bytes per point': ', '.join(
            f'{size:.1f} {name}' for name, size in report.bytes_per_point.items()
        ),
        **_coverage_rows(report),
    }
    if report.map_id:
        print_table(f'{path}', rows)
    for warning in report.warnings[:_MOST_WARNINGS]:
        typer.echo(f'warning: {warning}')
    if (more := len(report.warnings) - _MOST_WARNINGS) > 0:
        typer.echo(f'warning: and {more} more; --json and --out have them all')
    for problem in report.problems:
        typer.echo(f'problem: {problem}')
    for left in report.not_checked:
        typer.echo(f'not checked: {left}')
    if not report.problems:
        typer.echo('the map is sound')


def _coverage_rows(report: CheckReport) -> dict[str, str]:
    coverage = report.coverage
    if coverage is None:
        return {}
    from gam_relocalizer.mapping.coverage import Standing

    tried, tolerance = len(coverage.images), coverage.tolerance
    found = coverage.count(Standing.FOUND) + coverage.count(Standing.WEAK)
    names = {
        standing: [one.name for one in coverage.images if one.standing is standing]
        for standing in (Standing.WEAK, Standing.REFUSED, Standing.WRONG)
    }
    return {
        'found without themselves': f'{found} of {tried} ({coverage.recall:.1%}), within '
        f'{tolerance.position:.3g} {coverage.unit} and {tolerance.rotation_deg:g} degrees',
        **{standing.value: some_of(some) for standing, some in names.items() if some},
        'seconds per image': f'{coverage.seconds / max(tried, 1):.2f}',
    }
