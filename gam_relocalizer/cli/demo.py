# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`gam_relocalizer demo`: the real node, a drive played into it over DDS, and the truth."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from gam_relocalizer.errors import RelocalizerError

if TYPE_CHECKING:
    import pycolmap

    from gam_relocalizer.localization.localizer import Localizer
    from gam_relocalizer.replay.result import TimedIllustration
    from gam_relocalizer.replay.summary import Row, Summary

PERIOD_S = 2.0
DURATION_S = 66.0
IMAGE_TOPIC = '/camera/image'
CAMERA_INFO_TOPIC = '/camera/camera_info'
TRUTH_TOPIC = '/ground_truth'
# A DDS domain that a robot on the same machine is unlikely to use.
DOMAIN_ID = '77'

MIN_ATTEMPTS = 0.8 * DURATION_S / PERIOD_S
MIN_ACCEPTED = 0.95
MAX_MEDIAN_POSITION_M = 0.05
MAX_MEDIAN_ROTATION_DEG = 1.0


def demo(
    out: Annotated[Path, typer.Option(help='Folder for the bag, the report and the picture.')],
) -> None:
    """Relocalize a robot that drives through a rendered scene, live, and compare with the truth.

    Fails when fewer than 95 % of the attempts give a fix, or the median error is above 5 cm or
    1 degree.
    """
    os.environ.setdefault('ROS_DOMAIN_ID', DOMAIN_ID)
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    os.environ.setdefault('ROS_LOG_DIR', str(out.absolute() / 'ros_log'))
    from gam_relocalizer.demo.shipped import demo_map_path
    from gam_relocalizer.localization.localizer import Localizer
    from gam_relocalizer.replay.report import Report, attempt_line, headline_numbers, write_report
    from gam_relocalizer.replay.summary import summarise
    from gam_relocalizer.ros.live import LiveOptions, run_live

    console = Console(highlight=False, soft_wrap=True)
    map_path, bag, log = demo_map_path(), out / 'query_bag', out / 'node.log'
    out.mkdir(parents=True, exist_ok=True)
    console.print('[1/3] rendering the drive of the robot into a bag')
    _record(bag)
    localizer = Localizer.load(map_path)

    console.print(f'[2/3] starting the node and playing {DURATION_S:.0f} s of the bag into it')
    options = LiveOptions(period=PERIOD_S, truth=_truth(bag))
    rows = run_live(
        bag,
        map_path,
        log,
        options,
        lambda row: console.print(f'  {attempt_line(row, localizer.scene_map)}', markup=False),
    )

    console.print('[3/3] drawing the report')
    report = Report(
        title='Demo: live relocalization over DDS',
        rows=rows,
        scene_map=localizer.scene_map,
        illustrations=_illustrations(bag, rows, localizer),
        facts={
            'map': localizer.scene_map.manifest.map_id,
            'bag': bag.name,
            'period': f'{PERIOD_S:g} s',
        },
    )
    write_report(out, report)
    for name, value in headline_numbers(report).items():
        console.print(f'  {name}: {value}', markup=False)
    console.print(f'  report: {out / "report.html"}, picture: {out / "overview.png"}', markup=False)
    _require_success(summarise(rows), log)


def _record(bag: Path) -> None:
    from gam_relocalizer.demo.recording import record_query_bag
    from gam_relocalizer.demo.world import demo_world

    shutil.rmtree(bag, ignore_errors=True)
    columns = (TextColumn('  {task.description}'), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeRemainingColumn()) as progress:
        task = progress.add_task('images', total=None)
        record_query_bag(
            demo_world(rearranged=True),
            bag,
            duration_s=DURATION_S,
            progress=lambda done, total: progress.update(task, completed=done, total=total),
        )


def _truth(bag: Path) -> dict[int, pycolmap.Rigid3d]:
    """map_from_base by stamp [ns]."""
    from gam_relocalizer.replay.bag import open_bag
    from gam_relocalizer.replay.messages import pose_in

    with open_bag(bag) as reader:
        return {m.stamp_ns: pose_in(m) for m in reader.messages([TRUTH_TOPIC])}


def _illustrations(
    bag: Path, rows: tuple[Row, ...], localizer: Localizer
) -> tuple[TimedIllustration, ...]:
    """Images that are localized again, to draw their matches."""
    from gam_relocalizer.cameras import camera_from_calibration
    from gam_relocalizer.localization.pictures import Illustration
    from gam_relocalizer.replay.bag import open_bag
    from gam_relocalizer.replay.messages import calibration_in, image_in
    from gam_relocalizer.replay.result import TimedIllustration

    stamps = _stamps_to_show(rows)
    with open_bag(bag) as reader:
        info = next(reader.messages([CAMERA_INFO_TOPIC]))
        images = {
            message.stamp_ns: image_in(message)
            for message in reader.messages([IMAGE_TOPIC])
            if message.stamp_ns in stamps
        }
    camera = camera_from_calibration(calibration_in(info), image_is_rectified=False)
    estimates = {stamp: localizer.localize(images[stamp], camera).estimate for stamp in stamps}
    return tuple(
        TimedIllustration(stamp, Illustration(images[stamp], camera, estimate))
        for stamp, estimate in estimates.items()
        if estimate is not None
    )


def _stamps_to_show(rows: tuple[Row, ...]) -> list[int]:
    """A typical fix, those with the largest errors, and the refused ones with most inliers."""
    from gam_relocalizer.replay.replay import REFUSED_SHOWN, WORST_SHOWN

    fixes = [row for row in rows if row.robot_pose]
    typical = sorted(fixes, key=lambda row: row.inliers)[len(fixes) // 2 :][:1]
    worst = sorted(fixes, key=lambda row: -row.error.position if row.error else 0.0)
    refused = sorted(
        (row for row in rows if not row.robot_pose and row.inliers), key=lambda row: -row.inliers
    )
    shown = (*typical, *worst[:WORST_SHOWN], *refused[:REFUSED_SHOWN])
    return list(dict.fromkeys(row.stamp_ns for row in shown))


def _require_success(summary: Summary, log: Path) -> None:
    """Raises when the run is not what the project promises.

    Raises:
        RelocalizerError: Too few attempts, too few fixes, or errors that are too large.
    """
    position, rotation = summary.position_error, summary.rotation_error_deg
    failures = []
    if summary.attempts < MIN_ATTEMPTS:
        failures.append(f'{summary.attempts} attempts, expected at least {MIN_ATTEMPTS:.0f}')
    if not summary.attempts or summary.accepted < MIN_ACCEPTED * summary.attempts:
        failures.append(
            f'{summary.accepted} of {summary.attempts} attempts gave a fix, expected '
            f'{MIN_ACCEPTED:.0%}'
        )
    if position is None or position.median > MAX_MEDIAN_POSITION_M:
        failures.append(f'the median position error is above {MAX_MEDIAN_POSITION_M} m')
    if rotation is None or rotation.median > MAX_MEDIAN_ROTATION_DEG:
        failures.append(f'the median rotation error is above {MAX_MEDIAN_ROTATION_DEG} deg')
    if failures:
        msg = f'the demo failed: {"; ".join(failures)}; the output of the node is in {log}'
        raise RelocalizerError(msg)
