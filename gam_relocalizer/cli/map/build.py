# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`map build`."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gam_relocalizer.cli.map.printing import print_table, progress_bars, some_of
from gam_relocalizer.cli.map.sources import (
    BagOption,
    BaseFrameOption,
    CameraFrameOption,
    CameraInfoTopicOption,
    GpsTopicOption,
    ImagesOption,
    ImageTopicOption,
    OdometryTopicOption,
    RectifiedOption,
    Sources,
    VideoOption,
    align_with,
    images_of,
)
from gam_relocalizer.cli.options import GlobalWeightsOption

if TYPE_CHECKING:
    from gam_relocalizer.mapping.report import BuildReport
    from gam_relocalizer.mapping.workspace import Workspace

_UNITS = {'extract': 'images', 'match': 'pairs', 'verify': 'pairs', 'sfm': 'images'}


class Mapper(str, Enum):
    """The ways to recover poses when none are given."""

    INCREMENTAL = 'incremental'
    GLOBAL = 'global'


def build(  # noqa: PLR0913 - one argument per option
    *,
    images: ImagesOption = None,
    video: VideoOption = None,
    bag: BagOption = None,
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
    descriptor_bits: Annotated[
        int, typer.Option(help='Kept of each number of a local descriptor: 16, or 8.')
    ] = 16,
    discard_work: Annotated[
        bool,
        typer.Option(
            '--discard-work',
            help='Remove the folder OUT.work, with the finished steps, when the map is complete.',
        ),
    ] = False,
    image_topic: ImageTopicOption = None,
    camera_info_topic: CameraInfoTopicOption = None,
    image_is_rectified: RectifiedOption = False,
    odom_topic: OdometryTopicOption = None,
    gps_topic: GpsTopicOption = None,
    base_frame: BaseFrameOption = None,
    camera_frame: CameraFrameOption = None,
) -> None:
    """Builds a map bundle from a folder of images, a video or a bag."""
    from gam_relocalizer.mapping.build import MapBuildOptions, build_map, check_output
    from gam_relocalizer.mapping.pictures import write_build_report
    from gam_relocalizer.mapping.workspace import open_workspace, workspace_of

    sources = Sources(
        images=images,
        video=video,
        bag=bag,
        camera=camera,
        poses=poses,
        metric=metric,
        image_topic=image_topic,
        camera_info_topic=camera_info_topic,
        image_is_rectified=image_is_rectified,
        odom_topic=odom_topic,
        gps_topic=gps_topic,
        base_frame=base_frame,
        camera_frame=camera_frame,
    )
    sources.check()
    check_output(out)
    options = MapBuildOptions(
        refine_camera=refine_camera,
        extractor=extractor,
        max_keypoints=max_keypoints,
        mapper=mapper.value,
        global_descriptor=global_descriptor,
        global_weights=global_weights,
        descriptor_bits=descriptor_bits,
    )
    with open_workspace(workspace_of(out)) as workspace:
        image_set, references = images_of(sources, workspace)
        with progress_bars() as progress:
            report = build_map(image_set, out, options, progress, workspace)
        if discard_work:
            workspace.discard()
        _print_build(report, out, workspace)
    if images is None:
        align_with(references, out)
    write_build_report(out, report, out.with_name(f'{out.name}.report'))


def _print_build(report: BuildReport, out: Path, workspace: Workspace) -> None:
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
    if any(report.reused.values()):
        rows['from the workspace'] = ', '.join(
            f'{step} {count} {_UNITS[step]}' for step, count in report.reused.items() if count
        )
    if workspace.path.exists():
        rows['workspace'] = (
            f'{workspace.path.name}, {workspace.size / 2**20:.0f} MiB: finished steps, for a '
            f'further build; may be deleted'
        )
    print_table(f'{out}', rows)
