# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`gam_relocalizer augment`: virtual arrows of a map, drawn into a recording."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from gam_relocalizer.cameras import format_camera, parse_camera
from gam_relocalizer.cli.evaluate.outputs import prepare_folder, progress_bars
from gam_relocalizer.cli.options import (
    DEFAULT_MATCHER,
    BaseFrameOption,
    CameraInfoTopicOption,
    CameraOption,
    GlobalWeightsOption,
    ImageIsRectifiedOption,
    ImageTopicOption,
    MapFrameOption,
    MatcherOption,
    TruthTopicOption,
    WeightsOption,
)
from gam_relocalizer.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy as np
    from numpy.typing import NDArray

    from gam_relocalizer.augmentation.report import Augmentation
    from gam_relocalizer.augmentation.tracking import Track, TrackedFrame
    from gam_relocalizer.localization.localizer import Localizer
    from gam_relocalizer.mapping.progress import Progress
    from gam_relocalizer.replay.replay import ReplayOptions


def augment(  # noqa: PLR0913 - the options of the command
    recording: Annotated[
        Path,
        typer.Argument(help='A rosbag2 (its directory, or one .mcap or .db3 file), or a video.'),
    ],
    map_path: Annotated[Path, typer.Option('--map', help='Map bundle to localize in.')],
    out: Annotated[
        Path,
        typer.Option(
            help='Folder for the videos, contact_sheet.png, arrows.yaml, jitter.json and '
            'augmented.html.'
        ),
    ],
    *,
    arrows: Annotated[
        Path | None,
        typer.Option(help='Arrows to draw, as arrows.yaml; by default some are placed.'),
    ] = None,
    every: Annotated[int, typer.Option(min=1, help='Take every so many frames.')] = 1,
    period: Annotated[
        float, typer.Option(min=0.0, help='Seconds between fixes that correct the odometry.')
    ] = 10.0,
    image_topic: ImageTopicOption = None,
    camera_info_topic: CameraInfoTopicOption = None,
    odom_topic: Annotated[
        str | None,
        typer.Option(help='Odometry of the base, to be corrected; draws the arrows by it as well.'),
    ] = None,
    truth_topic: TruthTopicOption = None,
    base_frame: BaseFrameOption = 'base_link',
    map_frame: MapFrameOption = 'map',
    camera: CameraOption = None,
    image_is_rectified: ImageIsRectifiedOption = False,
    matcher: MatcherOption = DEFAULT_MATCHER,
    weights: WeightsOption = None,
    global_weights: GlobalWeightsOption = None,
) -> None:
    """Draw arrows of the map into every frame, and measure how they shake.

    Frames without an accepted fix show no arrow; that is no failure of the command.
    """
    from gam_relocalizer.augmentation.arrows import read_arrows
    from gam_relocalizer.augmentation.augment import augment as augment_recording
    from gam_relocalizer.augmentation.placing import place_arrows
    from gam_relocalizer.localization.continuity import ContinuityOptions
    from gam_relocalizer.localization.localizer import Localizer, LocalizerOptions
    from gam_relocalizer.replay.replay import ReplayOptions

    prepare_folder(out)
    chosen = None if arrows is None else read_arrows(arrows)
    localizer = Localizer.load(
        map_path, LocalizerOptions(matcher=matcher, weights=weights, global_weights=global_weights)
    )
    scene_map = localizer.scene_map
    metric = scene_map.manifest.frame.metric
    options = ReplayOptions(
        # without anything to compare with, it is the camera that matters, and no mount
        base_frame=base_frame if odom_topic or truth_topic else '',
        map_frame=map_frame,
        camera=None if camera is None else parse_camera(camera),
        image_topic=image_topic,
        camera_info_topic=camera_info_topic,
        odometry_topic=odom_topic,
        truth_topic=truth_topic,
        image_is_rectified=image_is_rectified,
        continuity=ContinuityOptions(metric=metric),
    )
    if odom_topic and not metric:
        Console(stderr=True).print(
            'the map is not metric, so odometry does not fit into it: --odom-topic is left out',
            style='yellow',
        )
    with progress_bars('augment') as progress:
        track, frames = _tracked(recording, localizer, options, every, period, progress)
        augmentation = augment_recording(
            out,
            track,
            _counted(frames, len(track.frames), progress),
            place_arrows(scene_map) if chosen is None else chosen,
            scene_map,
            title=f'Arrows in {recording.resolve().name}',
            facts={
                'recording': recording.resolve().name,
                'map': scene_map.path.resolve().name,
                'map_id': scene_map.manifest.map_id,
                'arrows': None if arrows is None else arrows.name,
                'every': every,
                'period': period,
                'matcher': matcher,
                **_topics(options),
            },
        )
    _print(augmentation, out)


def _tracked(
    recording: Path,
    localizer: Localizer,
    options: ReplayOptions,
    every: int,
    period: float,
    progress: Progress,
) -> tuple[Track, Iterator[tuple[TrackedFrame, NDArray[np.uint8]]]]:
    """Poses for all frames, and the frames with their images."""
    from gam_relocalizer.augmentation.tracking import (
        bag_frames,
        track_bag,
        track_video,
        video_frames,
    )
    from gam_relocalizer.replay.bag import STORAGE_SUFFIXES

    if recording.is_dir() or recording.suffix in STORAGE_SUFFIXES or not recording.exists():
        track = track_bag(
            recording,
            localizer,
            options,
            every=every,
            correction_period=period,
            progress=progress,
        )
        return track, bag_frames(recording, track)
    if options.camera is None:
        msg = f'{recording}: a video does not tell its camera; give it with --camera'
        raise UsageError(msg)
    if options.odometry_topic or options.truth_topic:
        msg = f'{recording}: a video has no topics; --odom-topic and --truth-topic are for bags'
        raise UsageError(msg)
    track = track_video(recording, localizer, options.camera, every=every, progress=progress)
    images = (frame.image for frame in video_frames(recording, every))
    return track, zip(track.frames, images, strict=True)


def _counted(
    frames: Iterator[tuple[TrackedFrame, NDArray[np.uint8]]], total: int, progress: Progress
) -> Iterator[tuple[TrackedFrame, NDArray[np.uint8]]]:
    for done, frame in enumerate(frames, start=1):
        yield frame
        progress('drawing frames', done, total)


def _topics(options: ReplayOptions) -> dict[str, Any]:
    """For whoever wants to run it again."""
    return {
        'image_topic': options.image_topic,
        'camera_info_topic': options.camera_info_topic,
        'odometry_topic': options.odometry_topic,
        'truth_topic': options.truth_topic,
        'base_frame': options.base_frame,
        'map_frame': options.map_frame,
        'camera': None if options.camera is None else format_camera(options.camera),
        'image_is_rectified': options.image_is_rectified,
    }


def _print(augmentation: Augmentation, out: Path) -> None:
    from gam_relocalizer.augmentation.report import HEADER, PAGE, table_rows

    table = Table(*HEADER, title=augmentation.title)
    for row in table_rows(augmentation):
        table.add_row(*row)
    console = Console()
    console.print(table)
    if len(augmentation.track.ways) > 1:
        console.print(f'corrections of the odometry: {augmentation.track.corrections}')
    for name in (*augmentation.shown.videos, PAGE):
        console.print(str(out / name), markup=False, highlight=False, soft_wrap=True)
