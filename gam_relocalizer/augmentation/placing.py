# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Places arrows in a map by itself: on the ground along the way, and in the air over it.

Everything is in proportion to how far away things are, so maps need not be metric. A reference
image is known by the points that it sees: they tell how wide it looks, and how far.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.augmentation.arrows import Arrow
from gam_relocalizer.augmentation.drawing import HEAD_RADIUS
from gam_relocalizer.errors import UsageError
from gam_relocalizer.geometry import rotation_of
from gam_relocalizer.plots import View

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from gam_relocalizer.scene_map import SceneMap

# Of each kind, at most, and so many in view of each image, if it can be.
MOST = 16
WANTED = 2
# So many images, evenly among all, say where arrows go.
MOST_VIEWS = 300
FEWEST_POINTS = 20

# Shares of the median distance of what the cameras see.
LENGTH = 0.2
AROUND = 1.0
SEPARATION = 0.35
# Shares of the distance that the nearest quarter of an image's points begins to be beyond.
AHEAD = (0.5, 0.9)
NEAREST = 0.25
# Of the points under a camera, so many lie deeper than the ground: what mirrors in a floor.
GROUND_QUANTILE = 0.02
# Cameras are carried at an even height if the middle half differs by no more than this share
# of it. Then three quarters of them tell it: the others do not see the ground.
EVEN = 0.25
HEIGHT_QUANTILE = 0.75
# Where nothing tells: the height of a camera, in metres, or as a share of the distance.
HELD_AT = 1.4
HELD_AT_SHARE = 0.5

GROUND_COLOUR = '#18b26b'
AIR_COLOUR = '#f26a1b'


@dataclass(frozen=True)
class _View:
    """A reference image.

    Attributes:
        rotation: [3,3] camera_from_map.
        centre: [3] where it was taken.
        low: [2] of the rays x/z, y/z to its points: a corner of what it shows.
        high: [2] the other corner.
        nearest: The depth that its nearest quarter of points ends at.
        median: Median depth of its points.
    """

    rotation: NDArray[np.float64]
    centre: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    nearest: float
    median: float

    def sees(self, places: NDArray[np.float64]) -> NDArray[np.bool_]:
        """[N] which places [N,3] lie in its image, no further away than most of what it sees."""
        x, y, z = self.rotation @ (places - self.centre).T
        depth = np.where(z > 0.0, z, np.nan)
        rays = np.column_stack([x / depth, y / depth])
        within = ((rays > self.low) & (rays < self.high)).all(axis=1)
        return np.asarray(within & (z > 0.1 * self.median) & (z < self.median))


@dataclass(frozen=True)
class _Site:
    """A place for an arrow.

    Attributes:
        middle: [3] of the arrow.
        direction: [3] where it points.
    """

    middle: NDArray[np.float64]
    direction: NDArray[np.float64]


def place_arrows(scene_map: SceneMap) -> tuple[Arrow, ...]:
    """Arrows that reference images see: green ones on the ground along the way, orange ones above.

    The same map gives the same arrows. Each is put where most reference images see it that see
    fewer than two of its kind yet.

    Raises:
        UsageError: No reference image sees enough points.
    """
    views = _views_of(scene_map)
    if not views:
        msg = (
            f'{scene_map.path}: no reference image sees {FEWEST_POINTS} points, so there is no '
            f'telling where arrows would be seen; give them with --arrows'
        )
        raise UsageError(msg)
    up = up_of(scene_map)
    typical = float(np.median([view.median for view in views]))
    length = LENGTH * typical
    ground = _Ground(scene_map, views, up, typical)
    sites_ahead = _sites_ahead(views, up)
    on_ground = [
        _Site(ground.below(site.middle) + HEAD_RADIUS * length * up, site.direction)
        for site in sites_ahead
    ]
    in_air = [_Site(site.middle + 0.25 * length * up, -up) for site in sites_ahead]
    return tuple(
        _arrow(site, length, colour)
        for sites, colour in ((on_ground, GROUND_COLOUR), (in_air, AIR_COLOUR))
        for site in _chosen(sites, views, SEPARATION * typical)
    )


def up_of(scene_map: SceneMap) -> NDArray[np.float64]:
    """[3] of length one: the map's z axis if that is vertical, else the cameras' own vertical."""
    right, top = View.from_above(scene_map).axes
    return np.asarray(np.cross(right, top), np.float64)


def _arrow(site: _Site, length: float, colour: str) -> Arrow:
    tail = site.middle - 0.5 * length * site.direction
    x, y, z = (round(float(value), 4) + 0.0 for value in tail)
    dx, dy, dz = (round(float(value), 6) + 0.0 for value in site.direction)
    return Arrow((x, y, z), (dx, dy, dz), round(length, 4), colour)


