# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What a replay comes back with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pycolmap

    from gam_relocalizer.localization.correction import Correction
    from gam_relocalizer.localization.pictures import Illustration
    from gam_relocalizer.localization.result import LocalizationResult
    from gam_relocalizer.localization.robot_pose import RobotPose


@dataclass(frozen=True)
class Attempt:
    """One query of the replay.

    Attributes:
        stamp_ns: Stamp of the image [ns].
        result: What the localizer said.
        robot_pose: The body's pose, when accepted.
        truth: map_from_base at that time, when the bag tells.
        correction: Where the odometry's frame lies in the map, as known after it.
    """

    stamp_ns: int
    result: LocalizationResult
    robot_pose: RobotPose | None = None
    truth: pycolmap.Rigid3d | None = None
    correction: Correction | None = None


@dataclass(frozen=True)
class OdometrySample:
    """One message of the odometry.

    Attributes:
        stamp_ns: When it holds [ns].
        odom_from_base: The pose of the body.
        truth: map_from_base at that time, when the bag tells.
    """

    stamp_ns: int
    odom_from_base: pycolmap.Rigid3d
    truth: pycolmap.Rigid3d | None = None


@dataclass(frozen=True)
class TimedIllustration:
    """An image of a drive with the best pose found for it.

    Attributes:
        stamp_ns: Stamp of the image [ns].
        illustration: Image and pose.
    """

    stamp_ns: int
    illustration: Illustration


@dataclass(frozen=True)
class Replay:
    """The outcome of a replay.

    Attributes:
        attempts: In the order of their stamps, which strictly increase.
        image_topic: Where the images came from.
        images: Number of images there.
        illustrations: A few images with a pose: the accepted one with the most inliers, then those
            that went worst, then refused ones.
        odometry: In the order of its stamps, which strictly increase; empty without its topic, and
            for a map that is not metric.
    """

    attempts: tuple[Attempt, ...]
    image_topic: str
    images: int
    illustrations: tuple[TimedIllustration, ...]
    odometry: tuple[OdometrySample, ...] = ()
