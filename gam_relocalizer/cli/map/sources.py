# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Where `map build` and `map extend` take images from, and what a new map is aligned with."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from gam_relocalizer.cli.map.align import print_report
from gam_relocalizer.cli.map.printing import print_table, print_warnings, progress_bars
from gam_relocalizer.errors import AlignmentError, UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pycolmap

    from gam_relocalizer.capture.capture import Capture, Reference
    from gam_relocalizer.image_set import ImageSet
    from gam_relocalizer.mapping.progress import Progress
    from gam_relocalizer.mapping.workspace import Workspace

ImagesOption = Annotated[
    Path | None, typer.Option('--images', help='Folder of images, searched with sub-folders.')
]
VideoOption = Annotated[
    Path | None, typer.Option('--video', help='Video file; its keyframes are chosen.')
]
BagOption = Annotated[
    Path | None,
    typer.Option(
        '--bag',
        help='A rosbag2: its directory, or one .mcap or .db3 file. Keyframes are chosen; a new map '
        'is aligned with odometry, GPS or transforms that the bag holds.',
    ),
]
ImageTopicOption = Annotated[
    str | None,
    typer.Option(
        '--image-topic', help='Image or CompressedImage of the bag; needed when it has several.'
    ),
]
CameraInfoTopicOption = Annotated[
    str | None,
    typer.Option(
        '--camera-info-topic', help='CameraInfo; by default the one beside the image topic.'
    ),
]
RectifiedOption = Annotated[
    bool, typer.Option('--image-is-rectified', help='Use P of the CameraInfo, no distortion.')
]
OdometryTopicOption = Annotated[
    str | None,
    typer.Option(
        '--odom-topic',
        help='Odometry or poses of the robot to align with; by default the only Odometry.',
    ),
]
GpsTopicOption = Annotated[
    str | None,
    typer.Option('--gps-topic', help='NavSatFix to align with; by default the only one.'),
]
BaseFrameOption = Annotated[
    str | None,
    typer.Option(
        '--base-frame',
        help='Frame of poses that do not name it, base_link if not given; empty: the camera.',
    ),
]
CameraFrameOption = Annotated[
    str | None,
    typer.Option('--camera-frame', help='Frame of the camera; by default that of the images.'),
]


@dataclass(frozen=True)
class Sources:
    """The options that say what to build a map from; None where they were not given.

    With `aligns` the places in a bag where images were taken are read; else they are left alone.
    """

    images: Path | None
    video: Path | None
    bag: Path | None
    camera: str
    image_topic: str | None
    camera_info_topic: str | None
    image_is_rectified: bool
    poses: Path | None = None
    metric: bool = True
    odom_topic: str | None = None
    gps_topic: str | None = None
    base_frame: str | None = None
    camera_frame: str | None = None
    aligns: bool = True

    def check(self) -> None:
        """Makes sure that the options go together.

        Raises:
            UsageError: They do not.
        """
        sources = {'--images': self.images, '--video': self.video, '--bag': self.bag}
        given = [option for option, value in sources.items() if value is not None]
        if len(given) != 1:
            found = ' and '.join(given) or 'none of them'
            msg = f'give one of {", ".join(sources)}, to take images from; found {found}'
            raise UsageError(msg)
        of_bags = {
            '--image-topic': self.image_topic,
            '--camera-info-topic': self.camera_info_topic,
            '--image-is-rectified': self.image_is_rectified or None,
            '--odom-topic': self.odom_topic,
            '--gps-topic': self.gps_topic,
            '--base-frame': self.base_frame,
            '--camera-frame': self.camera_frame,
        }
        for needed, options in (('--images', {'--poses': self.poses}), ('--bag', of_bags)):
            stray = [option for option, value in options.items() if value is not None]
            if stray and needed not in given:
                msg = f'{", ".join(stray)} cannot be used with {given[0]}, only with {needed}'
                raise UsageError(msg)


def images_of(sources: Sources, workspace: Workspace) -> tuple[ImageSet, tuple[Reference, ...]]:
    """The images, and what to align a map of them with; says what became of frames."""
    from gam_relocalizer.cameras import parse_camera
    from gam_relocalizer.geometry import read_poses
    from gam_relocalizer.image_set import ImageSet

    camera = parse_camera(sources.camera) if sources.camera else None
    if sources.images is not None:
        poses = None if sources.poses is None else read_poses(sources.poses)
        return ImageSet.of_folder(sources.images, camera, poses, metric=sources.metric), ()
    with progress_bars() as progress:
        capture = _capture(sources, camera, workspace, progress)
    _print_capture(capture)
    return capture.images, capture.references


def _capture(
    sources: Sources, camera: pycolmap.Camera | None, workspace: Workspace, progress: Progress
) -> Capture:
    if sources.video is not None:
        from gam_relocalizer.capture.video import capture_video

        return capture_video(sources.video, workspace, camera, progress)
    from gam_relocalizer.capture.recording import BagOptions, capture_bag
    from gam_relocalizer.capture.whereabouts import BASE_FRAME, WhereaboutsTopics

    whereabouts = WhereaboutsTopics(
        odometry=sources.odom_topic,
        gps=sources.gps_topic,
        camera_frame=sources.camera_frame,
        base_frame=BASE_FRAME if sources.base_frame is None else sources.base_frame,
    )
    options = BagOptions(
        image_topic=sources.image_topic,
        camera_info_topic=sources.camera_info_topic,
        camera=camera,
        image_is_rectified=sources.image_is_rectified,
        whereabouts=whereabouts if sources.aligns else None,
    )
    return capture_bag(cast('Path', sources.bag), workspace, options, progress)


def _print_capture(capture: Capture) -> None:
    """What became of the frames."""
    counts = capture.counts
    left_out = {'empty': counts.empty, 'late': counts.late}
    rows = {
        'frames read': f'{counts.read}',
        'blurred': f'{counts.blurred}',
        **{why: f'{count}' for why, count in left_out.items() if count},
        'keyframes': f'{counts.chosen}',
    }
    print_table(capture.name, rows)
    typer.echo(f'keyframes in {capture.images.folder}')  # a table would break the path
    print_warnings(capture.warnings)


def align_with(references: Sequence[Reference], out: Path) -> None:
    """Aligns a new map with the first reference that it fits; without one it stays as it is."""
    if not any(_aligned(reference, out) for reference in references):
        typer.echo('the map is not metric: nothing tells its scale; see `map align`')


def _aligned(reference: Reference, out: Path) -> bool:
    from gam_relocalizer.alignment.align import align_map

    try:
        report = align_map(out, reference.constraint)
    except (AlignmentError, UsageError) as err:
        typer.echo(f'warning: the map cannot be aligned with the {reference.source}: {err}')
        return False
    typer.echo(f'aligned with the {reference.source}')
    print_report(report, out)
    return True
