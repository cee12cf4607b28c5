# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Both measures come out as the error that each frame makes for itself."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from gam_relocalizer.augmentation.jitter import Spread, jitter_of, residuals, shake
from gam_relocalizer.augmentation.tracking import Track, TrackedFrame, Way
from gam_relocalizer.cameras import parse_camera
from gam_relocalizer.geometry import rigid3d_from_rotation
from gam_relocalizer.localization.result import Status

if TYPE_CHECKING:
    from numpy.typing import NDArray

FRAMES, ENDS = 400, 6
CAMERA = parse_camera('PINHOLE 640 480 500 500 320 240')


def times(rate: float) -> NDArray[np.float64]:
    return np.arange(FRAMES) / rate


def noise(sigma: float) -> NDArray[np.float64]:
    return sigma * np.random.default_rng(0).standard_normal((FRAMES, ENDS, 2))


def smooth(seconds: NDArray[np.float64]) -> NDArray[np.float64]:
    """A gentle motion of hundreds of pixels."""
    phase = 0.5 * seconds[:, None] + np.arange(ENDS)
    return np.stack([150 * np.sin(phase), 80 * np.cos(0.7 * phase)], axis=-1)


def rms(values: NDArray[np.float64]) -> float:
    spread = Spread.of(values)
    assert spread is not None
    return spread.rms


@pytest.mark.parametrize('rate', [5.0, 10.0, 30.0])
@pytest.mark.parametrize('sigma', [0.3, 4.0])
def test_independent_errors_come_out_as_their_own_size(rate: float, sigma: float) -> None:
    seconds, errors = times(rate), noise(sigma)
    size = sigma * np.sqrt(2.0)
    assert rms(shake(errors, seconds, 1.0 / rate)) == pytest.approx(size, rel=0.05)
    found = rms(residuals(smooth(seconds) + errors, seconds, 1.0 / rate))
    assert found == pytest.approx(size, rel=0.1)


def test_what_all_frames_have_in_common_is_no_shake() -> None:
    seconds = times(10.0)
    offset = np.full((FRAMES, ENDS, 2), 25.0)
    drift = offset + seconds[:, None, None]
    assert rms(shake(offset, seconds, 0.1)) == pytest.approx(0.0, abs=1e-12)
    assert rms(shake(drift, seconds, 0.1)) < 0.11
    assert rms(residuals(smooth(seconds) + drift, seconds, 0.1)) < 0.05


def test_residual_takes_a_jerk_of_the_camera_for_shake_and_the_truth_does_not() -> None:
    seconds, errors = times(10.0), noise(0.2)
    track = smooth(seconds)
    track[200:] += 60.0
    assert rms(residuals(track + errors, seconds, 0.1)) > 5 * rms(shake(errors, seconds, 0.1))


def test_frames_that_do_not_follow_each_other_are_not_compared() -> None:
    seconds = np.array([0.0, 0.1, 0.5, 0.6])
    errors = np.zeros((4, 1, 2))
    errors[2:] = 10.0
    errors[3] = np.nan
    found = shake(errors, seconds, 0.1)
    assert np.isfinite(found).ravel().tolist() == [True, False, False]
    assert found[0, 0] == 0.0


def test_residual_is_not_told_at_the_ends_of_a_track_nor_around_few_frames() -> None:
    seconds = np.arange(12) / 10.0
    pixels = np.zeros((12, 1, 2))
    known = np.isfinite(residuals(pixels, seconds, 0.1)).ravel()
    assert known.tolist() == [False, False, *[True] * 8, False, False]
    pixels[5] = np.nan
    assert not np.isfinite(residuals(pixels, seconds, 0.1)[[5]]).any()
    pixels[[3, 4, 6]] = np.nan
    assert not np.isfinite(residuals(pixels[:8], seconds[:8], 0.1)).any()


def test_nothing_seen_is_nothing_told() -> None:
    assert Spread.of(np.full((3, 2), np.nan)) is None


def frame_at(index: int, turned: float, *, lost: bool = False) -> TrackedFrame:
    truth = rigid3d_from_rotation(Rotation.from_euler('y', 0.002 * index), [0.0, 0.0, 0.0])
    wrong = rigid3d_from_rotation(Rotation.from_euler('x', turned), np.zeros(3)) * truth
    pose = None if lost else wrong
    status = Status.NO_POSE if lost else Status.ACCEPTED
    return TrackedFrame(index * 10**8, status, CAMERA, by_itself=pose, truth=truth)


def test_track_is_measured_where_ends_are_in_the_image() -> None:
    ends = np.array([[0.0, 0.0, 4.0], [0.3, 0.1, 4.0], [0.0, 0.0, -4.0], [90.0, 0.0, 4.0]])
    frames = tuple(frame_at(index, 0.002, lost=index == 7) for index in range(20))
    jitter = jitter_of(Track(frames, (Way.FRAME_BY_FRAME,)), Way.FRAME_BY_FRAME, ends)
    assert (jitter.frames, jitter.frames_with_pose, jitter.ends) == (20, 19, 38)
    assert jitter.offset is not None
    assert jitter.offset.median == pytest.approx(1.0, abs=0.05)
    assert jitter.shake is not None
    # two ends, in all pairs of neighbours but the two with the lost frame
    assert jitter.shake.count == 34
    assert jitter.shake.rms < 0.01


def test_without_the_truth_only_the_residual_is_told() -> None:
    frames = tuple(
        TrackedFrame(index * 10**8, Status.ACCEPTED, CAMERA, by_itself=pycolmap.Rigid3d())
        for index in range(10)
    )
    jitter = jitter_of(
        Track(frames, (Way.FRAME_BY_FRAME,)), Way.FRAME_BY_FRAME, np.array([[0.0, 0.0, 4.0]])
    )
    assert jitter.shake is jitter.offset is None
    assert jitter.residual is not None
    assert jitter.residual.rms < 1e-9
