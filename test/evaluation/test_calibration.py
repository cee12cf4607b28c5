# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Numbers about confidences and covariances whose truth is known."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from gam_relocalizer.evaluation.calibration import (
    calibrate,
    precision_recall,
    precision_recall_figure,
    reliability_figure,
    summarise_nees,
)
from gam_relocalizer.plots import write_picture

if TYPE_CHECKING:
    from pathlib import Path

CONFIDENCES = hnp.arrays(float, st.integers(1, 60), elements=st.floats(0.0, 1.0))


def outcomes_of(confidence: np.ndarray, seed: int) -> np.ndarray:
    """Each comes true with the probability that it promises."""
    return np.random.default_rng(seed).random(len(confidence)) < confidence


def nees_of_gaussians(trials: int, scale: float = 1.0) -> np.ndarray:
    """NEES of errors drawn from a full covariance, and judged by it times a scale."""
    rng = np.random.default_rng(3)
    factor = rng.normal(size=(6, 6)) + 3.0 * np.eye(6)
    errors = rng.normal(size=(trials, 6)) @ factor.T
    information = np.linalg.inv(scale * factor @ factor.T)
    return np.einsum('ki,ij,kj->k', errors, information, errors)


def test_confidences_that_come_true_have_no_calibration_error() -> None:
    confidence = np.random.default_rng(0).random(40_000)
    found = calibrate(confidence, outcomes_of(confidence, seed=1))
    assert found.expected_calibration_error < 0.01
    # the mean of p (1 - p) over p in [0, 1]
    assert found.brier_score == pytest.approx(1.0 / 6.0, abs=0.005)
    assert len(found.bins) == 10
    for one in found.bins:
        assert one.correct == pytest.approx(one.confidence, abs=0.03)


def test_overconfidence_is_the_calibration_error() -> None:
    correct = np.arange(1000) % 10 < 6
    found = calibrate(np.full(1000, 0.9), correct)
    assert found.expected_calibration_error == pytest.approx(0.3)
    assert found.brier_score == pytest.approx(0.6 * 0.01 + 0.4 * 0.81)


def test_errors_of_bins_weigh_by_their_queries() -> None:
    found = calibrate([0.05, 0.85, 0.85, 0.85], [False, True, True, False])
    assert [(one.count, one.low, one.high) for one in found.bins] == [
        (1, 0.0, pytest.approx(0.1)),
        (3, pytest.approx(0.8), pytest.approx(0.9)),
    ]
    assert found.expected_calibration_error == pytest.approx(
        0.25 * 0.05 + 0.75 * abs(0.85 - 2.0 / 3.0)
    )


def test_certainty_belongs_to_the_last_bin() -> None:
    (only,) = calibrate([1.0, 0.95], [True, True]).bins
    assert (only.count, only.high) == (2, 1.0)


def test_nothing_has_no_calibration() -> None:
    found = calibrate([], [])
    assert found.bins == ()
    assert math.isnan(found.expected_calibration_error)
    assert math.isnan(found.brier_score)


@given(confidence=CONFIDENCES, seed=st.integers(0, 1000))
def test_bins_hold_every_query_between_their_ends(confidence: np.ndarray, seed: int) -> None:
    found = calibrate(confidence, outcomes_of(confidence, seed))
    assert sum(one.count for one in found.bins) == len(confidence)
    for one in found.bins:
        assert one.low - 1e-12 <= one.confidence <= one.high + 1e-12
    assert 0.0 <= found.expected_calibration_error <= 1.0
    assert 0.0 <= found.brier_score <= 1.0


def test_precision_and_recall_over_the_threshold() -> None:
    curve = precision_recall([0.9, 0.8, 0.8, 0.1], [True, True, False, True], answerable=5)
    np.testing.assert_allclose(curve.thresholds, [0.9, 0.8, 0.1])
    np.testing.assert_allclose(curve.precision, [1.0, 2.0 / 3.0, 3.0 / 4.0])
    np.testing.assert_allclose(curve.recall, [0.2, 0.4, 0.6])
    assert curve.recall_without_error == pytest.approx(0.2)


