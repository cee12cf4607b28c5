# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What a replay left in its folder: its attempts, and the poses of those that were accepted."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from io import StringIO
from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.errors import UsageError
from gam_relocalizer.geometry import PoseError, rigid3d_from
from gam_relocalizer.localization.result import Status
from gam_relocalizer.replay.summary import position_between
from gam_relocalizer.replay.writing import ATTEMPT_COLUMNS, ATTEMPTS, POSES, SUMMARY

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    import pycolmap
    from numpy.typing import NDArray

# A week of attempts, two a second.
_MAX_BYTES = 256 * 2**20


@dataclass(frozen=True)
class DriveAttempt:
    """One image that was tried.

    Attributes:
        stamp_ns: Its stamp [ns].
        status: The verdict.
        reason: The verdict in words.
        inliers: Of the best pose found.
        map_from_base: The fix, when accepted.
        error: Of the fix, where the truth is known.
    """

    stamp_ns: int
    status: Status
    reason: str
    inliers: int
    map_from_base: pycolmap.Rigid3d | None
    error: PoseError | None = None


@dataclass(frozen=True)
class Drive:
    """A replayed drive.

    Attributes:
        map_id: Of the map that it was localized in.
        attempts: In the order of their stamps.
    """

    map_id: str
    attempts: tuple[DriveAttempt, ...]

    @property
    def fixes(self) -> tuple[DriveAttempt, ...]:
        """Those that were accepted."""
        return tuple(one for one in self.attempts if one.map_from_base is not None)

    def guessed_position(self, stamp_ns: int) -> NDArray[np.float64] | None:
        """[3] between the fixes before and after, by time; nothing in a drive without any."""
        fixes = [(one.stamp_ns, one.map_from_base) for one in self.attempts if one.map_from_base]
        return position_between(stamp_ns, fixes)


def read_drive(folder: Path) -> Drive:
    """Reads the output folder of `gam_relocalizer replay`.

    Raises:
        UsageError: It is none, or it is damaged, or of an earlier release.
    """
    try:
        summary = json.loads(_text(folder / SUMMARY))
        poses = dict(_pose(line) for line in _text(folder / POSES).splitlines())
        attempts = [_attempt(line, poses) for line in _table(_text(folder / ATTEMPTS))]
        map_id = str(summary['map_id'])
    except (OSError, ValueError, KeyError, TypeError, csv.Error, RecursionError) as err:
        msg = (
            f'{folder}: cannot be read as the output of a replay ({err}); expected {SUMMARY}, '
            f'{POSES} and {ATTEMPTS} as `gam_relocalizer replay` writes them'
        )
        raise UsageError(msg) from err
    return Drive(map_id, tuple(sorted(attempts, key=lambda one: one.stamp_ns)))


def _text(file: Path) -> str:
    if file.stat().st_size > _MAX_BYTES:
        msg = f'{file.name} is larger than {_MAX_BYTES} bytes'
        raise ValueError(msg)
    return file.read_text(encoding='utf-8')


def _table(text: str) -> Iterator[dict[str, str]]:
    lines = csv.DictReader(StringIO(text), strict=True)
    if missing := set(ATTEMPT_COLUMNS).difference(lines.fieldnames or ()):
        msg = f'{ATTEMPTS} lacks the column {min(missing)}'
        raise ValueError(msg)
    return lines


def _pose(line: str) -> tuple[int, pycolmap.Rigid3d]:
    """A line of a trajectory; the stamp's nanoseconds are written out in full."""
    stamp, *words = line.split()
    seconds, _, fraction = stamp.partition('.')
    tx, ty, tz, qx, qy, qz, qw = (float(word) for word in words)
    if not np.isfinite([tx, ty, tz, qx, qy, qz, qw]).all():
        msg = f'`{line}` holds a number that is not finite'
        raise ValueError(msg)
    return int(f'{seconds}{fraction:0<9}'), rigid3d_from((qw, qx, qy, qz), (tx, ty, tz))


def _attempt(line: dict[str, str], poses: dict[int, pycolmap.Rigid3d]) -> DriveAttempt:
    stamp_ns, status = int(line['stamp_ns']), Status[line['status']]
    return DriveAttempt(
        stamp_ns=stamp_ns,
        status=status,
        reason=line['reason'],
        inliers=int(line['inliers']),
        map_from_base=poses[stamp_ns] if status is Status.ACCEPTED else None,
        error=_error(line),
    )


def _error(line: dict[str, str]) -> PoseError | None:
    position, rotation_deg = line['position_error'], line['rotation_error_deg']
    return PoseError(float(position), float(rotation_deg)) if position else None
