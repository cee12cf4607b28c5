# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`gam_relocalizer replay`: a recorded drive through the localizer, without ROS."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from gam_relocalizer.cameras import format_camera, parse_camera
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

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from gam_relocalizer.localization.localizer import LocalizerOptions
    from gam_relocalizer.replay.replay import ReplayOptions
    from gam_relocalizer.replay.report import Report
    from gam_relocalizer.replay.result import Attempt, Replay
    from gam_relocalizer.scene_map import SceneMap


def replay(  # noqa: PLR0913 - the options of the command
    bag: Annotated[
        Path, typer.Argument(help='A rosbag2: its directory, or one .mcap or .db3 file.')
    ],
    map_path: Annotated[Path, typer.Option('--map', help='Map bundle to localize in.')],
    out: Annotated[
        Path,
        typer.Option(
            help='Folder for poses.tum, attempts.csv, fixes.mcap, summary.json and report.html; '
            'with odometry also for corrected.tum.'
        ),
    ],
    *,
    period: Annotated[
        float, typer.Option(min=0.0, help='Seconds between attempts; 0 takes every image.')
    ] = 2.0,
    image_topic: ImageTopicOption = None,
    camera_info_topic: CameraInfoTopicOption = None,
    odom_topic: Annotated[
        str | None,
        typer.Option(
            help='Odometry of the base; fixes that it speaks against are held back, and those that '
            'agree by it correct its drift.'
        ),
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
    """Localize the images of a bag as the node would, and report on it.

    Attempts that are refused are no failure of the command: their reasons are in the report.
    """
    from gam_relocalizer.localization.continuity import ContinuityOptions
    from gam_relocalizer.localization.localizer import Localizer, LocalizerOptions
    from gam_relocalizer.replay.drift import trajectories_of
    from gam_relocalizer.replay.replay import ReplayOptions, replay_bag
    from gam_relocalizer.replay.report import Report, write_report
    from gam_relocalizer.replay.summary import row_of
    from gam_relocalizer.replay.writing import (
        output_folder,
        write_attempts,
        write_corrected,
        write_fixes,
        write_summary,
        write_trajectory,
    )

    options = ReplayOptions(
        period=period,
        base_frame=base_frame,
        map_frame=map_frame,
        camera=None if camera is None else parse_camera(camera),
        image_topic=image_topic,
        camera_info_topic=camera_info_topic,
        odometry_topic=odom_topic,
        truth_topic=truth_topic,
        image_is_rectified=image_is_rectified,
    )
    localizer_options = LocalizerOptions(
        matcher=matcher, weights=weights, global_weights=global_weights
    )
    with output_folder(out) as folder:
        localizer = Localizer.load(map_path, localizer_options)
        scene_map = localizer.scene_map
        metric = scene_map.manifest.frame.metric
        options = replace(options, continuity=ContinuityOptions(metric=metric))
        with _progress(scene_map) as progress:
            replayed = replay_bag(bag, localizer, options, progress)
        rows = [row_of(attempt) for attempt in replayed.attempts]
        trajectories = trajectories_of(replayed.odometry, replayed.attempts)
        facts = _facts(bag, scene_map, options, replayed) | _network_facts(localizer_options)
        report = Report(
            title=f'Replay of {bag.resolve().name}',
            rows=rows,
            scene_map=scene_map,
            illustrations=replayed.illustrations,
            facts={name: str(value) for name, value in facts.items() if value is not None},
            trajectories=trajectories,
        )
        write_trajectory(folder, rows)
        if trajectories is not None:
            write_corrected(folder, trajectories)
        write_attempts(folder, rows)
        write_fixes(folder, rows, map_frame)
        write_summary(folder, rows, facts, trajectories)
        write_report(folder, report)
    _print_summary(report, out)


@contextmanager
def _progress(scene_map: SceneMap) -> Iterator[Callable[[Attempt, float], None]]:
    """A bar, with a line above it for every attempt."""
    from gam_relocalizer.replay.report import attempt_line
    from gam_relocalizer.replay.summary import row_of

    with Progress(console=Console(), transient=True) as bar:
        task = bar.add_task('replaying', total=1.0)

        def show(attempt: Attempt, share: float) -> None:
            line = attempt_line(row_of(attempt), scene_map)
            bar.console.print(line, markup=False, highlight=False, soft_wrap=True)
            bar.update(task, completed=share)

        yield show


def _facts(
    bag: Path, scene_map: SceneMap, options: ReplayOptions, replayed: Replay
) -> dict[str, Any]:
    """What was run, for whoever wants to run it again."""
    return {
        'bag': bag.resolve().name,
        'images': replayed.images,
        'map': scene_map.path.resolve().name,
        'map_id': scene_map.manifest.map_id,
        'period': options.period,
        'image_topic': replayed.image_topic,
        'camera_info_topic': options.camera_info_topic,
        'odometry_topic': options.odometry_topic,
        'truth_topic': options.truth_topic,
        'base_frame': options.base_frame,
        'map_frame': options.map_frame,
        'camera': None if options.camera is None else format_camera(options.camera),
        'image_is_rectified': options.image_is_rectified,
    }


def _network_facts(options: LocalizerOptions) -> dict[str, Any]:
    weights, global_weights = options.weights, options.global_weights
    return {
        'matcher': options.matcher,
        'weights': None if weights is None else weights.resolve().name,
        'global_weights': None if global_weights is None else global_weights.resolve().name,
    }


def _print_summary(report: Report, out: Path) -> None:
    from gam_relocalizer.replay.report import REPORT, headline_numbers, trajectory_errors
    from gam_relocalizer.replay.summary import summarise

    summary = summarise(report.rows)
    table = Table(title=report.title, show_header=False)
    for name, value in headline_numbers(report).items():
        table.add_row(name, value)
    table.add_section()
    for name, count in summary.statuses.items():
        table.add_row(name, str(count))
    table.add_section()
    for stage, spread in summary.milliseconds.items():
        table.add_row(f'{stage}, median', f'{spread.median:.1f} ms')
    console = Console()
    console.print(table)
    if errors := trajectory_errors(report):
        header, *rows = errors
        drift = Table(*header, title='Absolute trajectory errors')
        for row in rows:
            drift.add_row(*row)
        console.print(drift)
    console.print(f'report: {out / REPORT}', markup=False, highlight=False, soft_wrap=True)
