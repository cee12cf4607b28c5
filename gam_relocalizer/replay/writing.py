# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The files of a replay: trajectory, bag of fixes, summary, report.

`poses.tum` has a line `timestamp tx ty tz qx qy qz qw` of map_from_base for every fix, `fixes.mcap`
the same with covariances as the node publishes it, `attempts.csv` the verdict on every image that
was tried, its error where the truth is known, and its time, `corrected.tum` the odometry as
corrected by the fixes, `summary.json` the numbers, `report.html` the pictures and all attempts,
`overview.png` the run in one picture.
"""

from __future__ import annotations

import csv
import json
import shutil
from contextlib import contextmanager
from dataclasses import asdict
from io import StringIO
from typing import TYPE_CHECKING, Any

import numpy as np
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from gam_relocalizer.errors import UsageError
from gam_relocalizer.geometry import quaternion_wxyz, write_text
from gam_relocalizer.replay.bag import NANOSECONDS
from gam_relocalizer.replay.messages import POSE_WITH_COVARIANCE_STAMPED
from gam_relocalizer.replay.summary import summarise

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    import pycolmap

    from gam_relocalizer.localization.robot_pose import RobotPose
    from gam_relocalizer.replay.drift import Trajectories
    from gam_relocalizer.replay.summary import Row

POSES = 'poses.tum'
CORRECTED = 'corrected.tum'
FIXES = 'fixes.mcap'
ATTEMPTS = 'attempts.csv'
ATTEMPT_COLUMNS = (
    'stamp_ns', 'status', 'inliers', 'reason', 'position_error', 'rotation_error_deg',
    'milliseconds',
)  # fmt: skip
SUMMARY = 'summary.json'
FIX_TOPIC = '/relocalized_pose'

_KIND = 'gam_relocalizer replay'
_FOREVER = QosTime(sec=9223372036, nsec=854775807)

# The QoS of the node's topic: who plays the bag offers what the node offers.
_FIX_QOS = Qos(
    history=QosHistory.KEEP_LAST,
    depth=1,
    reliability=QosReliability.RELIABLE,
    durability=QosDurability.TRANSIENT_LOCAL,
    deadline=_FOREVER,
    lifespan=_FOREVER,
    liveliness=QosLiveliness.AUTOMATIC,
    liveliness_lease_duration=_FOREVER,
    avoid_ros_namespace_conventions=False,
)


def check_output(out: Path) -> None:
    """Refuses a place that holds something else than an earlier replay.

    Raises:
        UsageError: It does.
    """
    if not out.exists() or _is_replay(out):
        return
    if out.is_dir() and not any(out.iterdir()):
        return
    msg = f'{out}: exists and is not the output of a replay; choose another place'
    raise UsageError(msg)


@contextmanager
def output_folder(out: Path) -> Iterator[Path]:
    """A temporary folder that becomes `out` when all went well, in place of an earlier replay.

    Raises:
        UsageError: `out` holds something else than an earlier replay, or cannot be written to.
    """
    out = out.resolve()
    check_output(out)
    temporary, retired = (out.with_name(f'.{out.name}.{suffix}') for suffix in ('part', 'old'))
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        temporary.mkdir(parents=True)
    except OSError as err:
        msg = f'{out}: cannot be written to: {err.strerror}'
        raise UsageError(msg) from err
    try:
        yield temporary
        shutil.rmtree(retired, ignore_errors=True)
        if out.exists():
            out.rename(retired)
        temporary.rename(out)
        shutil.rmtree(retired, ignore_errors=True)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def write_trajectory(folder: Path, rows: Sequence[Row]) -> None:
    """Writes `poses.tum`; equal fixes give equal bytes.

    The format is that of the TUM RGB-D benchmark, here with the stamp's nanoseconds in full.
    """
    lines = (_tum_line(stamp_ns, pose.map_from_base) for stamp_ns, pose in _fixes(rows))
    write_text(folder / POSES, ''.join(lines))


def write_corrected(folder: Path, trajectories: Trajectories) -> None:
    """Writes `corrected.tum`, in the format of `poses.tum`."""
    lines = (_tum_line(pose.stamp_ns, pose.map_from_base) for pose in trajectories.corrected)
    write_text(folder / CORRECTED, ''.join(lines))


def write_attempts(folder: Path, rows: Sequence[Row]) -> None:
    """Writes `attempts.csv`: the verdict on every image that was tried.

    Errors [map units, deg] are empty where there is no fix or no truth.
    """
    stream = StringIO()
    table = csv.writer(stream, lineterminator='\n')
    table.writerow(ATTEMPT_COLUMNS)
    table.writerows(map(_attempt_cells, rows))
    write_text(folder / ATTEMPTS, stream.getvalue())


def write_fixes(folder: Path, rows: Sequence[Row], map_frame: str) -> None:
    """Writes `fixes.mcap`; equal fixes give equal bytes."""
    bag = folder / FIXES.removesuffix('.mcap')
    typestore = get_typestore(Stores.ROS2_JAZZY)
    with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection(
            FIX_TOPIC,
            POSE_WITH_COVARIANCE_STAMPED,
            typestore=typestore,
            offered_qos_profiles=[_FIX_QOS],
        )
        for stamp_ns, robot_pose in _fixes(rows):
            message = _fix_message(stamp_ns, robot_pose, map_frame, typestore.types)
            data = typestore.serialize_cdr(message, POSE_WITH_COVARIANCE_STAMPED)
            writer.write(connection, stamp_ns, data)
    # the file holds its own metadata; the directory around it would hold nothing more
    (bag / FIXES).rename(folder / FIXES)
    shutil.rmtree(bag)


def write_summary(
    folder: Path,
    rows: Sequence[Row],
    facts: Mapping[str, Any],
    trajectories: Trajectories | None = None,
) -> None:
    """Writes `summary.json`.

    Args:
        folder: An existing folder.
        rows: One per attempt.
        facts: What was run: bag, map, options; values that JSON knows.
        trajectories: With odometry: their errors become `trajectory_errors`.
    """
    errors = {} if trajectories is None else trajectories.errors()
    content = {
        'kind': _KIND,
        **asdict(summarise(rows)),
        'trajectory_errors': {name: asdict(error) for name, error in errors.items()},
        **facts,
    }
    write_text(folder / SUMMARY, json.dumps(content, indent=2) + '\n')


def _is_replay(out: Path) -> bool:
    try:
        content = json.loads((out / SUMMARY).read_text(encoding='utf-8'))
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and content.get('kind') == _KIND


def _attempt_cells(row: Row) -> list[int | str]:
    error = row.error
    errors = ['', ''] if error is None else [f'{error.position:.6f}', f'{error.rotation_deg:.6f}']
    milliseconds = f'{row.total_milliseconds:.1f}'
    return [row.stamp_ns, row.status.name, row.inliers, row.reason, *errors, milliseconds]


def _fixes(rows: Sequence[Row]) -> Iterator[tuple[int, RobotPose]]:
    return ((row.stamp_ns, row.robot_pose) for row in rows if row.robot_pose is not None)


def _tum_line(stamp_ns: int, map_from_base: pycolmap.Rigid3d) -> str:
    w, x, y, z = quaternion_wxyz(map_from_base)
    translation = map_from_base.translation
    seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS)
    # adding zero takes the minus off a zero
    numbers = ' '.join(f'{round(value, 9) + 0.0:.9f}' for value in (*translation, x, y, z, w))
    return f'{seconds}.{nanoseconds:09d} {numbers}\n'


def _fix_message(
    stamp_ns: int, robot_pose: RobotPose, map_frame: str, types: Mapping[str, Any]
) -> Any:  # noqa: ANN401 - a message class made from its definition
    w, x, y, z = (float(value) for value in quaternion_wxyz(robot_pose.map_from_base))
    tx, ty, tz = (float(value) for value in robot_pose.map_from_base.translation)
    seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS)
    stamp = types['builtin_interfaces/msg/Time'](sec=seconds, nanosec=nanoseconds)
    pose = types['geometry_msgs/msg/Pose'](
        position=types['geometry_msgs/msg/Point'](x=tx, y=ty, z=tz),
        orientation=types['geometry_msgs/msg/Quaternion'](x=x, y=y, z=z, w=w),
    )
    return types[POSE_WITH_COVARIANCE_STAMPED](
        header=types['std_msgs/msg/Header'](stamp=stamp, frame_id=map_frame),
        pose=types['geometry_msgs/msg/PoseWithCovariance'](
            pose=pose, covariance=np.array(robot_pose.covariance, dtype=np.float64).reshape(36)
        ),
    )
