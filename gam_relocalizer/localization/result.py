# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What a query comes back with: always this one type, whatever happened."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum, unique
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    import pycolmap
    from numpy.typing import NDArray


@unique
class Status(Enum):
    """The verdict on one attempt. Numbers are those of RelocalizationStatus.msg.

    Attributes:
        meaning: What it says, in a sentence.
        remedy: What to do about it; empty where there is nothing to do.
    """

    meaning: str
    remedy: str

    def __new__(cls, number: int, meaning: str = '', remedy: str = '') -> Status:
        """The number is the value, so that `Status(number)` finds it."""
        status = object.__new__(cls)
        status._value_ = number
        status.meaning = meaning
        status.remedy = remedy
        return status

    ACCEPTED = 0, 'A pose with this stamp is on `/relocalized_pose`.'
    UNDECODABLE_IMAGE = (
        1,
        'The image has an unknown encoding, is truncated or damaged.',
        'See `reason`; check the driver or the transport.',
    )
    NO_CALIBRATION = (
        2,
        'There is no CameraInfo, or one without calibration, or one of another image size.',
        'Remap `camera_info`; calibrate; publish the CameraInfo of the same mode as the image.',
    )
    NO_TRANSFORM = (
        3,
        'A pose was found, but the mount of the camera is not known at that time.',
        "Publish it in TF, set `base_from_camera`, or `base_frame: ''` for the camera's pose.",
    )
    STALE_IMAGE = (
        4,
        'The image is not newer than the last one tried.',
        'Check that the driver stamps its images.',
    )
    NO_IMAGE = (
        5,
        'Answer of a service: no image came in time, or what was under way was dropped (another '
        'map, time jumped back).',
        'Remap `image`; check the driver; ask again.',
    )
    NOT_ACTIVE = (
        6,
        'Answer of a service: the node is not active, or was deactivated meanwhile.',
        '`reason` names the command.',
    )
    BUSY = (
        7,
        "Answer of a service: too many wait already, or others' attempts took until the time was "
        'over.',
        'Ask again, less often.',
    )
    TOO_FEW_FEATURES = (
        10,
        'The image is dark, blurred or without texture.',
        'Mind light, exposure and lens; it passes when the robot moves on.',
    )
    NO_SCENE = (11, 'No reference image was retrieved.', 'The map is empty: build it again.')
    TOO_FEW_MATCHES = (
        12,
        'The place is not in the map, or looks different.',
        'Map it, or map it in this light.',
    )
    NO_POSE = (
        13,
        'The matches agree on no pose.',
        'Map the place, or map it in this light.',
    )
    TOO_FEW_INLIERS = (
        14,
        'Too few matches agree.',
        'Map the place, or map it in this light; `min_inliers`.',
    )
    LOW_INLIER_RATIO = (
        15,
        'Too small a share of the matches agrees: probably chance.',
        'Map the place, or map it in this light; `min_inlier_ratio`.',
    )
    POOR_COVERAGE = (
        16,
        'All that agrees lies in a small part of the image: one object, not the place.',
        'Wait for a view that shows more; `min_coverage`.',
    )
    UNCERTAIN = (
        17,
        'The pose is not precise enough.',
        'Wait for a view that shows more; `max_relative_std`, `max_rotation_std_deg`.',
    )
    IMPLAUSIBLE = (
        18,
        "The pose would see the reference image's points mirrored, as from behind a wall; or the "
        'image looks more like the map when it is mirrored; or the base would lean beyond '
        '`max_tilt_deg`; or odometry speaks against it, and it is held back.',
        'Check that the images are not mirrored, that the mount is right, and what `odom` is of; '
        'otherwise the image shows another place.',
    )
    AMBIGUOUS = (
        19,
        'Two scenes of the map make nearly as good a case for two different poses: the place looks '
        'like another one in the map (the same poster, door or room twice).',
        'Wait for a view that shows more; `min_odds_against_rival`.',
    )
    CONTRADICTED = (
        20,
        'Much of what should be in view of the pose is not in the image: what agrees is one thing '
        'that hangs elsewhere too or was moved, or the view is mostly hidden.',
        'Wait for a view that shows more. Where it stays so, the place has changed: map it again. '
        '`min_belief`',
    )
    MISCALIBRATED = (
        21,
        'The image fits another focal length better than the given one.',
        'Calibrate at the resolution and zoom that are used, and publish that CameraInfo. Check '
        '`image_is_rectified`.',
    )


