# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Where in a place its map works, and how well: what became of its images when left out."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from enum import Enum, unique
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from gam_relocalizer.localization.result import Status

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from gam_relocalizer.geometry import PoseError
    from gam_relocalizer.localization.result import LocalizationResult
    from gam_relocalizer.scene_map import SceneMap

# Fewer shared points do not make a neighbour, as they do not make a pose.
SHARED_POINTS = 20
# An image in the map without which hardly anything of its surroundings is left.
FEW_NEIGHBOURS = 3
FEW_INLIERS = 50

METRIC_TOLERANCE = 0.25
DEPTH_TOLERANCE = 0.05
ROTATION_TOLERANCE_DEG = 2.0

# Images that look this differently show other things, however near they are.
_SAME_DIRECTION_DEG = 45.0
# Images of one spot are as near to each other as images are elsewhere, but for a factor.
_REACH = 3.0


@unique
class Standing(str, Enum):
    """What became of a reference image that was left out.

    `FOUND`: accepted, at its pose. `WEAK`: that too, but few other images see what it sees, or few
    points were recognised. `REFUSED`: no pose was accepted. `WRONG`: one was, elsewhere.
    """

    FOUND = 'found'
    WEAK = 'found, but barely'
    REFUSED = 'not found'
    WRONG = 'found in a wrong place'


@dataclass(frozen=True)
class Tolerance:
    """How far a right pose may be from the one in the map.

    Attributes:
        position: [m], or map units.
        rotation_deg: [deg].
    """

    position: float
    rotation_deg: float = ROTATION_TOLERANCE_DEG


@dataclass(frozen=True)
class LeftOut:
    """A reference image that was localized in the map without it.

    Attributes:
        name: Of the image.
        standing: What that says about its surroundings.
        status: Name of the localizer's verdict.
        reason: The verdict in words.
        position: [3] where it was taken, map frame.
        direction: [3] unit vector, the way it looks.
        position_error: Of the best pose found, accepted or not; None without one [map units].
        rotation_error_deg: Of the same [deg].
        inliers: Of the same.
        confidence: Of the result.
        neighbours: Number of other images that share enough points with it.
        nearest: Distance to the nearest other image that looks the same way, if any [map units].
    """

    name: str
    standing: Standing
    status: str
    reason: str
    position: tuple[float, float, float]
    direction: tuple[float, float, float]
    position_error: float | None
    rotation_error_deg: float | None
    inliers: int
    confidence: float
    neighbours: int
    nearest: float | None


@dataclass(frozen=True)
class WeakSpot:
    """Reference images near each other for which the map does not do.

    Attributes:
        standing: What became of each of them.
        images: Their names.
        around: The name of the one in their middle.
        position: [3] where that was taken, map frame.
        nearest: Distance to the nearest image beyond them that looks the same way, if any.
        advice: What to do.
    """

    standing: Standing
    images: tuple[str, ...]
    around: str
    position: tuple[float, float, float]
    nearest: float | None
    advice: str

    def text(self, unit: str) -> str:
        """The spot in one line."""
        many = f'{len(self.images)} images around' if len(self.images) > 1 else 'image'
        place = ', '.join(f'{value:.1f}' for value in self.position)
        nearest = (
            'no other image looks the same way'
            if self.nearest is None
            else f'nearest other image that looks the same way {self.nearest:.2g} {unit} away'
        )
        return (
            f'{many} `{self.around}` at ({place}): {self.standing.value}; {nearest}: {self.advice}'
        )


@dataclass(frozen=True)
class Coverage:
    """How well a map does at its own images.

    Attributes:
        images: Those that were left out, in the order of the map.
        tolerance: How far a right pose may be off.
        unit: Of lengths.
        weak_spots: The worst kind first, then the largest.
        seconds: Spent on localizing.
    """

    images: tuple[LeftOut, ...]
    tolerance: Tolerance
    unit: str
    weak_spots: tuple[WeakSpot, ...]
    seconds: float

    @property
    def recall(self) -> float:
        """Share of the images that were found where they are, 0 to 1."""
        found = sum(one.standing in {Standing.FOUND, Standing.WEAK} for one in self.images)
        return found / max(len(self.images), 1)

    def count(self, standing: Standing) -> int:
        """Number of images."""
        return sum(one.standing is standing for one in self.images)


def tolerance_of(scene_map: SceneMap) -> Tolerance:
    """A quarter of a metre, or where there are no metres that share of the depth of the scene.

    The depth is the median over the images of the median depth of the points that each sees. At
    five metres, as in rooms, the two are the same.
    """
    if scene_map.manifest.frame.metric:
        return Tolerance(METRIC_TOLERANCE)
    depths = [
        np.median((pose * scene_map.positions_of(scene_map.points_seen_by(image)))[:, 2])
        for image, pose in enumerate(scene_map.camera_from_map)
        if len(scene_map.points_seen_by(image))
    ]
    return Tolerance(DEPTH_TOLERANCE * float(np.median(depths)))


