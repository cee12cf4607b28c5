# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`map info` and `map check`."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gam_relocalizer.cli.map.printing import MapArgument, print_table

if TYPE_CHECKING:
    from gam_relocalizer.mapping.check import CheckReport
    from gam_relocalizer.scene_map import Manifest


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


def check(path: MapArgument) -> None:
    """Checks every file of a map and how well it holds together; exits with 1 on problems."""
    from gam_relocalizer.mapping.check import check_map

    report = check_map(path)
    _print_check(report, path)
    if report.problems:
        raise typer.Exit(1)


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
    print_table(f'{path}', rows)


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
        print_table(f'{path}', rows)
    for warning in report.warnings:
        typer.echo(f'warning: {warning}')
    for problem in report.problems:
        typer.echo(f'problem: {problem}')
    if not report.problems:
        typer.echo('the map is sound')
