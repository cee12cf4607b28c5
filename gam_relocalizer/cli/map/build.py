# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`map build`."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gam_relocalizer.cli.map.printing import print_table, progress_bars, some_of
from gam_relocalizer.cli.options import GlobalWeightsOption

if TYPE_CHECKING:
    from gam_relocalizer.mapping.report import BuildReport


class Mapper(str, Enum):
    """The ways to recover poses when none are given."""

    INCREMENTAL = 'incremental'
    GLOBAL = 'global'


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
    from gam_relocalizer.image_set import ImageSet
    from gam_relocalizer.mapping.build import MapBuildOptions, build_map

    image_set = ImageSet.of_folder(
        images,
        parse_camera(camera) if camera else None,
        read_poses(poses) if poses is not None else None,
        metric=metric,
    )
    options = MapBuildOptions(
        refine_camera=refine_camera,
        extractor=extractor,
        max_keypoints=max_keypoints,
        mapper=mapper.value,
        global_descriptor=global_descriptor,
        global_weights=global_weights,
    )
    with progress_bars() as progress:
        report = build_map(image_set, out, options, progress)
    _print_build(report, out)


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
        **{f'images that {why}': some_of(names) for why, names in left_out.items() if names},
        **{f'camera {i}': line for i, line in enumerate(report.cameras, start=1)},
        'seconds': ', '.join(f'{step} {spent:.1f}' for step, spent in report.seconds.items()),
    }
    if report.other_models:
        sizes = ', '.join(map(str, report.other_models))
        rows['dropped models'] = f'separate pieces of {sizes} images'
    print_table(f'{out}', rows)
