# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`map build`."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from gam_relocalizer.cli.map.printing import (
    BitsOption,
    DiscardOption,
    OutOption,
    print_build,
    progress_bars,
)
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


class Mapper(str, Enum):
    """The ways to recover poses when none are given."""

    INCREMENTAL = 'incremental'
    GLOBAL = 'global'


def build(  # noqa: PLR0913 - one argument per option
    *,
    images: ImagesOption = None,
    video: VideoOption = None,
    bag: BagOption = None,
    out: OutOption,
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
    extractor: Annotated[
        str, typer.Option(help='Local features, such as xfeat or sift.')
    ] = 'xfeat',
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
    descriptor_bits: BitsOption = 16,
    discard_work: DiscardOption = False,
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
    from gam_relocalizer.mapping.workspace import open_workspace, report_of, workspace_of

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
        print_build(report, out, workspace)
    if images is None:
        align_with(references, out)
    write_build_report(out, report, report_of(out))