def test_a_wrong_answer_with_the_highest_confidence_leaves_no_recall_without_error() -> None:
    curve = precision_recall([0.9, 0.99], [True, False], answerable=2)
    assert curve.recall_without_error == 0.0


def test_nothing_found_has_no_curve() -> None:
    curve = precision_recall([], [], answerable=3)
    assert len(curve.thresholds) == len(curve.precision) == len(curve.recall) == 0
    assert curve.recall_without_error == 0.0


@given(confidence=CONFIDENCES, seed=st.integers(0, 1000), more=st.integers(0, 10))
def test_lower_thresholds_never_lose_recall(confidence: np.ndarray, seed: int, more: int) -> None:
    correct = outcomes_of(confidence, seed)
    curve = precision_recall(confidence, correct, answerable=len(confidence) + more)
    assert (np.diff(curve.thresholds) < 0).all()
    assert (np.diff(curve.recall) >= 0).all()
    assert curve.recall[-1] == pytest.approx(correct.sum() / (len(confidence) + more))
    assert curve.precision[-1] == pytest.approx(correct.mean())


def test_errors_drawn_from_their_covariance_are_consistent() -> None:
    found = summarise_nees(nees_of_gaussians(2000))
    assert found.consistent
    assert found.trials == 2000
    assert found.mean == pytest.approx(6.0, abs=0.2)
    assert found.band[0] < 6.0 < found.band[1]
    assert found.within == pytest.approx(0.95, abs=0.015)
    assert found.gross == 0.0
    assert found.worst_sigma < 10.0


@pytest.mark.parametrize(('scale', 'side'), [(0.7, 1), (1.4, -1)])
def test_wrong_covariances_leave_the_band(scale: float, side: int) -> None:
    found = summarise_nees(nees_of_gaussians(500, scale))
    assert not found.consistent
    assert np.sign(found.mean - 6.0) == side
    assert np.sign(0.95 - found.within) == side


def test_the_band_narrows_with_the_trials() -> None:
    few, many = (summarise_nees(np.full(trials, 6.0)).band for trials in (500, 8000))
    # normal for many trials: the variance of one NEES is 12
    assert few[1] - few[0] == pytest.approx(2 * 1.96 * math.sqrt(12 / 500), rel=0.01)
    assert (few[1] - few[0]) / (many[1] - many[0]) == pytest.approx(4.0, rel=0.01)


def test_the_worst_error_is_told_in_sigmas() -> None:
    found = summarise_nees([6.0, 6.0, 6.0, 11.0**2])
    assert found.gross == 0.25
    assert found.worst_sigma == pytest.approx(11.0)


def test_reliability_figure_shows_bins_and_counts() -> None:
    found = calibrate([0.05, 0.85, 0.85, 0.85], [False, True, True, False])
    shares, counts = reliability_figure(found).axes
    diagonal, measured = shares.lines
    np.testing.assert_allclose(diagonal.get_xdata(), diagonal.get_ydata())
    np.testing.assert_allclose(measured.get_xdata(), [0.05, 0.85])
    np.testing.assert_allclose(measured.get_ydata(), [0.0, 2.0 / 3.0])
    assert [bar.get_height() for bar in counts.patches] == [1, 3]
    np.testing.assert_allclose([bar.get_x() for bar in counts.patches], [0.0, 0.8])


def test_figure_of_precision_over_recall_is_written_whole(tmp_path: Path) -> None:
    curve = precision_recall([0.9, 0.8], [True, False], answerable=2)
    figure = precision_recall_figure(curve)
    (line,) = figure.axes[0].lines
    np.testing.assert_allclose(line.get_xdata(), [0.5, 0.5])
    np.testing.assert_allclose(line.get_ydata(), [1.0, 0.5])
    write_picture(tmp_path / 'curve.png', figure)
    assert [path.name for path in tmp_path.iterdir()] == ['curve.png']
    assert (tmp_path / 'curve.png').read_bytes().startswith(b'\x89PNG')
