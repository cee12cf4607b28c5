# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from gam_relocalizer.cameras import parse_camera
from gam_relocalizer.mapping.intrinsics import ImageCameras
from gam_relocalizer.mapping.report import calibration_warnings

if TYPE_CHECKING:
    import pycolmap


def radial(focal: float, k: float = 0.0) -> pycolmap.Camera:
    return parse_camera(f'SIMPLE_RADIAL 640 480 {focal} 320 240 {k}')


FISHEYE = parse_camera('OPENCV_FISHEYE 800 480 200 200 400 240 0 0 0 0')


def warnings_of(
    start: pycolmap.Camera, refined: pycolmap.Camera, *, given: bool
) -> tuple[str, ...]:
    cameras = ImageCameras((start,), (0,), frozenset({1} if given else ()))
    return calibration_warnings(cameras, {1: refined})


@pytest.mark.parametrize('focal', [547.0 * 1.35, 547.0 / 1.35, 1249.0])
def test_a_given_focal_length_that_was_refined_far_is_warned_of(focal: float) -> None:
    (warning,) = warnings_of(radial(547.0), radial(focal), given=True)
    assert f'{focal:.0f} px' in warning


@pytest.mark.parametrize('focal', [547.0 * 1.25, 547.0 / 1.25])
def test_a_given_focal_length_may_be_refined_a_little(focal: float) -> None:
    assert warnings_of(radial(547.0), radial(focal), given=True) == ()


@pytest.mark.parametrize('focal', [200.0, 2460.0])
def test_a_guessed_camera_that_came_out_like_no_usual_lens_is_warned_of(focal: float) -> None:
    (warning,) = warnings_of(radial(768.0), radial(focal), given=False)
    assert f'{focal:.0f} px' in warning


@pytest.mark.parametrize('focal', [300.0, 525.0, 1800.0])
def test_a_guessed_camera_may_come_out_like_any_usual_lens(focal: float) -> None:
    assert warnings_of(radial(768.0), radial(focal), given=False) == ()


@pytest.mark.parametrize('given', [True, False])
def test_distortion_that_folds_the_image_is_warned_of(given: bool) -> None:  # noqa: FBT001
    (warning,) = warnings_of(radial(525.0), radial(525.0, -0.8), given=given)
    assert 'folds' in warning


def test_distortion_of_a_real_lens_is_not_warned_of() -> None:
    assert warnings_of(radial(525.0), radial(525.0, -0.15), given=False) == ()


def test_a_fisheye_that_was_kept_is_not_warned_of_for_its_black_corners() -> None:
    assert warnings_of(FISHEYE, FISHEYE, given=True) == ()


def test_a_warning_fits_a_line_of_a_check() -> None:
    warnings = warnings_of(radial(768.0), radial(24_600.0), given=False)
    assert all(len(warning) < 200 for warning in warnings)
