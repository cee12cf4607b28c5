# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from gam_relocalizer.datasets.trajectory import Trajectory
from gam_relocalizer.errors import DatasetError

MS = 1_000_000


def along_x(*stamps_ms: int) -> Trajectory:
    """At a millisecond t it is at x = t."""
    samples = {
        stamp * MS: pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([float(stamp), 0.0, 0.0]))
        for stamp in stamps_ms
    }
    return Trajectory.of_samples(samples, Path('truth.txt'))


def test_between_near_samples_it_is_interpolated() -> None:
    found = along_x(100, 0, 50).at(30 * MS)

    assert found is not None
    assert np.allclose(found.translation, [30.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ('at_ms', 'nearest_ms'),
    [(-20, 0), (-21, None), (520, 500), (521, None), (15, 0), (100, None), (490, 500)],
)
def test_elsewhere_a_sample_nearby_counts(at_ms: int, nearest_ms: int | None) -> None:
    found = along_x(0, 500).at(at_ms * MS)

    assert (None if found is None else found.translation[0]) == nearest_ms


def test_no_samples_are_an_error() -> None:
    with pytest.raises(DatasetError, match=r'truth\.txt'):
        Trajectory.of_samples({}, Path('truth.txt'))
