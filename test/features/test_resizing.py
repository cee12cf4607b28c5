# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gam_relocalizer.features.resizing import to_working_size


def test_leaves_an_image_of_working_size_alone() -> None:
    image = np.zeros((480, 640), dtype=np.uint8)

    working, original_per_working = to_working_size(image, 1024, 32)

    assert working is image
    np.testing.assert_array_equal(original_per_working, [1.0, 1.0])


@given(width=st.integers(32, 700), height=st.integers(32, 700), max_side=st.integers(64, 512))
def test_far_corner_maps_to_far_corner(width: int, height: int, max_side: int) -> None:
    image = np.zeros((height, width), dtype=np.uint8)

    working, original_per_working = to_working_size(image, max_side, 32)

    assert max(working.shape) <= max_side
    assert all(side % 32 == 0 for side in working.shape)
    corner = np.array(working.shape[::-1]) * original_per_working
    np.testing.assert_allclose(corner, [width, height], rtol=1e-12)


def test_half_pixels_are_kept() -> None:
    columns = np.arange(256, dtype=np.uint8)
    ramp = np.tile(columns, (64, 1))

    working, original_per_working = to_working_size(ramp, 128)

    centres = np.arange(128) + 0.5
    brightness_there = centres * original_per_working[0] - 0.5
    np.testing.assert_allclose(working[10], brightness_there, atol=0.51)
