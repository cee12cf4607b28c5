# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Median errors and recall."""

from __future__ import annotations

import math

import pytest

from gam_relocalizer.evaluation.metrics import Threshold, accuracy
from gam_relocalizer.geometry import PoseError

FINE, COARSE = Threshold(0.05, 5.0), Threshold(0.5, 10.0)
ERRORS = [PoseError(0.01, 1.0), PoseError(0.05, 5.0), PoseError(0.04, 9.0), PoseError(3.0, 0.1)]


def test_refused_queries_lower_recall_but_not_medians() -> None:
    found = accuracy(ERRORS, queries=8, thresholds=(FINE, COARSE))
    assert (found.queries, found.localized) == (8, 4)
    assert found.median_position == pytest.approx(0.045)
    assert found.median_rotation_deg == pytest.approx(3.0)
    assert found.recall == {FINE: 2 / 8, COARSE: 3 / 8}


def test_nothing_localized_is_recall_zero_and_no_median() -> None:
    found = accuracy([], queries=3, thresholds=(FINE,))
    assert found.recall == {FINE: 0.0}
    assert math.isnan(found.median_position)


def test_no_queries_have_no_recall() -> None:
    assert math.isnan(accuracy([], queries=0, thresholds=(FINE,)).recall[FINE])
