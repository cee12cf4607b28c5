# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What a fix says about the drift of the odometry: where its frame lies in the map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pycolmap

    from gam_relocalizer.localization.odometry import Fix


@dataclass(frozen=True)
class Correction:
    """Where the frame of the odometry lies in the map.

    `map_from_odom * odom_from_base` is where the robot is, at the rate of the odometry.

    Attributes:
        map_from_odom: The pose of the odometry's frame.
        stamp_ns: Of the image that it comes from [ns].
    """

    map_from_odom: pycolmap.Rigid3d
    stamp_ns: int


def correction_by(fix: Fix, stamp_ns: int) -> Correction:
    """What lays the odometry on a fix.

    Args:
        fix: The pose, with the odometry at its time.
        stamp_ns: Of its image [ns].
    """
    map_from_odom = fix.pose.map_from_base * fix.odometry.odom_from_base.inverse()
    return Correction(map_from_odom, stamp_ns)