def standing_of(
    result: LocalizationResult, error: PoseError | None, tolerance: Tolerance, neighbours: int
) -> Standing:
    """What a result says about the surroundings of an image.

    Args:
        result: Of the image in the map without it.
        error: Of the best pose found, if any.
        tolerance: How far a right pose may be off.
        neighbours: Number of other images that share enough points with it.
    """
    if not result.accepted or error is None:
        return Standing.REFUSED
    if error.position > tolerance.position or error.rotation_deg > tolerance.rotation_deg:
        return Standing.WRONG
    if neighbours < FEW_NEIGHBOURS or result.inliers < FEW_INLIERS:
        return Standing.WEAK
    return Standing.FOUND


@dataclass(frozen=True)
class Surroundings:
    """How the reference images of a map lie to each other.

    Attributes:
        positions: [I,3] where they were taken.
        directions: [I,3] unit vectors, the way they look.
        neighbours: [I] number of other images that share enough points with each.
        apart: [I,I] distances between those that look the same way, infinite for all others and
            between an image and itself.
        reach: Distance at which two images are of one spot.
    """

    positions: NDArray[np.float64]
    directions: NDArray[np.float64]
    neighbours: NDArray[np.int64]
    apart: NDArray[np.float64]
    reach: float

    @staticmethod
    def of(scene_map: SceneMap) -> Surroundings:
        """Those of a map with at least one image."""
        positions = scene_map.camera_positions
        directions = np.array([pose.rotation.matrix()[2] for pose in scene_map.camera_from_map])
        shared = scene_map.covisibility >= SHARED_POINTS
        own = shared.diagonal().astype(np.int64)
        apart = cdist(positions, positions)
        alike = directions @ directions.T > np.cos(np.radians(_SAME_DIRECTION_DEG))
        apart[~alike | np.eye(len(positions), dtype=bool)] = np.inf
        nearest = apart.min(axis=1)
        known = nearest[np.isfinite(nearest)]
        return Surroundings(
            positions=positions,
            directions=directions,
            neighbours=np.asarray(shared.sum(axis=1)).ravel().astype(np.int64) - own,
            apart=apart,
            reach=_REACH * float(np.median(known)) if len(known) else 0.0,
        )

    def nearest(self, image: int, beyond: Sequence[int] = ()) -> float | None:
        """Distance to the nearest image that looks the same way and is not among some others."""
        distances = np.delete(self.apart[image], list(beyond))
        nearest = float(distances.min(initial=np.inf))
        return nearest if np.isfinite(nearest) else None


def weak_spots(
    left_out: Sequence[LeftOut], indices: Sequence[int], surroundings: Surroundings
) -> tuple[WeakSpot, ...]:
    """Groups the images that the map does not do for by what became of them and where they are.

    Args:
        left_out: Images.
        indices: Their indices in the map.
        surroundings: Of all images of the map.
    """
    spots = []
    for standing in (Standing.WRONG, Standing.REFUSED, Standing.WEAK):
        rows = [row for row, one in enumerate(left_out) if one.standing is standing]
        images = np.array([indices[row] for row in rows], np.int64)
        near = surroundings.apart[np.ix_(images, images)] <= surroundings.reach
        count, group_of = connected_components(near, directed=False)
        groups = [np.flatnonzero(group_of == group) for group in range(count)]
        for group in sorted(groups, key=lambda group: (-len(group), group[0])):
            members = [left_out[rows[one]] for one in group]
            spots.append(_spot(standing, members, images[group].tolist(), surroundings))
    return tuple(spots)


def _spot(
    standing: Standing,
    members: Sequence[LeftOut],
    images: Sequence[int],
    surroundings: Surroundings,
) -> WeakSpot:
    positions = surroundings.positions[images]
    middle = int(np.argmin(np.linalg.norm(positions - positions.mean(axis=0), axis=1)))
    away = [surroundings.nearest(image, images) for image in images]
    nearest = min((distance for distance in away if distance is not None), default=None)
    return WeakSpot(
        standing=standing,
        images=tuple(one.name for one in members),
        around=members[middle].name,
        position=members[middle].position,
        nearest=nearest,
        advice=_advice(standing, members),
    )


def _advice(standing: Standing, members: Sequence[LeftOut]) -> str:
    if standing is Standing.WRONG:
        return (
            'without it the map takes another place for this one, or its pose in the map is wrong: '
            'take more images here that show what is different, and check that pose'
        )
    few = min(one.neighbours for one in members) < FEW_NEIGHBOURS
    ((status, _),) = Counter(one.status for one in members).most_common(1)
    if standing is Standing.WEAK or few:
        return 'take more images here, overlapping by two thirds with these and with the others'
    if status == Status.TOO_FEW_FEATURES.name:
        return 'it shows hardly any texture; a robot will not find itself here by such a view'
    if status == Status.AMBIGUOUS.name:
        return 'it looks like another place; take more images here that show what is different'
    return 'take more images here that look the same way, from a little to the left and right'
