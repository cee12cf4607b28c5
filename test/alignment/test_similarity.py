# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gam_relocalizer.alignment.similarity import (
    Fit,
    fit_similarity,
    fit_upright,
    fit_with_rotations,
    solve_similarity,
)
from gam_relocalizer.errors import AlignmentError

if TYPE_CHECKING:
    from collections.abc import Callable

SCALE = 1.7
ROTATION = Rotation.from_euler('xyz', [0.4, -0.8, 2.2])
SHIFT = np.array([30.0, -7.0, 2.0])


def similarity(scale: float, rotation: Rotation, shift: np.ndarray) -> pycolmap.Sim3d:
    return pycolmap.Sim3d(scale, pycolmap.Rotation3d(rotation.as_quat()), shift)


TRUTH = similarity(SCALE, ROTATION, SHIFT)
UPRIGHT = similarity(SCALE, Rotation.from_euler('z', 2.2), SHIFT)


def rotation_error(estimate: pycolmap.Sim3d, truth: pycolmap.Sim3d = TRUTH) -> float:
    one, other = (Rotation.from_quat(np.asarray(sim.rotation.quat)) for sim in (estimate, truth))
    return float(np.degrees((one * other.inv()).magnitude()))


def room_of_places(count: int, rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(-1.0, 1.0, (count, 3)) * [4.0, 3.0, 0.5]


def noisy_rotations(count: int, rng: np.random.Generator, sigma: float = 0.01) -> Rotation:
    return Rotation.from_rotvec(rng.normal(0.0, sigma, (count, 3))) * ROTATION


def fit_by(kind: str, source: np.ndarray, target: np.ndarray, rng: np.random.Generator) -> Fit:
    if kind == 'poses':
        return fit_with_rotations(source, target, noisy_rotations(len(source), rng))
    return (fit_upright if kind == 'upright' else fit_similarity)(source, target)


@settings(max_examples=50, deadline=None)
@given(
    scale=st.floats(0.01, 100.0),
    turn=st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3),
    flat=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_any_similarity_is_found_also_from_places_in_a_coordinate_plane(
    scale: float, turn: list[float], seed: int, *, flat: bool
) -> None:
    source = np.random.default_rng(seed).normal(size=(4, 3)) * [1.0, 1.0, 0.0 if flat else 1.0]
    truth = similarity(scale, Rotation.from_rotvec(turn), SHIFT)

    found = solve_similarity(source, np.asarray(truth * source))

    assert found is not None
    assert found.scale == pytest.approx(scale, rel=1e-9)
    assert rotation_error(found, truth) < 1e-5
    assert np.allclose(found * source, truth * source, atol=1e-8 * scale)


def test_a_third_of_gross_errors_does_not_change_the_similarity() -> None:
    rng = np.random.default_rng(2)
    source = room_of_places(40, rng)
    target = np.asarray(TRUTH * source) + rng.normal(0.0, 0.02, source.shape)
    spoilt = target.copy()
    spoilt[:13] += rng.uniform(-8.0, 8.0, (13, 3))

    clean, robust = fit_similarity(source[13:], target[13:]), fit_similarity(source, spoilt)

    assert not robust.inliers[:13].any()
    assert robust.target_from_source.scale == pytest.approx(SCALE, rel=0.01)
    assert rotation_error(robust.target_from_source, clean.target_from_source) < 0.05
    shifted = robust.target_from_source * source[13:] - clean.target_from_source * source[13:]
    assert np.abs(shifted).max() < 0.005


def test_a_third_of_gross_errors_does_not_change_the_upright_similarity() -> None:
    rng = np.random.default_rng(3)
    source = room_of_places(40, rng)
    target = np.asarray(UPRIGHT * source) + rng.normal(0.0, 0.02, source.shape)
    target[:13] += rng.uniform(-8.0, 8.0, (13, 3))

    fit = fit_upright(source, target)

    assert np.abs(fit.target_from_source * source - UPRIGHT * source).max() < 0.04


def test_a_third_of_gross_errors_does_not_change_what_poses_say() -> None:
    rng = np.random.default_rng(4)
    source = room_of_places(40, rng)
    target = np.asarray(TRUTH * source) + rng.normal(0.0, 0.02, source.shape)
    rotations = noisy_rotations(40, rng)
    target[:13] += rng.uniform(-8.0, 8.0, (13, 3))
    wrong = Rotation.from_rotvec(rng.uniform(-3.0, 3.0, (13, 3)))
    rotations = Rotation.concatenate([wrong, rotations[13:]])

    fit = fit_with_rotations(source, target, rotations)

    assert not fit.inliers[:13].any()
    assert rotation_error(fit.target_from_source) < 0.5
    assert np.abs(fit.target_from_source * source - TRUTH * source).max() < 0.04


@pytest.mark.parametrize('kind', ['places', 'upright', 'poses'])
def test_the_true_scale_is_within_three_standard_deviations(kind: str) -> None:
    rng = np.random.default_rng(5)
    trials, count = 120, 7
    truth = UPRIGHT if kind == 'upright' else TRUTH

    def fitted() -> tuple[float, float]:
        source = room_of_places(count, rng)
        target = np.asarray(truth * source) + rng.normal(0.0, 0.03, source.shape)
        fit = fit_by(kind, source, target, rng)
        return float(fit.target_from_source.scale) / SCALE - 1.0, fit.scale_sigma

    errors, sigmas = np.array([fitted() for _ in range(trials)]).T

    assert np.mean(np.abs(errors) < 3.0 * sigmas) >= 0.95
    # and they say something: a tenth would do for anything
    assert np.median(sigmas) < 3.0 * np.std(errors)


def test_errors_that_drift_make_the_scale_less_certain() -> None:
    rng = np.random.default_rng(6)
    source = room_of_places(100, rng)[np.argsort(rng.normal(size=100))]
    source = np.sort(source, axis=0)
    steps = rng.normal(0.0, 0.02, (100, 3))
    drift = np.zeros_like(steps)
    for row in range(1, 100):
        drift[row] = 0.9 * drift[row - 1] + steps[row]
    shuffled = rng.permutation(drift)

    drifting = fit_with_rotations(source, TRUTH * source + drift, noisy_rotations(100, rng))
    independent = fit_with_rotations(source, TRUTH * source + shuffled, noisy_rotations(100, rng))

    assert drifting.scale_sigma > 2.0 * independent.scale_sigma


def test_rotations_tell_the_roll_about_a_line_of_places() -> None:
    rng = np.random.default_rng(7)
    source = np.outer(np.linspace(-3.0, 3.0, 30), [1.0, 0.2, 0.1])
    target = np.asarray(TRUTH * source) + rng.normal(0.0, 0.01, source.shape)

    fit = fit_with_rotations(source, target, noisy_rotations(30, rng))

    assert rotation_error(fit.target_from_source) < 0.5
    assert fit.target_from_source.scale == pytest.approx(SCALE, rel=0.005)
    assert 0.02 < fit.rotation_sigma_deg < 0.3


def test_places_know_the_rotation_better_than_poor_rotations() -> None:
    rng = np.random.default_rng(8)
    source = room_of_places(40, rng)
    target = np.asarray(TRUTH * source) + rng.normal(0.0, 0.001, source.shape)

    fit = fit_with_rotations(source, target, noisy_rotations(40, rng, sigma=0.08))

    assert rotation_error(fit.target_from_source) < 0.05


def on_a_line(rng: np.random.Generator) -> np.ndarray:
    return np.outer(np.linspace(0.0, 5.0, 12), [1.0, 0.5, 0.0]) + rng.normal(0.0, 1e-3, (12, 3))


def at_one_place(_: np.random.Generator) -> np.ndarray:
    return np.tile([1.0, 2.0, 3.0], (12, 1))


def two(rng: np.random.Generator) -> np.ndarray:
    return rng.normal(size=(2, 3))


@pytest.mark.parametrize('places', [on_a_line, at_one_place, two])
def test_places_that_do_not_determine_a_similarity_are_refused(
    places: Callable[[np.random.Generator], np.ndarray],
) -> None:
    rng = np.random.default_rng(9)
    source = places(rng)
    target = np.asarray(TRUTH * source) + rng.normal(0.0, 0.01, source.shape)

    with pytest.raises(AlignmentError):
        fit_similarity(source, target)


def test_places_given_as_all_the_same_are_refused() -> None:
    source = room_of_places(12, np.random.default_rng(10))

    with pytest.raises(AlignmentError, match='same'):
        fit_similarity(source, np.tile(SHIFT, (12, 1)))


@pytest.mark.parametrize('kind', ['places', 'upright', 'poses'])
def test_mirrored_places_are_refused_by_that_name(kind: str) -> None:
    rng = np.random.default_rng(11)
    source = room_of_places(30, rng)
    truth = UPRIGHT if kind == 'upright' else TRUTH
    target = np.asarray(truth * source) + rng.normal(0.0, 0.01, source.shape)
    mirrored = target * [1.0, -1.0, 1.0]

    with pytest.raises(AlignmentError, match='mirrored'):
        fit_by(kind, source, mirrored, rng)


@pytest.mark.parametrize('kind', ['places', 'upright', 'poses'])
@pytest.mark.parametrize('size', [1e100, 1e308])
def test_places_beyond_all_measure_are_refused(kind: str, size: float) -> None:
    rng = np.random.default_rng(16)
    source = room_of_places(5, rng)
    target = source.copy()
    target[:2, 0] = [size, -size]

    with pytest.raises(AlignmentError, match='from the origin'):
        fit_by(kind, source, target, rng)


def test_exact_places_in_a_plane_are_not_taken_for_mirrored_ones() -> None:
    source = room_of_places(20, np.random.default_rng(15)) * [1.0, 1.0, 0.0]

    fit = fit_similarity(source, np.asarray(TRUTH * source))

    assert fit.target_from_source.scale == pytest.approx(SCALE, rel=1e-9)


@pytest.mark.parametrize('kind', ['places', 'upright', 'poses'])
def test_places_of_something_else_are_refused(kind: str) -> None:
    rng = np.random.default_rng(12)
    source, target = room_of_places(30, rng), room_of_places(30, rng)

    with pytest.raises(AlignmentError):
        fit_by(kind, source, target, rng)


def test_rotations_of_another_frame_are_refused() -> None:
    rng = np.random.default_rng(13)
    source = room_of_places(30, rng)
    target = np.asarray(TRUTH * source)
    turned = noisy_rotations(30, rng) * Rotation.from_euler('z', 90, degrees=True)

    with pytest.raises(AlignmentError, match='orientations'):
        fit_with_rotations(source, target, turned)


def test_the_same_input_gives_the_same_fit() -> None:
    rng = np.random.default_rng(14)
    source = room_of_places(60, rng)
    target = np.asarray(TRUTH * source) + rng.normal(0.0, 0.05, source.shape)
    target[:10] += rng.uniform(-5.0, 5.0, (10, 3))

    fits = [fit_similarity(source, target).target_from_source.params for _ in range(2)]

    assert (fits[0] == fits[1]).all()
