# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`map align`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gam_relocalizer.cli.map.outputs import check_file_to_write
from gam_relocalizer.cli.map.printing import MapArgument, print_table, progress_bars, some_of
from gam_relocalizer.errors import UsageError

if TYPE_CHECKING:
    from gam_relocalizer.alignment.constraints import Constraint
    from gam_relocalizer.alignment.report import AlignmentReport, Findings

_SHOWN_RESIDUALS = 3


@dataclass(frozen=True)
class _Given:
    """The options of the command that say what to align with."""

    poses: Path | None
    positions: Path | None
    gps: Path | None
    datum: tuple[float, float, float] | None
    distances: Path | None
    markers: float | None
    dictionary: str | None
    images: Path | None
    marker_positions: Path | None
    level: bool
    camera_height: float | None
    occupancy: Path | None
    picks: Path | None
    picture: Path | None


def align(  # noqa: PLR0913 - one argument per option
    path: MapArgument,
    *,
    poses: Annotated[
        Path | None,
        typer.Option(help='File of lines `name qw qx qy qz tx ty tz` (camera_from_world, metres).'),
    ] = None,
    positions: Annotated[
        Path | None,
        typer.Option(help='File of lines `name x y z`: where images were taken, in metres.'),
    ] = None,
    gps: Annotated[
        Path | None,
        typer.Option(help='File of lines `name latitude longitude altitude`.'),
    ] = None,
    datum: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            metavar='LAT LON ALT',
            help='With --gps: the origin of the map; by default the median fix.',
        ),
    ] = None,
    distances: Annotated[
        Path | None,
        typer.Option(
            help='File of lines `A B metres`; A and B are images or `image@column,row`. '
            'Gives the scale.'
        ),
    ] = None,
    markers: Annotated[
        float | None,
        typer.Option(metavar='SIZE', help='Side of the printed markers, in metres.'),
    ] = None,
    dictionary: Annotated[
        str | None,
        typer.Option(help='With --markers: their kind, such as DICT_4X4_50.'),
    ] = None,
    images: Annotated[
        Path | None,
        typer.Option(help='With --markers: the folder of the reference images.'),
    ] = None,
    marker_positions: Annotated[
        Path | None,
        typer.Option(
            help='With --markers: file of lines `id x y z` or `id x y z qw qx qy qz`, the centre '
            'of each marker (and map_from_marker).'
        ),
    ] = None,
    level: Annotated[
        bool,
        typer.Option('--level', help='Up from the upright cameras, z = 0 on the floor.'),
    ] = False,
    camera_height: Annotated[
        float | None,
        typer.Option(help='With --level: metres of the cameras above the floor; gives the scale.'),
    ] = None,
    occupancy: Annotated[
        Path | None,
        typer.Option(help='The map.yaml of a 2D occupancy map to share the frame of.'),
    ] = None,
    picks: Annotated[
        Path | None,
        typer.Option(
            help='With --occupancy: file of lines `name column row`, where images were taken.'
        ),
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option(help='With --occupancy: PNG of the points over the occupancy map.'),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option('--dry-run', help='Show how well it fits and write nothing.')
    ] = False,
    as_json: Annotated[bool, typer.Option('--json', help='Print the report as JSON.')] = False,
) -> None:
    """Lays a map into a metric, level frame; rewrites the manifest of the map, nothing else."""
    given = _Given(
        poses=poses,
        positions=positions,
        gps=gps,
        datum=datum,
        distances=distances,
        markers=markers,
        dictionary=dictionary,
        images=images,
        marker_positions=marker_positions,
        level=level,
        camera_height=camera_height,
        occupancy=occupancy,
        picks=picks,
        picture=picture,
    )
    _check_combination(given)
    if picture is not None:
        check_file_to_write(picture, '--picture')

    from gam_relocalizer.alignment.align import align_map
    from gam_relocalizer.alignment.constraints import Picks
    from gam_relocalizer.alignment.picture import draw_over_occupancy

    constraint = _constraint(given)
    with progress_bars() as progress:
        report = align_map(path, constraint, dry_run=dry_run, progress=progress)
    if picture is not None and isinstance(constraint, Picks):
        draw_over_occupancy(path, report.frame, constraint, picture)
    if as_json:
        typer.echo(json.dumps(report.as_dict(), indent=2))
    else:
        print_report(report, path)