# Something beyond the pose itself speaks against it.
REFUTED = frozenset({Status.AMBIGUOUS, Status.MISCALIBRATED, Status.IMPLAUSIBLE})


@dataclass(frozen=True)
class Timings:
    """Milliseconds spent in each stage of one query.

    `pose` finds and refines it, with its covariance; `verdict` is all that only decides whether to
    believe it.
    """

    extraction: float = 0.0
    retrieval: float = 0.0
    matching: float = 0.0
    pose: float = 0.0
    verdict: float = 0.0

    @property
    def total(self) -> float:
        """Sum over the stages [ms]."""
        return self.extraction + self.retrieval + self.matching + self.pose + self.verdict


@dataclass(frozen=True)
class Support:
    """How far an image shows what is in view of its pose.

    Attributes:
        in_view: Points of the map that should be in view.
        unmatched: Share of them in parts of the image without any inlier, 0 to 1; 1 for none.
    """

    in_view: int
    unmatched: float


@dataclass(frozen=True)
class PoseEstimate:
    """A pose with what speaks for it.

    Attributes:
        camera_from_map: The estimate.
        covariance: [6,6] of the camera's pose in the map, order of REP-103: x, y, z [m^2], then
            rotations about the fixed axes of the map [rad^2].
        inlier_keypoints: [K,2] pixels of the inliers (COLMAP convention).
        inlier_features: [K] indices of the local features that they are.
        inlier_points: [K] indices into the map's points.
        inlier_ratio: Inliers per match.
        coverage: Share of the image that the inliers spread over, 0 to 1.
        reprojection_error: Root mean square over the inliers [px].
        support: Whether the image shows what the pose says.
        belief: Probability that the pose is right, that is of this very place, 0 to 1.
    """

    camera_from_map: pycolmap.Rigid3d
    covariance: NDArray[np.float64]
    inlier_keypoints: NDArray[np.float32]
    inlier_features: NDArray[np.int64]
    inlier_points: NDArray[np.int64]
    inlier_ratio: float
    coverage: float
    reprojection_error: float
    support: Support
    belief: float

    @property
    def inliers(self) -> int:
        """Number of inliers."""
        return len(self.inlier_points)


@dataclass(frozen=True)
class LocalizationResult:
    """The outcome of one query.

    Attributes:
        status: The verdict.
        reason: The verdict in words, with the numbers that decided it.
        estimate: The best pose found; present with every ACCEPTED, and with a rejected pose for
            whoever wants to draw it. Act on it only when `accepted`.
        keypoints: Number of local features of the query.
        matches: Number of one-to-one matches in the scene that decided.
        scene: Name of the reference image whose scene decided, or empty.
        scenes_tried: Number of scenes matched.
        confidence: Probability that the best pose found is within 0.25 m and 2 degrees of the
            truth (map units where the map is not metric); 0 without one, and for one that is
            refuted: ambiguous, miscalibrated or implausible.
        timings: Time per stage.
    """

    status: Status
    reason: str = ''
    estimate: PoseEstimate | None = None
    keypoints: int = 0
    matches: int = 0
    scene: str = ''
    scenes_tried: int = 0
    confidence: float = 0.0
    timings: Timings = field(default_factory=Timings)

    def judged(self, status: Status, reason: str) -> LocalizationResult:
        """The same result with this verdict on its pose."""
        confidence = 0.0 if status in REFUTED else self.confidence
        return replace(self, status=status, reason=reason, confidence=confidence)

    @property
    def accepted(self) -> bool:
        """Whether the pose may be used."""
        return self.status is Status.ACCEPTED

    @property
    def inliers(self) -> int:
        """Inliers of the best pose found, 0 without one."""
        return 0 if self.estimate is None else self.estimate.inliers
