# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`map extend`, `map merge` and `map prune`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gam_relocalizer.cli.map.printing import (
    MapArgument,
    print_table,
    print_warnings,
    progress_bars,
    some_of,
)
from gam_relocalizer.cli.map.sources import (
    BagOption,
    CameraInfoTopicOption,
    ImagesOption,
    ImageTopicOption,
    RectifiedOption,
    Sources,
    VideoOption,
    images_of,
)
from gam_relocalizer.cli.options import GlobalWeightsOption

if TYPE_CHECKING:
    from collections.abc import Mapping

    from gam_relocalizer.mapping.extend import ExtendReport
    from gam_relocalizer.mapping.merge import MergeReport
    from gam_relocalizer.mapping.prune import PruneReport

OutOption = Annotated[
    Path,
    typer.Option(
        help='The map bundle to write; replaced if it is one. May be the same.', resolve_path=True
    ),
]


def extend(  # noqa: PLR0913 - one argument per option
    path: MapArgument,
    *,
    images: ImagesOption = None,
    video: VideoOption = None,
    bag: BagOption = None,
    out: OutOption,
    camera: Annotated[
        str,
        typer.Option(
            help='`MODEL WIDTH HEIGHT PARAMS...` of COLMAP, or a file with that line. Without it '
            "images of the size of the map's are taken to be of the map's camera."
        ),
    ] = '',
    prefix: Annotated[
        str, typer.Option(help='Put in front of the names of the images, for example `day2/`.')
    ] = '',
    global_weights: GlobalWeightsOption = None,
    image_topic: ImageTopicOption = None,
    camera_info_topic: CameraInfoTopicOption = None,
    image_is_rectified: RectifiedOption = False,
) -> None:
    """Adds images to a map: another day, another light, another part. Nothing in it moves."""
    from gam_relocalizer.mapping.build import check_output
    from gam_relocalizer.mapping.extend import extend_map
    from gam_relocalizer.mapping.workspace import open_workspace, workspace_of
    from gam_relocalizer.scene_map import read_manifest

    sources = Sources(
        images=images,
        video=video,
        bag=bag,
        camera=camera,
        image_topic=image_topic,
        camera_info_topic=camera_info_topic,
        image_is_rectified=image_is_rectified,
        aligns=False,
    )
    sources.check()
    check_output(out)
    read_manifest(path)  # before all of a video is read
    # that of the map itself when it is extended in place: the keyframes of both have room there
    with open_workspace(workspace_of(out)) as workspace:
        image_set, _ = images_of(sources, workspace)
        with progress_bars() as progress:
            report = extend_map(
                path,
                image_set,
                out,
                prefix=prefix,
                global_weights=global_weights,
                progress=progress,
            )
    _print_extension(report, out)


def merge(
    first: Annotated[Path, typer.Argument(metavar='FIRST', help='The map whose frame is kept.')],
    second: Annotated[Path, typer.Argument(metavar='SECOND', help='The map laid over it.')],
    out: OutOption,
    prefix: Annotated[
        str, typer.Option(help='Put in front of the image names of SECOND, for example `day2/`.')
    ] = '',
) -> None:
    """Joins two maps of one place."""
    from gam_relocalizer.mapping.merge import merge_maps

    with progress_bars() as progress:
        report = merge_maps(first, second, out, prefix=prefix, progress=progress)
    _print_merger(report, out)


def prune(
    path: MapArgument,
    out: OutOption,
    keep: Annotated[
        float, typer.Option(help='Share of the size of the bundle to keep, `sfm/` not counted.')
    ] = 0.25,
    descriptor_bits: Annotated[
        int, typer.Option(help='Of each number of a local descriptor: 8 or 16.')
    ] = 8,
    images: Annotated[
        Path | None,
        typer.Option(help='The images that the map was built from: measures what is lost.'),
    ] = None,
    global_weights: GlobalWeightsOption = None,
) -> None:
    """Makes a map small: leaves out the images and points that tell least."""
    from gam_relocalizer.mapping.prune import prune_map

    with progress_bars() as progress:
        report = prune_map(
            path,
            out,
            keep,
            descriptor_bits=descriptor_bits,
            folder=images,
            global_weights=global_weights,
            progress=progress,
        )
    _print_pruning(report, out)


def _print_extension(report: ExtendReport, out: Path) -> None:
    left_out = {
        'found no place': list(report.unregistered),
        'could not be read': list(report.unreadable),
    }
    rows = {
        'images added': f'{len(report.registered)} of {report.images_given}',
        'image pairs': f'{report.pairs_verified} of {report.pairs_matched} show the same thing',
        'points': f'{report.points}, before {report.points_before}',
        'observations': f'{report.observations}',
        'mean reprojection error': f'{report.mean_reprojection_error:.2f} px',
        **{f'images that {why}': some_of(names) for why, names in left_out.items() if names},
        'seconds': _seconds(report.seconds),
    }
    print_table(f'{out}', rows)
    print_warnings(report.warnings)


def _print_merger(report: MergeReport, out: Path) -> None:
    rows = {
        'images': f'{report.images[0]} and {report.images[1]}',
        'image pairs': f'{report.pairs_verified} of {report.pairs_matched} show the same thing',
        'points joined': f'{report.points_joined} of {report.points_matched} matched',
        'apart before': f'{report.median_distance:.3g} map units in the median',
        'scale': f'one unit of the second map is {report.scale:.4g} of the first',
        'points': f'{report.points}',
        'observations': f'{report.observations}',
        'mean reprojection error': f'{report.mean_reprojection_error:.2f} px',
        'seconds': _seconds(report.seconds),
    }
    print_table(f'{out}', rows)
    print_warnings(report.warnings)


def _print_pruning(report: PruneReport, out: Path) -> None:
    before, after = report.size
    rows = {
        'size without sfm/': f'{after / 2**20:.2f} of {before / 2**20:.2f} MiB '
        f'({after / before:.0%})',
        'images': f'{report.images[1]} of {report.images[0]}',
        'points': f'{report.points[1]} of {report.points[0]}',
    }
    if report.recall is not None:
        recall = report.recall
        rows['recall'] = (
            f'{recall.after:.1%}, before {recall.before:.1%}, of {recall.queries} reference '
            f'images, each left out'
        )
    print_table(f'{out}', rows)


def _seconds(seconds: Mapping[str, float]) -> str:
    return ', '.join(f'{step} {spent:.1f}' for step, spent in seconds.items())
