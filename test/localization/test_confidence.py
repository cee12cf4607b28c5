# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The belief in a pose rises with what speaks for it; nearness is that of a Gaussian."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.stats import chi

from gam_relocalizer.localization.confidence import (
    BELIEF,
    NEAR_POSITION,
    NEAR_ROTATION_DEG,
    Evidence,
    belief_in,
    nearness,
    odds,
    scaled_residual,
)

shares = st.floats(0.0, 1.0)
evidences = st.builds(Evidence, coverage=shares, residual=st.floats(0.0, 12.0), unmatched=shares)


def covariance_of(position_std: float, rotation_std_deg: float) -> np.ndarray:
    return np.diag([position_std**2] * 3 + [math.radians(rotation_std_deg) ** 2] * 3)


def test_every_term_has_one_finite_weight() -> None:
    assert BELIEF.shape == Evidence(0.5, 1.0, 0.5).terms.shape
    assert np.isfinite(BELIEF).all()


@given(evidences)
def test_belief_is_a_probability(evidence: Evidence) -> None:
    assert 0.0 <= belief_in(evidence) <= 1.0
    assert belief_in(evidence) == belief_in(evidence)


@given(evidences, evidences)
def test_belief_rises_with_coverage_and_falls_with_residual_and_what_is_missing(
    first: Evidence, second: Evidence
) -> None:
    for name, sign in (('coverage', 1.0), ('residual', -1.0), ('unmatched', -1.0)):
        other = replace(first, **{name: getattr(second, name)})
        change = getattr(other, name) - getattr(first, name)
        assume(abs(change) > 1e-6)
        assert sign * change * (belief_in(other) - belief_in(first)) > 0.0


def test_view_that_shows_all_is_believed_and_one_that_shows_nothing_is_not() -> None:
    assert belief_in(Evidence(coverage=0.8, residual=1.0, unmatched=0.05)) > 0.95
    assert belief_in(Evidence(coverage=0.1, residual=6.0, unmatched=0.95)) < 0.5


def test_residual_does_not_depend_on_the_size_of_the_image() -> None:
    assert scaled_residual(2.0, 1024) == 2.0
    assert scaled_residual(2.0, 512) == scaled_residual(4.0, 1024) == scaled_residual(16.0, 4096)


def test_odds_are_for_against_against() -> None:
    assert odds(0.0) == 0.0
    assert odds(0.5) == 1.0
    assert odds(0.75) == pytest.approx(3.0)


@given(shares, shares)
def test_odds_are_finite_and_rise(first: float, second: float) -> None:
    low, high = sorted((first, second))
    assert 0.0 <= odds(low) <= odds(high) < math.inf


def test_certain_pose_is_near_and_uncertain_one_is_not() -> None:
    assert nearness(covariance_of(1e-3, 1e-2)) == 1.0
    assert nearness(covariance_of(1e3, 1e-2)) == 0.0
    assert nearness(covariance_of(1e-3, 170.0)) < 1e-3
    assert nearness(covariance_of(1e-12, 1e-12)) == 1.0


@pytest.mark.parametrize('sigmas', [0.5, 1.0, 1.5, 2.5])
def test_nearness_is_that_of_a_gaussian(sigmas: float) -> None:
    expected = chi(3).cdf(sigmas)
    position, rotation = NEAR_POSITION / sigmas, NEAR_ROTATION_DEG / sigmas
    assert nearness(covariance_of(position, 1e-6)) == pytest.approx(expected, abs=0.04)
    assert nearness(covariance_of(1e-6, rotation)) == pytest.approx(expected, abs=0.04)
    assert nearness(covariance_of(position, rotation)) == pytest.approx(expected**2, abs=0.04)


def test_errors_that_go_together_are_near_together() -> None:
    sigmas = 1.5
    position, rotation = NEAR_POSITION / sigmas, math.radians(NEAR_ROTATION_DEG / sigmas)
    apart = np.diag([position**2, 1e-12, 1e-12, rotation**2, 1e-12, 1e-12])
    together = apart.copy()
    together[0, 3] = together[3, 0] = 0.999 * position * rotation
    assert nearness(together) > nearness(apart) + 0.05


@given(st.floats(1e-4, 10.0), st.floats(1e-3, 50.0), st.floats(1.0, 10.0))
def test_nearness_falls_with_uncertainty_and_is_repeatable(
    position: float, rotation: float, factor: float
) -> None:
    covariance = covariance_of(position, rotation)
    assert nearness(factor * covariance) <= nearness(covariance) == nearness(covariance)
