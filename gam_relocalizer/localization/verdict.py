# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Whether a pose may be used: a robot must never be told a wrong one with confidence."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.geometry import pose_error
from gam_relocalizer.localization.confidence import odds
from gam_relocalizer.localization.result import PoseEstimate, Status

if TYPE_CHECKING:
    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.geometry import PoseError
    from gam_relocalizer.localization.focal_length import FocalLength
    from gam_relocalizer.localization.look_alikes import LookAlike

# Coverage is counted on a grid of so many cells along each side of the image.
GRID = 8
# Poses further apart than this contradict each other: share of the distance of the inliers, angle.
RIVAL_POSITION_SHARE = 0.1
RIVAL_ROTATION_DEG = 5.0
# A focal length that is off by less than this, or by less than so many standard deviations of what
# the image tells of it, is no reason to doubt the calibration.
FOCAL_LENGTH_TOLERANCE = 0.08
FOCAL_LENGTH_SIGMAS = 3.0
# Inliers whose look-alikes agree on another pose: up to 0.23 were seen in rooms where every wall
# has its own pictures, 0.27 and more in a corridor of identical doors.
MAX_LOOK_ALIKE_SHARE = 0.25
# Among the eight candidates of each keypoint so many agree on something by chance.
MAX_LOOK_ALIKES_BY_CHANCE = 15
# Images of a real place were seen to be up to 0.06 more like the map when mirrored.
MIRROR_MARGIN = 0.1


@dataclass(frozen=True)
class VerdictOptions:
    """What a pose must show to be accepted.

    The defaults lie above what wrong matches were seen to reach, random ones and those of images of
    other places. Inliers in one blob are no evidence, hence the coverage; chance finds more inliers
    among more matches, hence the ratio.

    Attributes:
        min_inliers: Least number of inliers.
        min_inlier_ratio: Least share of inliers among the matches.
        min_coverage: Least share of the image's cells with an inlier.
        max_relative_std: Greatest standard deviation of the position in its worst direction, per
            median distance of the inliers; without unit, so it holds in maps of any scale.
        max_rotation_std_deg: Greatest standard deviation of the orientation about its worst axis.
        min_orientation_kept: Least share of triangles of neighbouring points that query and
            reference image see the same way round. Mirrored points of a wall fit a pose behind the
            wall to the pixel.
        min_belief: Least probability that the pose is right, see `confidence.Evidence`.
        min_odds_against_rival: A contradicting pose from another scene makes the best one
            ambiguous, unless this has so many times its odds. Places that look alike (the same
            poster in two rooms) show up here.
    """

    min_inliers: int = 25
    min_inlier_ratio: float = 0.06
    min_coverage: float = 0.15
    max_relative_std: float = 0.05
    max_rotation_std_deg: float = 2.0
    min_orientation_kept: float = 0.7
    min_belief: float = 0.96
    min_odds_against_rival: float = 7.5


@dataclass(frozen=True)
class Verdict:
    """A status and the sentence that explains it."""

    status: Status
    reason: str


def judge(
    estimate: PoseEstimate,
    inlier_points: NDArray[np.float64],
    orientation_kept: float,
    options: VerdictOptions,
) -> Verdict:
    """Accepts or rejects a pose.

    Args:
        estimate: The pose and what speaks for it.
        inlier_points: [K,3] positions of its inliers, map frame.
        orientation_kept: Share of their triangles seen as the reference image sees them.
        options: The thresholds.
    """
    position_std, rotation_std_deg = worst_deviations(estimate.covariance)
    distance = _median_distance(estimate, inlier_points)
    found = (
        f'{estimate.inliers} inliers, {estimate.inlier_ratio:.0%} of the matches, over '
        f'{estimate.coverage:.0%} of the image'
    )
    checks = (
        (
            estimate.inliers < options.min_inliers,
            Status.TOO_FEW_INLIERS,
            f'needs {options.min_inliers} inliers',
        ),
        (
            estimate.inlier_ratio < options.min_inlier_ratio,
            Status.LOW_INLIER_RATIO,
            f'needs {options.min_inlier_ratio:.0%} of the matches',
        ),
        (
            estimate.coverage < options.min_coverage,
            Status.POOR_COVERAGE,
            f'needs {options.min_coverage:.0%} of the image',
        ),
        (
            position_std > options.max_relative_std * distance,
            Status.UNCERTAIN,
            f'the standard deviation of the position is {position_std:.3g} at a distance of '
            f'{distance:.3g}, allowed is {options.max_relative_std:.0%} of it',
        ),
        (
            rotation_std_deg > options.max_rotation_std_deg,
            Status.UNCERTAIN,
            f'the standard deviation of the orientation is {rotation_std_deg:.2f} deg, allowed '
            f'are {options.max_rotation_std_deg:.2f} deg',
        ),
        (
            orientation_kept < options.min_orientation_kept,
            Status.IMPLAUSIBLE,
            f'{orientation_kept:.0%} of their triangles are the same way round as in the reference '
            f'image, needs {options.min_orientation_kept:.0%}; the others are mirrored',
        ),
        (
            estimate.belief < options.min_belief,
            Status.CONTRADICTED,
            f'{estimate.support.unmatched:.0%} of what should be in view is where nothing matches, '
            f'the residual is {estimate.reprojection_error:.1f} px: with such a view '
            f'{estimate.belief:.0%} of poses are right, needs {options.min_belief:.0%}',
        ),
    )
    for failed, status, why in checks:
        if failed:
            return Verdict(status, f'{found}; {why}')
    return Verdict(Status.ACCEPTED, found)


