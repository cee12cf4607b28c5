# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gam_relocalizer.alignment.scale import fit_scale
from gam_relocalizer.errors import AlignmentError


@given(scale=st.floats(1e-3, 1e3), count=st.integers(1, 8))
def test_exact_lengths_give_the_exact_scale(scale: float, count: int) -> None:
    lengths = np.linspace(0.5, 4.0, count)

    fit = fit_scale(lengths, scale * lengths)

    assert fit.scale == pytest.approx(scale, rel=1e-12)
    assert fit.inliers.all()


@pytest.mark.parametrize('count', [3, 5, 12])
@pytest.mark.parametrize('growing', [True, False])
def test_the_true_scale_is_within_three_standard_deviations(count: int, *, growing: bool) -> None:
    rng = np.random.default_rng(0)
    hits, sigmas, errors = 0, [], []
    for _ in range(400):
        lengths = rng.uniform(0.5, 4.0, count)
        noise = rng.normal(0.0, 0.01, count)
        fit = fit_scale(lengths, 2.0 * lengths + noise * (lengths if growing else 1.0))
        assert fit.sigma is not None
        hits += abs(fit.scale / 2.0 - 1.0) < 3.0 * fit.sigma
        sigmas.append(fit.sigma)
        errors.append(fit.scale / 2.0 - 1.0)

    assert hits >= 0.95 * 400
    assert np.median(sigmas) < 3.0 * np.std(errors)


def test_a_third_of_mistakes_does_not_change_the_scale() -> None:
    rng = np.random.default_rng(1)
    lengths = rng.uniform(0.5, 4.0, 30)
    metres = 2.0 * lengths + rng.normal(0.0, 0.01, 30)
    metres[:10] *= rng.uniform(1.2, 3.0, 10)

    fit = fit_scale(lengths, metres)

    assert fit.scale == pytest.approx(2.0, rel=0.005)
    assert not fit.inliers[:10].any()


def test_the_odd_one_of_three_is_left_out() -> None:
    fit = fit_scale(np.array([1.0, 2.0, 3.0]), np.array([2.001, 3.998, 9.0]))

    assert fit.inliers.tolist() == [True, True, False]


def test_a_single_length_says_nothing_of_its_error() -> None:
    assert fit_scale(np.array([1.0]), np.array([2.0])).sigma is None


def test_a_length_of_nothing_is_refused() -> None:
    with pytest.raises(AlignmentError):
        fit_scale(np.array([1.0, 0.0]), np.array([2.0, 1.0]))
