# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Do confidence and covariance tell the truth: reliability, precision and recall, NEES."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import chi2

from gam_relocalizer.geometry import rotation_of
from gam_relocalizer.plots import FOUND, WIDTH, finish

if TYPE_CHECKING:
    import pycolmap
    from numpy.typing import ArrayLike, NDArray

BINS = 10
POSE_FREEDOM = 6
BAND = 0.95
GROSS_SIGMA = 10.0
"""A pose so many standard deviations off has a covariance that is worth nothing."""


@dataclass(frozen=True)
class ReliabilityBin:
    """The queries whose confidence lies in an interval.

    Attributes:
        low: Lower end, included.
        high: Upper end, excluded but for 1.
        count: Number of queries, at least one.
        confidence: Mean confidence.
        correct: Share of the queries that are correct.
    """

    low: float
    high: float
    count: int
    confidence: float
    correct: float


@dataclass(frozen=True)
class Calibration:
    """How well confidences agree with what comes true.

    Attributes:
        bins: Those that hold queries, by rising confidence.
        expected_calibration_error: Mean distance between confidence and share correct of the bins,
            each weighted by its count (Guo et al., ICML 2017); NaN without queries.
        brier_score: Mean squared distance between confidence and outcome, 0 or 1; NaN without
            queries.
    """

    bins: tuple[ReliabilityBin, ...]
    expected_calibration_error: float
    brier_score: float


@dataclass(frozen=True)
class PrecisionRecall:
    """What is accepted when everything of at least a confidence is.

    Attributes:
        thresholds: [T] every confidence that occurs, descending.
        precision: [T] correct among the accepted.
        recall: [T] correct and accepted among the queries that have an answer.
    """

    thresholds: NDArray[np.float64]
    precision: NDArray[np.float64]
    recall: NDArray[np.float64]

    @property
    def recall_without_error(self) -> float:
        """The highest recall at which nothing false is accepted; 0 if there is none."""
        return float(self.recall[self.precision == 1.0].max(initial=0.0))


@dataclass(frozen=True)
class NeesSummary:
    """Normalised estimation errors squared of poses; their true mean is 6, the degrees of freedom.

    Attributes:
        trials: Number of poses, K.
        mean: Their mean; above the band covariances are too small, below it too large.
        band: Where the mean of K trials of exact covariances lies with 95 % probability.
        within: Share of the truths inside of the 95 % ellipsoid of their estimate.
        gross: Share of the errors beyond `GROSS_SIGMA`, in the metric of the covariance.
        worst_sigma: The greatest such error, the root of the greatest NEES.
    """

    trials: int
    mean: float
    band: tuple[float, float]
    within: float
    gross: float
    worst_sigma: float

    @property
    def consistent(self) -> bool:
        """Whether the mean lies in the band."""
        return self.band[0] <= self.mean <= self.band[1]


def calibrate(confidence: ArrayLike, correct: ArrayLike, bins: int = BINS) -> Calibration:
    """Compares confidences with what came true, in bins of equal width.

    Args:
        confidence: [K] in [0, 1].
        correct: [K] bool.
        bins: Number of intervals that [0, 1] is cut into.
    """
    confidences, outcomes = np.asarray(confidence, float), np.asarray(correct, bool)
    edges = np.linspace(0.0, 1.0, bins + 1)
    bin_of = np.minimum(np.searchsorted(edges, confidences, side='right') - 1, bins - 1)
    occupied = tuple(
        ReliabilityBin(
            low=float(edges[one]),
            high=float(edges[one + 1]),
            count=int(np.count_nonzero(bin_of == one)),
            confidence=float(confidences[bin_of == one].mean()),
            correct=float(outcomes[bin_of == one].mean()),
        )
        for one in np.unique(bin_of)
    )
    if not occupied:
        return Calibration((), np.nan, np.nan)
    gaps = [abs(one.confidence - one.correct) for one in occupied]
    return Calibration(
        bins=occupied,
        expected_calibration_error=float(np.average(gaps, weights=[o.count for o in occupied])),
        brier_score=float(np.mean(np.square(confidences - outcomes))),
    )


