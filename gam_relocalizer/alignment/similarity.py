# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Robust similarities between two sets of places, and how certain they are.

How large the errors of ordinary measurements are, nobody knows beforehand: millimetres of a total
station, metres of GPS. So the consensus is the least median of squares (Rousseeuw 1984), which
needs no threshold and bears nearly half of gross errors; what is an error and what a measurement
follows from the spread around it.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation
from scipy.stats import chi, norm, t

from gam_relocalizer.errors import AlignmentError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    Solver: TypeAlias = Callable[[NDArray[np.float64], NDArray[np.float64]], pycolmap.Sim3d | None]

MIN_PLACES = 3
# Median residuals beyond this share of the extent are no fit; places taken at random leave more.
_MAX_RESIDUAL_SHARE = 0.4
_TRIALS = 500
_SEED = 0
_MAX_ROUNDS = 20
# Beyond so many standard deviations along each axis an error is gross: one in a hundred is not.
_GROSS = 3.4
# Maps bend: errors under this share of the extent, or angle, are never gross.
_NEVER_GROSS = 0.005
_LEAST_ANGLE = math.radians(0.2)
# In place of the errors of exact input, which nothing can be divided by.
_TINY = 1e-9
# Further off, squares of squares of places leave the range of numbers; no place is.
_FARTHEST = 1e12
# Places this close to a line, seen from its length, leave the rotation about it open.
_LINE = 1e-4
_MAX_ROTATION_SIGMA_DEG = 3.0
# Orientations that differ so much from each other are no measurements of one rotation.
_MAX_DISAGREEMENT_DEG = 10.0
_MAX_CANDIDATES = 200
# Errors of how many places tell whether neighbours err alike, and how much alike at most.
_MIN_FOR_KINSHIP = 10
_MAX_LIKENESS = 0.95
# A mirrored fit is the true one when it leaves so much less, and there is enough to tell.
_MIRRORED_GAIN = 5.0
_MIRRORED_PLACES = 6
_MIRRORED_QUANTILE = 0.6


@dataclass(frozen=True)
class Fit:
    """A similarity and how well it fits.

    Attributes:
        target_from_source: The similarity.
        residuals: [n] distances in the target frame; horizontal ones when fitted upright.
        degrees: [n] angles between the orientations; None where there were none.
        inliers: [n] what was used.
        scale_sigma: Standard deviation of the scale, as a share of it.
        rotation_sigma_deg: Standard deviation of the rotation about its worst axis.
    """

    target_from_source: pycolmap.Sim3d
    residuals: NDArray[np.float64]
    degrees: NDArray[np.float64] | None
    inliers: NDArray[np.bool_]
    scale_sigma: float
    rotation_sigma_deg: float


def fit_similarity(source: NDArray[np.float64], target: NDArray[np.float64]) -> Fit:
    """All seven parameters from places [n,3] alone.

    Raises:
        AlignmentError: The places are too few, all the same, on a line, or mirrored.
    """
    _check_spread(source, target)
    if _on_a_line(source) or _on_a_line(target):
        raise _line_error()
    first = _consensus(source, target, solve_similarity, sample=3, axes=3)
    _check_handedness(first, source, target)
    sim3d, inliers = _settled(first, source, target, solve_similarity, axes=3)
    residuals = _distances(sim3d, source, target)
    arms = _arms(sim3d, source[inliers])
    freedom = 3 * int(inliers.sum()) - 7
    noise = _noise(residuals[inliers], freedom)
    errors = _errors(sim3d, source, target)[inliers]
    fit = Fit(
        target_from_source=sim3d,
        residuals=residuals,
        degrees=None,
        inliers=inliers,
        scale_sigma=_scale_sigma(errors, arms, freedom),
        rotation_sigma_deg=_kinship(errors)
        * _worst_sigma_deg(_information(arms) / max(noise, _TINY) ** 2),
    )
    _check_residuals(residuals, target)
    if fit.rotation_sigma_deg > _MAX_ROTATION_SIGMA_DEG:
        raise _line_error()
    return fit