def judge_rival(
    best: PoseEstimate,
    rival: PoseEstimate,
    inlier_points: NDArray[np.float64],
    options: VerdictOptions,
) -> Verdict | None:
    """Rejects the best pose when another scene makes nearly as good a case for another one.

    Args:
        best: The most probable pose.
        rival: A pose from another scene.
        inlier_points: [K,3] positions of the inliers of the best pose, map frame.
        options: The thresholds.
    """
    apart = _contradiction(best, rival.camera_from_map, inlier_points)
    if apart is None:
        return None
    if odds(best.belief) >= options.min_odds_against_rival * odds(rival.belief):
        return None
    return Verdict(
        Status.AMBIGUOUS,
        f'{best.inliers} inliers speak for one pose and {rival.inliers} for another one '
        f'{apart.position:.3g} and {apart.rotation_deg:.0f} deg away, which is nearly as probable; '
        f'the place may look like another one in the map',
    )


def judge_look_alike(
    estimate: PoseEstimate, look_alike: LookAlike, inlier_points: NDArray[np.float64]
) -> Verdict | None:
    """Rejects a pose when its inliers look like those of another place in the map.

    Args:
        estimate: The pose.
        look_alike: Another pose, from what looks the same elsewhere.
        inlier_points: [K,3] positions of the inliers, map frame.
    """
    apart = _contradiction(estimate, look_alike.camera_from_map, inlier_points)
    if apart is None or not are_many_look_alikes(look_alike.agreeing, look_alike.asked):
        return None
    return Verdict(
        Status.AMBIGUOUS,
        f'{look_alike.share:.0%} of the inliers look like other points that speak for a pose '
        f'{apart.position:.3g} and {apart.rotation_deg:.0f} deg away; the map has several such '
        f'places',
    )


def are_many_look_alikes(agreeing: int, asked: int) -> bool:
    """Whether so many of the inliers that were asked speak against a pose."""
    return agreeing > MAX_LOOK_ALIKES_BY_CHANCE and agreeing / asked > MAX_LOOK_ALIKE_SHARE


def judge_focal_length(focal_length: FocalLength) -> Verdict | None:
    """Rejects a pose whose image fits another focal length than the given one."""
    off = abs(math.log(focal_length.ratio))
    if off <= max(FOCAL_LENGTH_TOLERANCE, FOCAL_LENGTH_SIGMAS * focal_length.log_sigma):
        return None
    return Verdict(
        Status.MISCALIBRATED,
        f'the image fits {focal_length.ratio:.2f} times the given focal length better; is the '
        f'calibration that of this camera, at this resolution and zoom?',
    )


def judge_tilt(tilt_deg: float, tolerance_deg: float) -> Verdict | None:
    """Rejects a pose that leans against gravity."""
    if tilt_deg <= tolerance_deg:
        return None
    return Verdict(
        Status.IMPLAUSIBLE,
        f'the pose is tilted by {tilt_deg:.1f} deg against gravity, allowed are '
        f'{tolerance_deg:.1f} deg',
    )


def judge_mirrored(likeness: float, mirrored_likeness: float) -> Verdict | None:
    """Rejects an image that is more like the map when mirrored.

    Args:
        likeness: Greatest product of its global descriptor and that of a reference image.
        mirrored_likeness: The same for the mirrored image.
    """
    if mirrored_likeness - likeness <= MIRROR_MARGIN:
        return None
    return Verdict(
        Status.IMPLAUSIBLE,
        f'the image looks more like the map when it is mirrored ({mirrored_likeness:.2f} against '
        f'{likeness:.2f}); does the driver flip it?',
    )


def coverage_of(keypoints: NDArray[np.floating], camera: pycolmap.Camera) -> float:
    """Share of the cells of a grid over the image that hold a keypoint, 0 to 1."""
    size = np.array([camera.width, camera.height], dtype=float)
    cells = np.clip(np.floor(keypoints / size * GRID).astype(int), 0, GRID - 1)
    return len(np.unique(cells @ [GRID, 1])) / GRID**2


def worst_deviations(covariance: NDArray[np.float64]) -> tuple[float, float]:
    """Greatest standard deviations of the position [map units] and orientation [deg]."""
    position = math.sqrt(float(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
    rotation = math.sqrt(float(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
    return position, math.degrees(rotation)


def _contradiction(
    estimate: PoseEstimate, rival: pycolmap.Rigid3d, inlier_points: NDArray[np.float64]
) -> PoseError | None:
    """How far a rival `camera_from_map` is from the estimate, if too far to mean the same."""
    apart = pose_error(rival, estimate.camera_from_map)
    near = RIVAL_POSITION_SHARE * _median_distance(estimate, inlier_points)
    if apart.position <= near and apart.rotation_deg <= RIVAL_ROTATION_DEG:
        return None
    return apart


def _median_distance(estimate: PoseEstimate, inlier_points: NDArray[np.float64]) -> float:
    camera_in_map = estimate.camera_from_map.tgt_origin_in_src()
    return float(np.median(np.linalg.norm(inlier_points - camera_in_map, axis=1)))