def precision_recall(confidence: ArrayLike, correct: ArrayLike, answerable: int) -> PrecisionRecall:
    """Precision and recall over the confidence from which on results are accepted.

    Args:
        confidence: [K] of all results with a pose, adversarial queries included.
        correct: [K] bool.
        answerable: Number of queries that have a right answer, those without a pose included.
    """
    confidences, outcomes = np.asarray(confidence, float), np.asarray(correct, bool)
    thresholds = np.unique(confidences)[::-1]
    accepted = np.array([np.count_nonzero(confidences >= one) for one in thresholds])
    right = np.array([np.count_nonzero(outcomes[confidences >= one]) for one in thresholds])
    return PrecisionRecall(thresholds, right / np.maximum(accepted, 1), right / max(answerable, 1))


def normalised_error_squared(
    estimated: pycolmap.Rigid3d, truth: pycolmap.Rigid3d, covariance: NDArray[np.float64]
) -> float:
    """e^T P^-1 e of the camera's pose in the map, in the order of REP-103.

    Args:
        estimated: `camera_from_map`.
        truth: The true one.
        covariance: [6,6] of the pose of the camera in the map.
    """
    pose, true = estimated.inverse(), truth.inverse()
    turned = (rotation_of(pose) * rotation_of(true).inv()).as_rotvec()
    error = np.concatenate([pose.translation - true.translation, turned])
    return float(error @ np.linalg.solve(covariance, error))


def summarise_nees(nees: ArrayLike) -> NeesSummary:
    """Compares the NEES of 6-DoF poses with the chi-square distribution that they should follow.

    Bar-Shalom, Li, Kirubarajan: Estimation with Applications to Tracking and Navigation, 5.4.

    Args:
        nees: [K], K >= 1: each error e and its covariance P give e^T P^-1 e.
    """
    values = np.asarray(nees, float)
    trials = len(values)
    low, high = chi2.interval(BAND, POSE_FREEDOM * trials)
    sigmas = np.sqrt(values)
    return NeesSummary(
        trials=trials,
        mean=float(values.mean()),
        band=(float(low) / trials, float(high) / trials),
        within=float(np.mean(values <= chi2.ppf(BAND, POSE_FREEDOM))),
        gross=float(np.mean(sigmas > GROSS_SIGMA)),
        worst_sigma=float(sigmas.max()),
    )


def reliability_figure(calibration: Calibration) -> Figure:
    """Share correct over confidence, and below how many queries each point stands for."""
    figure = Figure(figsize=(WIDTH, 5.4), layout='constrained')
    shares, counts = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    confidences = [one.confidence for one in calibration.bins]
    shares.plot((0, 1), (0, 1), '--', color='0.6', label='calibrated')
    shares.plot(
        confidences,
        [one.correct for one in calibration.bins],
        'o-',
        color=FOUND,
        label='measured',
    )
    shares.set(ylabel='share correct', xlim=(0, 1), ylim=(-0.02, 1.02))
    shares.legend(fontsize=9, loc='lower right')
    for one in calibration.bins:
        counts.bar(one.low, one.count, one.high - one.low, align='edge', color=FOUND)
    counts.set(xlabel='confidence', ylabel='queries')
    for axes in (shares, counts):
        finish(axes)
    return figure


def precision_recall_figure(curve: PrecisionRecall) -> Figure:
    """Precision over recall."""
    figure = Figure(figsize=(WIDTH, 4.2), layout='constrained')
    axes = figure.subplots()
    axes.plot(curve.recall, curve.precision, '.-', color=FOUND)
    axes.set(xlabel='recall', ylabel='precision', xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    finish(axes)
    return figure