def fit_upright(source: NDArray[np.float64], target: NDArray[np.float64]) -> Fit:
    """Scale, heading and shift of places [n,3] whose z axis points up in both frames.

    The horizontal places decide; heights give the shift along z alone, by their median.

    Raises:
        AlignmentError: The places are too few, all the same, or mirrored.
    """
    flat = np.array([1.0, 1.0, 0.0])
    _check_spread(source * flat, target * flat)
    first = _consensus(source, target, _solve_upright, sample=2, axes=2)
    if not (_on_a_line(source * flat) or _on_a_line(target * flat)):
        turned_over = source * [1.0, -1.0, 1.0]
        mirrored = _consensus(turned_over, target, _solve_upright, sample=2, axes=2)
        _compare_handedness(
            _distances(first, source, target, axes=2),
            _distances(mirrored, turned_over, target, axes=2),
            _never_gross(target),
        )
    sim3d, inliers = _settled(first, source, target, _solve_upright, axes=2)
    residuals = _distances(sim3d, source, target, axes=2)
    _check_residuals(residuals, target * flat)
    freedom = 2 * int(inliers.sum()) - 4
    errors = _errors(sim3d, source, target, axes=2)[inliers]
    sigma = _scale_sigma(errors, _arms(sim3d, source[inliers])[:, :2], freedom)
    # in the plane, a share of the length across it is an angle
    return Fit(sim3d, residuals, None, inliers, sigma, math.degrees(sigma))


def fit_with_rotations(
    source: NDArray[np.float64], target: NDArray[np.float64], rotations: Rotation
) -> Fit:
    """All seven parameters from places [n,3] and, for each, a rotation target_from_source.

    Both count by how well they agree: along a line of places, the rotation about it comes from the
    rotations; across a large place, the places know better.

    Raises:
        AlignmentError: The places are too few, all the same or mirrored, or the rotations
            contradict each other or the places.
    """
    _check_spread(source, target)
    if not (_on_a_line(source) or _on_a_line(target)):
        free = _consensus(source, target, solve_similarity, sample=3, axes=3)
        _check_handedness(free, source, target)
    common = _common_rotation(rotations)
    sim3d = _consensus(source, target, _solver_with(common), sample=2, axes=3)
    inliers = _near(sim3d, source, target, rotations)
    for _ in range(_MAX_ROUNDS):
        before = inliers
        sim3d, information = _refined(sim3d, source, target, rotations, inliers)
        inliers = _near(sim3d, source, target, rotations)
        if (inliers == before).all():
            break
    residuals = _distances(sim3d, source, target)
    _check_agreement(sim3d, common, residuals, target)
    freedom = 3 * int(inliers.sum()) - 4
    errors = _errors(sim3d, source, target)[inliers]
    arms = _arms(sim3d, source[inliers])
    return Fit(
        target_from_source=sim3d,
        residuals=residuals,
        degrees=np.degrees(_angles(sim3d, rotations)),
        inliers=inliers,
        scale_sigma=_scale_sigma(errors, arms, freedom),
        rotation_sigma_deg=_kinship(errors) * _worst_sigma_deg(information),
    )


def solve_similarity(
    source: NDArray[np.float64], target: NDArray[np.float64]
) -> pycolmap.Sim3d | None:
    """Least squares target_from_source of places [n,3] (Umeyama 1991); None if all are the same.

    COLMAP's own refuses places in one coordinate plane, as those of a robot on a floor are.
    """
    centre, middle = source.mean(axis=0), target.mean(axis=0)
    spokes, wanted = source - centre, target - middle
    size = float((spokes**2).sum())
    if size <= 0.0:
        return None
    left, lengths, right = np.linalg.svd(wanted.T @ spokes)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    rotation = Rotation.from_matrix((left * signs) @ right)
    scale = float((lengths * signs).sum()) / size
    if scale <= 0.0:
        return None
    return _sim3d(
        scale, rotation, target.mean(axis=0) - scale * rotation.apply(source.mean(axis=0))
    )


def widened(sigma: float, freedom: int) -> float:
    """A standard deviation from few measurements, such that twice it still holds 95 % (Student)."""
    if freedom < 1:
        return math.inf
    return sigma * float(t.ppf(0.975, freedom) / norm.ppf(0.975))


def _scale_sigma(errors: NDArray[np.float64], arms: NDArray[np.float64], freedom: int) -> float:
    """Of the scale that errors [n,a] at the ends of arms [n,a] leave, as a share of it."""
    noise = _noise(np.linalg.norm(errors, axis=1), freedom)
    return _kinship(errors) * widened(noise / float(np.linalg.norm(arms)), freedom)


def _kinship(errors: NDArray[np.float64]) -> float:
    """How much more uncertain a result is since errors [n,a] resemble the ones before them.

    Drift makes neighbours in a video err alike, so that a hundred of them tell what a few
    independent ones do: an autoregressive process of first order.
    """
    size = float((errors**2).sum())
    if len(errors) < _MIN_FOR_KINSHIP or size <= 0.0:
        return 1.0
    likeness = float(np.clip((errors[1:] * errors[:-1]).sum() / size, 0.0, _MAX_LIKENESS))
    return math.sqrt((1.0 + likeness) / (1.0 - likeness))