def _views_of(scene_map: SceneMap) -> list[_View]:
    step = max(1, -(-scene_map.num_images // MOST_VIEWS))
    views = []
    for image in range(0, scene_map.num_images, step):
        points = scene_map.positions_of(scene_map.points_seen_by(image))
        in_camera = np.asarray(scene_map.camera_from_map[image] * points).reshape(-1, 3)
        in_camera = in_camera[in_camera[:, 2] > 0.0]
        if len(in_camera) < FEWEST_POINTS:
            continue
        depths = in_camera[:, 2]
        rays = in_camera[:, :2] / depths[:, None]
        low, high = np.quantile(rays, [0.02, 0.98], axis=0)
        nearest, median = np.quantile(depths, [NEAREST, 0.5])
        pose = scene_map.camera_from_map[image]
        views.append(
            _View(
                rotation_of(pose).as_matrix(),
                scene_map.camera_positions[image],
                low,
                high,
                float(nearest),
                float(median),
            )
        )
    return views


def _sites_ahead(views: list[_View], up: NDArray[np.float64]) -> list[_Site]:
    """Places in front of the cameras, nearer than what they see; directions follow the way."""
    sites = []
    for index, view in enumerate(views):
        forward = _flat(view.rotation[2], up)
        way = _flat(views[min(index + 1, len(views) - 1)].centre - view.centre, up)
        # a camera that looks back along its way must not turn the arrow over
        direction = way if way is not None else forward
        if direction is None:
            direction = _flat(view.rotation[1], up)
        if direction is None:
            continue
        sites += [
            _Site(view.centre + share * view.nearest * view.rotation[2], direction)
            for share in AHEAD
        ]
    return sites


def _flat(vector: NDArray[np.float64], up: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """The horizontal direction of a vector; None for one that is nearly vertical, or zero."""
    length = float(np.linalg.norm(vector))
    flat = vector - (vector @ up) * up
    flat_length = float(np.linalg.norm(flat))
    if length < 1e-9 or flat_length < 0.3 * length:
        return None
    return np.asarray(flat / flat_length, np.float64)


class _Ground:
    """How high the ground is, by the lowest points under the cameras."""

    def __init__(
        self, scene_map: SceneMap, views: list[_View], up: NDArray[np.float64], typical: float
    ) -> None:
        self._up = up
        self._radius = AROUND * typical
        self._points = scene_map.some_points(100_000)
        self._centres = np.array([view.centre for view in views])
        known = [self._level_at(centre) for centre in self._centres]
        heights = [
            float(centre @ up) - level
            for centre, level in zip(self._centres, known, strict=True)
            if level is not None
        ]
        held_at = HELD_AT if scene_map.manifest.frame.metric else HELD_AT_SHARE * typical
        low, middle, high = np.quantile(heights or [held_at], [0.25, 0.5, HEIGHT_QUANTILE])
        self._is_even = bool(high - low <= EVEN * middle)
        self._held_at = float(high)

    def below(self, place: NDArray[np.float64]) -> NDArray[np.float64]:
        """[3] the ground under a place: as deep as under cameras, or by the points around."""
        level = None if self._is_even else self._level_at(place)
        if level is None:
            level = float(self._nearest_centre(place) @ self._up) - self._held_at
        return place + (level - float(place @ self._up)) * self._up

    def _level_at(self, place: NDArray[np.float64]) -> float | None:
        """Height of the ground near a place; None where there are too few points."""
        offsets = self._points - place
        flat = offsets - np.outer(offsets @ self._up, self._up)
        below_camera = (self._points - self._nearest_centre(place)) @ self._up < 0.0
        near = below_camera & (np.linalg.norm(flat, axis=1) < self._radius)
        if near.sum() < FEWEST_POINTS:
            return None
        return float(np.quantile(self._points[near] @ self._up, GROUND_QUANTILE))

    def _nearest_centre(self, place: NDArray[np.float64]) -> NDArray[np.float64]:
        distances = np.linalg.norm(self._centres - place, axis=1)
        return np.asarray(self._centres[np.argmin(distances)], np.float64)


def _chosen(sites: list[_Site], views: list[_View], separation: float) -> list[_Site]:
    """At most `MOST` sites: each is the one that most views see that see too few before it."""
    if not sites:
        return []
    middles = np.array([site.middle for site in sites])
    seen = np.array([view.sees(middles) for view in views])
    wanted = np.full(len(views), WANTED)
    free = np.ones(len(sites), bool)
    chosen: list[_Site] = []
    while len(chosen) < MOST and free.any():
        votes = np.where(free, seen[wanted > 0].sum(axis=0), -1)
        best = int(np.argmax(votes))
        if votes[best] <= 0:
            break
        chosen.append(sites[best])
        wanted -= seen[:, best]
        free &= np.linalg.norm(middles - middles[best], axis=1) > separation
    return chosen
