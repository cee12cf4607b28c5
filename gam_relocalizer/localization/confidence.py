# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""How probable it is that a pose is right, and that it is near."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import expit

if TYPE_CHECKING:
    from numpy.typing import NDArray

# The confidence is about errors of at most these [map units, deg].
NEAR_POSITION = 0.25
NEAR_ROTATION_DEG = 2.0
_SAMPLES = 2000
_RESIDUAL_SIDE = 1024.0


@dataclass(frozen=True)
class Evidence:
    """What tells right poses from wrong ones, the same for every camera and map.

    The number of inliers and their share of the matches do not: given these, they tell nothing.

    Attributes:
        coverage: Share of the image that the inliers spread over, 0 to 1.
        residual: Root mean square of their reprojection errors [px at a longer side of 1024]. A
            wrong pose takes what falls within the threshold, which is larger than noise.
        unmatched: Share of what should be in view that is in parts of the image without an inlier.
    """

    coverage: float
    residual: float
    unmatched: float

    @property
    def terms(self) -> NDArray[np.float64]:
        """[4] what the belief weighs; the last is 1."""
        return np.array([self.coverage, self.residual, self.unmatched, 1.0])


# A wrong pose is hardly ever where the right one is expected; how seldom depends on the map, and on
# the last fix being right. This is less than one would guess for a single room.
EXPECTED_ODDS = 20.0
# A logistic regression on right and wrong poses by scripts/fit_belief.py, in the order of
# `Evidence.terms`. The script asks what the other checks leave over, so when these change it prints
# other numbers; these are from before the last changes, which move a belief by less than 0.01.
BELIEF = np.array([7.59, -0.51, -1.78, 2.36])


def scaled_residual(reprojection_error: float, longer_side: int) -> float:
    """A reprojection error [px] in images of this longer side, as `Evidence` wants it."""
    return reprojection_error * _RESIDUAL_SIDE / longer_side


def belief_in(evidence: Evidence) -> float:
    """Probability that a pose is right: of this very place, not of one that looks alike."""
    return float(expit(BELIEF @ evidence.terms))


def belief_as_expected(belief: float) -> float:
    """The belief in a pose that is also where odometry has brought the robot."""
    raised = EXPECTED_ODDS * odds(belief)
    return raised / (1.0 + raised)


def odds(probability: float) -> float:
    """How often it is so for each time that it is not."""
    return probability / max(1.0 - probability, sys.float_info.epsilon)


def nearness(covariance: NDArray[np.float64]) -> float:
    """Probability that a right pose is near: within 0.25 map units and 2 degrees of the truth.

    Args:
        covariance: [6,6] of the pose, order of REP-103.
    """
    errors = _draws() @ np.linalg.cholesky(covariance).T
    near = np.linalg.norm(errors[:, :3], axis=1) <= NEAR_POSITION
    near &= np.linalg.norm(errors[:, 3:], axis=1) <= math.radians(NEAR_ROTATION_DEG)
    return float(np.mean(near))


@cache
def _draws() -> NDArray[np.float64]:
    """[S,6] of a normal distribution of unit variance, always the same."""
    return np.random.default_rng(0).standard_normal((_SAMPLES, 6))