def _extent(places: NDArray[np.float64]) -> float:
    """Median distance of places [n,3] from their median: what residuals are compared with."""
    return float(np.median(np.linalg.norm(places - np.median(places, axis=0), axis=1)))


def _consensus(
    source: NDArray[np.float64],
    target: NDArray[np.float64],
    solve: Solver,
    *,
    sample: int,
    axes: int,
) -> pycolmap.Sim3d:
    """The solution from a few places that leaves the least error at more than half of all."""
    quorum = min(len(source), (len(source) + sample + 1) // 2)
    best, least = None, math.inf
    for rows in _samples(len(source), sample):
        sim3d = solve(source[rows], target[rows])
        if sim3d is None or not np.isfinite(sim3d.params).all() or sim3d.scale <= 0.0:
            continue
        error = np.partition(_distances(sim3d, source, target, axes), quorum - 1)[quorum - 1]
        if error < least:
            best, least = sim3d, float(error)
    if best is None:
        raise _disagreement_error()
    return best


def _samples(count: int, size: int) -> Iterator[list[int]]:
    if math.comb(count, size) <= _TRIALS:
        yield from (list(rows) for rows in itertools.combinations(range(count), size))
        return
    rng = np.random.default_rng(_SEED)
    for _ in range(_TRIALS):
        yield rng.choice(count, size, replace=False).tolist()


def _settled(
    sim3d: pycolmap.Sim3d,
    source: NDArray[np.float64],
    target: NDArray[np.float64],
    solve: Solver,
    axes: int,
) -> tuple[pycolmap.Sim3d, NDArray[np.bool_]]:
    """Least squares over all that is no gross error, until that changes no more."""
    inliers = _inliers(_distances(sim3d, source, target, axes), axes, _never_gross(target))
    for _ in range(_MAX_ROUNDS):
        before = inliers
        better = solve(source[inliers], target[inliers])
        if better is None or better.scale <= 0.0:
            raise _disagreement_error()
        sim3d = better
        inliers = _inliers(_distances(sim3d, source, target, axes), axes, _never_gross(target))
        if (inliers == before).all():
            break
    return sim3d, inliers


def _inliers(errors: NDArray[np.float64], axes: int, least: float) -> NDArray[np.bool_]:
    """Which errors [n] are as likely as the smaller half of them says."""
    noise = float(np.median(errors)) / float(chi.ppf(0.5, axes))
    # a median of few residuals of a fit to them is too small (Rousseeuw and Leroy 1987)
    noise *= 1.0 + 5.0 / max(1, len(errors) - MIN_PLACES)
    result: NDArray[np.bool_] = errors <= max(_GROSS * noise, least)
    return result


def _never_gross(target: NDArray[np.float64]) -> float:
    return _NEVER_GROSS * _extent(target)


def _near(
    sim3d: pycolmap.Sim3d,
    source: NDArray[np.float64],
    target: NDArray[np.float64],
    rotations: Rotation,
) -> NDArray[np.bool_]:
    near = _inliers(_distances(sim3d, source, target), 3, _never_gross(target))
    return near & _inliers(_angles(sim3d, rotations), 3, _LEAST_ANGLE)


def _refined(
    sim3d: pycolmap.Sim3d,
    source: NDArray[np.float64],
    target: NDArray[np.float64],
    rotations: Rotation,
    inliers: NDArray[np.bool_],
) -> tuple[pycolmap.Sim3d, NDArray[np.float64]]:
    """Weighted least squares of places and rotations, and what it knows of the rotation [3,3].

    About the centre of the places, rotation, scale and shift do not depend on each other.
    """
    centre, middle = source[inliers].mean(axis=0), target[inliers].mean(axis=0)
    spokes, wanted = source[inliers] - centre, target[inliers] - middle
    for _ in range(_MAX_ROUNDS):
        turned = _rotation(sim3d).apply(spokes)
        scale = float((turned * wanted).sum() / (turned**2).sum())
        errors = wanted - scale * turned
        turns = (rotations[inliers] * _rotation(sim3d).inv()).as_rotvec()
        freedom = 3 * len(errors) - 4
        noise = max(_noise(np.linalg.norm(errors, axis=1), freedom), _TINY * _extent(target))
        noise_of_turns = max(_noise(np.linalg.norm(turns, axis=1), freedom), _TINY)
        arms = scale * turned
        information = _information(arms) / noise**2 + len(turns) / noise_of_turns**2 * np.eye(3)
        pull = np.cross(arms, errors).sum(axis=0) / noise**2 + turns.sum(axis=0) / noise_of_turns**2
        step = Rotation.from_rotvec(np.linalg.solve(information, pull))
        rotation = step * _rotation(sim3d)
        sim3d = _sim3d(scale, rotation, middle - scale * rotation.apply(centre))
        if step.magnitude() < _TINY:
            break
    if scale <= 0.0:
        raise _disagreement_error()
    return sim3d, information


def _common_rotation(rotations: Rotation) -> Rotation:
    """The mean of the rotations that agree with each other.

    Raises:
        AlignmentError: They do not agree.
    """
    every = max(1, len(rotations) // _MAX_CANDIDATES)
    candidates = [rotations[row] for row in range(0, len(rotations), every)]
    medians = [np.median((rotations * one.inv()).magnitude()) for one in candidates]
    best = candidates[int(np.argmin(medians))]
    near = _inliers((rotations * best.inv()).magnitude(), 3, _LEAST_ANGLE)
    common = rotations[near].mean()
    spread = math.degrees(float(np.median((rotations * common.inv()).magnitude())))
    if spread > _MAX_DISAGREEMENT_DEG:
        msg = (
            f'the orientations contradict the map: they differ by {spread:.0f} degrees in the '
            f'median from one common rotation; they have to be camera_from_world, of the camera '
            f'(x right, y down, z forward) and not of the robot. Align with the positions alone '
            f'(--positions) if its orientation is not known'
        )
        raise AlignmentError(msg)
    return common


def _check_spread(source: NDArray[np.float64], target: NDArray[np.float64]) -> None:
    if len(source) < MIN_PLACES:
        msg = (
            f'{len(source)} places are too few for an alignment, {MIN_PLACES} are needed at '
            f'least; with fewer, level the map (--level) and give a distance (--distances)'
        )
        raise AlignmentError(msg)
    if not (farthest := float(np.abs(target).max())) <= _FARTHEST:
        msg = f'a given place is {farthest:g} m from the origin; check the numbers and their unit'
        raise AlignmentError(msg)
    spread = np.linalg.svd(target - target.mean(axis=0), compute_uv=False)[0]
    own_spread = np.linalg.svd(source - source.mean(axis=0), compute_uv=False)[0]
    if spread <= _TINY * max(1.0, np.abs(target).max()):
        found = 'all given places are the same'
    elif own_spread <= _TINY * max(1.0, np.abs(source).max()):
        found = 'the images were all taken at one place'
    else:
        return
    msg = f'{found}: nothing tells the scale; give places of images that lie far apart'
    raise AlignmentError(msg)


def _on_a_line(places: NDArray[np.float64]) -> bool:
    spread = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    return bool(spread[1] <= _LINE * spread[0])


def _line_error() -> AlignmentError:
    msg = (
        'the places lie on a line, too close for their errors: nothing tells the rotation about '
        'it; give orientations as well (--poses), or add --level to take it from the cameras'
    )
    return AlignmentError(msg)


def _disagreement_error() -> AlignmentError:
    msg = (
        'the given places do not describe the places of these images: check that they belong to '
        'this map, and that names and places go together'
    )
    return AlignmentError(msg)


def _check_residuals(residuals: NDArray[np.float64], target: NDArray[np.float64]) -> None:
    if np.median(residuals) > _MAX_RESIDUAL_SHARE * _extent(target):
        raise _disagreement_error()


def _check_agreement(
    sim3d: pycolmap.Sim3d,
    common: Rotation,
    residuals: NDArray[np.float64],
    target: NDArray[np.float64],
) -> None:
    """Refuses orientations that agree with each other but not with the places."""
    turned = math.degrees(float((_rotation(sim3d) * common.inv()).magnitude()))
    off = float(np.median(residuals)) / _extent(target)
    if turned <= _MAX_DISAGREEMENT_DEG and off <= _MAX_RESIDUAL_SHARE:
        return
    msg = (
        'the orientations contradict the positions: turned the way the orientations say, the '
        f'images lie {100 * off:.0f} % of the extent off in the median. Poses have to be '
        'camera_from_world, of the camera (x right, y down, z forward) and not of the robot, in a '
        'right-handed world; with orientations that are not known align by --positions'
    )
    raise AlignmentError(msg)


def _check_handedness(
    fitted: pycolmap.Sim3d, source: NDArray[np.float64], target: NDArray[np.float64]
) -> None:
    turned_over = source * [1.0, 1.0, -1.0]
    mirrored = _consensus(turned_over, target, solve_similarity, sample=3, axes=3)
    _compare_handedness(
        _distances(fitted, source, target),
        _distances(mirrored, turned_over, target),
        _never_gross(target),
    )


def _compare_handedness(
    proper: NDArray[np.float64], mirrored: NDArray[np.float64], never_gross: float
) -> None:
    """Refuses places that fit far better when mirrored."""
    # what a few places that were fitted exactly leave is no evidence: look at the larger half
    left, left_mirrored = (np.quantile(one, _MIRRORED_QUANTILE) for one in (proper, mirrored))
    gain = left / max(left_mirrored, _TINY * never_gross, _TINY)
    if len(proper) >= _MIRRORED_PLACES and left > never_gross and gain > _MIRRORED_GAIN:
        msg = (
            f'the positions look mirrored: they fit {gain:.0f} times '
            f'better with one axis turned over. Give them in a right-handed frame (swap '
            f'two axes or negate one; rows of an image count downwards, y goes up), and '
            f'with z up (NED is x north, y east, z down: give y, x, -z)'
        )
        raise AlignmentError(msg)


def _solve_upright(
    source: NDArray[np.float64], target: NDArray[np.float64]
) -> pycolmap.Sim3d | None:
    """Least squares in the plane: multiplication of complex numbers."""
    own, wanted = (places[:, 0] + 1j * places[:, 1] for places in (source, target))
    spokes = own - own.mean()
    size = float((np.abs(spokes) ** 2).sum())
    if size <= 0.0:
        return None
    factor = complex((spokes.conj() * (wanted - wanted.mean())).sum() / size)
    if abs(factor) == 0.0:
        return None
    shift = complex(wanted.mean() - factor * own.mean())
    height = float(np.median(target[:, 2] - abs(factor) * source[:, 2]))
    heading = Rotation.from_euler('z', np.angle(factor))
    return _sim3d(abs(factor), heading, np.array([shift.real, shift.imag, height]))


def _solver_with(rotation: Rotation) -> Solver:
    """Least squares of scale and shift alone."""

    def solve(source: NDArray[np.float64], target: NDArray[np.float64]) -> pycolmap.Sim3d | None:
        turned = rotation.apply(source)
        spokes = turned - turned.mean(axis=0)
        size = float((spokes**2).sum())
        scale = float((spokes * (target - target.mean(axis=0))).sum()) / size if size else 0.0
        if scale <= 0.0:
            return None
        return _sim3d(scale, rotation, target.mean(axis=0) - scale * turned.mean(axis=0))

    return solve


def _distances(
    sim3d: pycolmap.Sim3d,
    source: NDArray[np.float64],
    target: NDArray[np.float64],
    axes: int = 3,
) -> NDArray[np.float64]:
    return np.asarray(np.linalg.norm(_errors(sim3d, source, target, axes), axis=1), np.float64)


def _errors(
    sim3d: pycolmap.Sim3d,
    source: NDArray[np.float64],
    target: NDArray[np.float64],
    axes: int = 3,
) -> NDArray[np.float64]:
    return np.asarray((np.asarray(sim3d * source) - target)[:, :axes], np.float64)


def _angles(sim3d: pycolmap.Sim3d, rotations: Rotation) -> NDArray[np.float64]:
    return np.asarray((rotations * _rotation(sim3d).inv()).magnitude(), np.float64)


def _noise(errors: NDArray[np.float64], freedom: int) -> float:
    """Standard deviation along one axis; freedom: numbers measured less parameters found."""
    return float(np.sqrt((errors**2).sum() / max(1, freedom)))


def _arms(sim3d: pycolmap.Sim3d, source: NDArray[np.float64]) -> NDArray[np.float64]:
    """[n,3] from the centre of the places to each, target frame."""
    target = np.asarray(sim3d * source, np.float64)
    arms: NDArray[np.float64] = target - target.mean(axis=0)
    return arms


def _information(arms: NDArray[np.float64]) -> NDArray[np.float64]:
    """[3,3] what places with unit errors at the ends of these arms know of a rotation."""
    matrix: NDArray[np.float64] = (arms**2).sum() * np.eye(3) - arms.T @ arms
    return matrix


def _worst_sigma_deg(information: NDArray[np.float64]) -> float:
    least = max(float(np.linalg.eigvalsh(information)[0]), _TINY)
    return math.degrees(1.0 / math.sqrt(least))


def _rotation(sim3d: pycolmap.Sim3d) -> Rotation:
    return Rotation.from_quat(np.asarray(sim3d.rotation.quat))


def _sim3d(scale: float, rotation: Rotation, translation: NDArray[np.float64]) -> pycolmap.Sim3d:
    return pycolmap.Sim3d(float(scale), pycolmap.Rotation3d(rotation.as_quat()), translation)