def _check_combination(given: _Given) -> None:
    """Refuses options that contradict each other, or miss another.

    Raises:
        UsageError: Which, and what to do.
    """
    methods = {
        '--poses': given.poses,
        '--positions': given.positions,
        '--gps': given.gps,
        '--distances': given.distances,
        '--markers': given.markers,
        '--occupancy': given.occupancy,
    }
    used = [name for name, value in methods.items() if value is not None]
    if len(used) > 1 or not (used or given.level):
        names = ', '.join(methods)
        msg = f'choose one of {names}, or --level; found {" and ".join(used) or "none"}'
        raise UsageError(msg)
    needs = [
        ('--datum', given.datum, '--gps', given.gps),
        ('--dictionary', given.dictionary, '--markers', given.markers),
        ('--images', given.images, '--markers', given.markers),
        ('--marker-positions', given.marker_positions, '--markers', given.markers),
        ('--markers', given.markers, '--dictionary', given.dictionary),
        ('--markers', given.markers, '--images', given.images),
        ('--picks', given.picks, '--occupancy', given.occupancy),
        ('--occupancy', given.occupancy, '--picks', given.picks),
        ('--picture', given.picture, '--occupancy', given.occupancy),
        ('--camera-height', given.camera_height, '--level', given.level or None),
    ]
    for name, value, needed, there in needs:
        if value is not None and there is None:
            msg = f'{name} needs {needed}'
            raise UsageError(msg)
    if given.camera_height is not None and used:
        msg = f'--camera-height and {used[0]} both tell the scale; leave out one'
        raise UsageError(msg)
    if given.level and (given.poses is not None or given.marker_positions is not None):
        name = '--poses' if given.poses is not None else '--marker-positions'
        msg = f'{name} tells what is up; leave out --level'
        raise UsageError(msg)


def _constraint(given: _Given) -> Constraint:  # noqa: PLR0911 - one per method
    from gam_relocalizer.alignment import constraints, files
    from gam_relocalizer.alignment.occupancy import read_occupancy_map
    from gam_relocalizer.geometry import read_poses

    if given.poses is not None:
        return constraints.Poses(read_poses(given.poses))
    if given.positions is not None:
        return constraints.Positions(files.read_positions(given.positions), given.level)
    if given.gps is not None:
        if given.datum is not None:
            files.check_geodetic(given.datum, '--datum')
        return constraints.GpsFixes(files.read_gps(given.gps), given.datum, given.level)
    if given.distances is not None:
        return constraints.Distances(files.read_distances(given.distances), given.level)
    if given.markers is not None and given.dictionary is not None and given.images is not None:
        places = given.marker_positions
        return constraints.Markers(
            size=given.markers,
            dictionary=given.dictionary,
            images=given.images,
            places=None if places is None else files.read_marker_places(places),
            level=given.level,
        )
    if given.occupancy is not None and given.picks is not None:
        occupancy = read_occupancy_map(given.occupancy)
        return constraints.Picks(occupancy, files.read_pixels(given.picks), given.level)
    return constraints.Level(given.camera_height)


def print_report(report: AlignmentReport, path: Path) -> None:
    """What an alignment found, and how well it fits."""
    unit = 'm' if report.frame.metric else 'map units'
    rows = {'method': report.method, **_fit_rows(report)}
    rows['scale'] = f'{report.frame.scale:.6g} {unit} per SfM unit'
    if report.findings.scale_sigma is not None:
        rows['scale'] += f', standard deviation {100 * report.findings.scale_sigma:.3f} %'
    print_table(f'{path}', {**rows, **_frame_rows(report.findings)})
    for warning in report.findings.warnings:
        typer.echo(f'warning: {warning}')
    if report.written:
        typer.echo(f'wrote {path / "manifest.yaml"}; the map is now {report.map_id}')
    else:
        typer.echo('nothing was written (--dry-run)')


def _fit_rows(report: AlignmentReport) -> dict[str, str]:
    """How well what was given agrees with the map."""
    rows = {}
    if report.residuals:
        rows['used'] = f'{report.inliers} of {len(report.residuals)}'
        rows['residual'] = (
            f'{report.residual_median:.4g} m in the median, {report.residual_max:.4g} m at most'
        )
        rows['worst'] = ', '.join(
            f'{one.name} {one.metres:.4g} m{"" if one.inlier else " (not used)"}'
            for one in report.residuals[:_SHOWN_RESIDUALS]
        )
    if report.residual_median_deg is not None:
        rows['orientation'] = f'{report.residual_median_deg:.2f} degrees off in the median'
    if report.unknown:
        rows['not in the map'] = some_of(list(report.unknown))
    return rows


def _frame_rows(findings: Findings) -> dict[str, str]:
    """What is known of the frame besides its scale."""
    rows = {}
    if findings.rotation_sigma_deg is not None:
        rows['rotation'] = f'standard deviation {findings.rotation_sigma_deg:.3f} degrees'
    if findings.roll_median_deg is not None:
        rows['cameras'] = f'rolled by {findings.roll_median_deg:.2f} degrees in the median'
    if findings.floor_points is not None:
        count = findings.floor_points
        rows['floor'] = f'{count} points on it' if count else 'none found'
    if findings.datum is not None:
        latitude, longitude, altitude = findings.datum
        rows['origin'] = f'{latitude:.8f} {longitude:.8f} {altitude:.3f} (WGS 84)'
    return rows
