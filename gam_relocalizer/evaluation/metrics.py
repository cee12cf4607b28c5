# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The two numbers of the field: median errors, and recall at thresholds of position and angle."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from gam_relocalizer.geometry import PoseError


@dataclass(frozen=True, order=True)
class Threshold:
    """A pose is good when both errors are at most these.

    Attributes:
        position: Unit of the map, m when metric.
        rotation_deg: In degrees.
    """

    position: float
    rotation_deg: float

    def admits(self, error: PoseError) -> bool:
        """Whether an error is within."""
        return error.position <= self.position and error.rotation_deg <= self.rotation_deg


# 5 cm / 5 deg is customary indoors (7-Scenes); the last three are the paper's (Aachen, RobotCar).
THRESHOLDS = (
    Threshold(0.05, 5.0),
    Threshold(0.10, 5.0),
    Threshold(0.25, 2.0),
    Threshold(0.5, 5.0),
    Threshold(5.0, 10.0),
)
CORRECT = Threshold(0.25, 2.0)
"""A pose this good is what a confidence promises, see `LocalizationResult`."""


@dataclass(frozen=True)
class Accuracy:
    """Errors of a set of queries.

    Attributes:
        queries: Queries with a known truth.
        localized: Those among them with a pose.
        median_position: Over the localized ones [unit of the map]; NaN without any.
        median_rotation_deg: Over the localized ones; NaN without any.
        recall: Share of all queries within each threshold: a refused query counts as a miss.
    """

    queries: int
    localized: int
    median_position: float
    median_rotation_deg: float
    recall: Mapping[Threshold, float]


def accuracy(
    errors: Sequence[PoseError], queries: int, thresholds: Sequence[Threshold] = THRESHOLDS
) -> Accuracy:
    """Summarises errors.

    Args:
        errors: Of the localized queries.
        queries: Number of all queries with truth, refused ones included.
        thresholds: Where recall is measured.
    """
    return Accuracy(
        queries=queries,
        localized=len(errors),
        median_position=_median([error.position for error in errors]),
        median_rotation_deg=_median([error.rotation_deg for error in errors]),
        recall={
            threshold: sum(map(threshold.admits, errors)) / queries if queries else math.nan
            for threshold in thresholds
        },
    )


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else math.nan
