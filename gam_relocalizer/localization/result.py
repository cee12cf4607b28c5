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
    """The verdict on one attempt. Numbers are those of RelocalizationStatus.msg."""

    ACCEPTED = 0
    UNDECODABLE_IMAGE = 1
    NO_CALIBRATION = 2
    NO_TRANSFORM = 3
    STALE_IMAGE = 4
    NO_IMAGE = 5
    NOT_ACTIVE = 6
    BUSY = 7
    TOO_FEW_FEATURES = 10
    NO_SCENE = 11
    TOO_FEW_MATCHES = 12
    NO_POSE = 13
    TOO_FEW_INLIERS = 14
    LOW_INLIER_RATIO = 15
    POOR_COVERAGE = 16
    UNCERTAIN = 17
    IMPLAUSIBLE = 18
    AMBIGUOUS = 19
    CONTRADICTED = 20
    MISCALIBRATED = 21


# Something beyond the pose itself speaks against it.
REFUTED = frozenset({Status.AMBIGUOUS, Status.MISCALIBRATED, Status.IMPLAUSIBLE})


@dataclass(frozen=True)
class Timings:
    """Milliseconds spent in each stage of one query."""

    extraction: float = 0.0
    retrieval: float = 0.0
    matching: float = 0.0
    pose: float = 0.0

    @property
    def total(self) -> float:
        """Sum over the stages [ms]."""
        return self.extraction + self.retrieval + self.matching + self.pose


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
