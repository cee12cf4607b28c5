# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Random scenes of textured rectangles, and the rays that look at them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

NEAREST = 0.05
PATTERN = 24
"""Distinct spots in one cell of a repeated texture, and looks a plain texture draws from."""


@dataclass(frozen=True)
class Scene:
    """Rectangles in metres, z up, and where a camera may stand.

    Attributes:
        origins: [P, 3] a corner of every rectangle.
        sides: [P, 2, 3] its two edges, at right angles.
        roughness: [P] metres that surface points stand off the plane (leaves, clutter).
        texture: [P] chance that a ray that hits leaves a keypoint.
        cells: [P, 2] repetitions of the texture along the edges, 0 where it does not repeat.
        free_low, free_high: [3] corners of the box in which cameras stand.
        target: [3] what cameras look at, or None when they look anywhere.
    """

    origins: NDArray[np.float32]
    sides: NDArray[np.float32]
    roughness: NDArray[np.float32]
    texture: NDArray[np.float32]
    cells: NDArray[np.int64]
    free_low: NDArray[np.float64]
    free_high: NDArray[np.float64]
    target: NDArray[np.float64] | None


@dataclass(frozen=True)
class Hits:
    """What rays met: the surface (-1 for none), the depth along the ray and the place on it."""

    surface: NDArray[np.int64]
    depth: NDArray[np.float32]
    place: NDArray[np.float32]


def cast(scene: Scene, origin: NDArray[np.floating], rays: NDArray[np.floating]) -> Hits:
    """First hits of rays [R, 3] that leave one origin [3]."""
    rays = rays.astype(np.float32)
    lengths = np.square(scene.sides).sum(axis=2)
    normals = np.cross(scene.sides[:, 0], scene.sides[:, 1])
    to_corner = scene.origins - origin.astype(np.float32)
    with np.errstate(divide='ignore', invalid='ignore'):
        depth = np.einsum('pc,pc->p', to_corner, normals) / (rays @ normals.T)
        places = [
            (depth * (rays @ side.T) - np.einsum('pc,pc->p', to_corner, side)) / length
            for side, length in zip(scene.sides.transpose(1, 0, 2), lengths.T, strict=True)
        ]
        inside = depth > NEAREST
        for place in places:
            inside &= (place >= 0) & (place <= 1)
    depth = np.where(inside, depth, np.inf)
    surface = depth.argmin(axis=1)
    rows = np.arange(len(rays))
    depth = depth[rows, surface]
    place = np.stack([p[rows, surface] for p in places], axis=1)
    return Hits(np.where(np.isfinite(depth), surface, -1), depth, place)


@dataclass
class _Builder:
    rng: np.random.Generator
    origins: list[NDArray[np.float64]] = field(default_factory=list)
    sides: list[NDArray[np.float64]] = field(default_factory=list)
    roughness: list[float] = field(default_factory=list)
    texture: list[float] = field(default_factory=list)
    cells: list[tuple[int, int]] = field(default_factory=list)

    def rectangle(
        self,
        origin: NDArray[np.float64],
        side_a: NDArray[np.float64],
        side_b: NDArray[np.float64],
        *,
        repeated: float = 0.0,
        roughness: float = 0.0,
        texture: float | None = None,
    ) -> None:
        """Add a rectangle; `repeated` is the chance that its texture repeats."""
        cells = (0, 0)
        if self.rng.random() < repeated:
            period = self.rng.uniform(0.5, 4.0) * (np.linalg.norm(side_a) / 12) ** 0.5
            lengths = np.linalg.norm([side_a, side_b], axis=1)
            cells = (max(1, round(lengths[0] / period)), max(1, round(lengths[1] / period)))
        self.origins.append(origin)
        self.sides.append(np.stack([side_a, side_b]))
        self.roughness.append(roughness)
        self.texture.append(self.rng.uniform(0.05, 1.0) ** 2 if texture is None else texture)
        self.cells.append(cells)

    def box(
        self,
        centre: NDArray[np.float64],
        size: NDArray[np.float64],
        *,
        inside: bool = False,
        repeated: float = 0.0,
        roughness: float = 0.0,
    ) -> None:
        """Add a box that stands on z = centre[2]; seen from inside it stays axis-aligned."""
        angle = 0.0 if inside else self.rng.uniform(0, np.pi)
        x = np.array([np.cos(angle), np.sin(angle), 0.0]) * size[0]
        y = np.array([-np.sin(angle), np.cos(angle), 0.0]) * size[1]
        z = np.array([0.0, 0.0, size[2]])
        corner = centre - (x + y) / 2
        for origin, a, b in (
            (corner, x, z),
            (corner + y, x, z),
            (corner, y, z),
            (corner + x, y, z),
            (corner + z, x, y),
        ):
            self.rectangle(origin, a, b, repeated=repeated, roughness=roughness)

    def walls(self, size: NDArray[np.float64], repeated: float, *, ceiling: bool) -> None:
        """Add a room centred on x = y = 0 with its floor at z = 0."""
        low, high = np.array([-size[0] / 2, -size[1] / 2, 0.0]), np.diag(size)
        for origin, a, b in (
            (low, high[0], high[2]),
            (low + high[1], high[0], high[2]),
            (low, high[1], high[2]),
            (low + high[0], high[1], high[2]),
        ):
            self.rectangle(origin, a, b, repeated=repeated)
        self.rectangle(low, high[0], high[1], repeated=repeated, texture=self.rng.uniform(0, 0.4))
        if ceiling:
            self.rectangle(low + high[2], high[0], high[1], repeated=0.5)

    def posters(self, size: NDArray[np.float64], count: int) -> None:
        """Hang well-textured rectangles on the walls of a room."""
        for _ in range(count):
            extent = self.rng.uniform(0.2, 0.4, 2) * min(3.0, size.min())
            axis = self.rng.integers(2)
            side = np.zeros(3)
            side[axis] = extent[0]
            origin = np.zeros(3)
            origin[axis] = self.rng.uniform(-0.5, 0.5) * (size[axis] - extent[0])
            origin[1 - axis] = self.rng.choice([-0.5, 0.5]) * (size[1 - axis] - 0.04)
            origin[2] = self.rng.uniform(0.1, 0.9) * (size[2] - extent[1])
            self.rectangle(origin, side, np.array([0, 0, extent[1]]), texture=1.0)

    def scatter(
        self, count: int, low: float, high: float, sizes: tuple[float, float], rough: float
    ) -> None:
        """Put boxes on the ground at distances low..high; `rough` is the chance of foliage."""
        for _ in range(count):
            angle, radius = self.rng.uniform(0, 2 * np.pi), self.rng.uniform(low, high)
            size = self.rng.uniform(*sizes) * self.rng.uniform(0.4, 1.6, 3)
            centre = np.array([radius * np.cos(angle), radius * np.sin(angle), 0.0])
            foliage = self.rng.random() < rough
            roughness = 0.2 * float(size.min()) if foliage else 0.0
            self.box(centre, size, roughness=roughness, repeated=0.15)

    def scene(
        self,
        free_low: tuple[float, float, float],
        free_high: tuple[float, float, float],
        target: NDArray[np.float64] | None = None,
    ) -> Scene:
        return Scene(
            origins=np.array(self.origins, np.float32),
            sides=np.array(self.sides, np.float32),
            roughness=np.array(self.roughness, np.float32),
            texture=np.array(self.texture, np.float32),
            cells=np.array(self.cells, np.int64),
            free_low=np.array(free_low),
            free_high=np.array(free_high),
            target=target,
        )


def _room(rng: np.random.Generator) -> Scene:
    builder = _Builder(rng)
    size = np.array([*rng.uniform(2.5, 10, 2), rng.uniform(2.3, 3.5)])
    builder.walls(size, repeated=0.25, ceiling=True)
    builder.posters(size, int(rng.integers(0, 10)))
    for _ in range(rng.integers(3, 16)):
        extent = rng.uniform(0.15, 1.5, 3) * [1, 1, rng.uniform(0.3, 1.2)]
        centre = np.array([*(rng.uniform(-0.5, 0.5, 2) * size[:2]), 0.0])
        if rng.random() < 0.4:
            centre[2] = rng.uniform(0.3, 1.5)
            extent *= 0.5
        builder.box(centre, extent, roughness=0.1 * extent.min() * (rng.random() < 0.3))
    half = 0.4 * size
    return builder.scene((-half[0], -half[1], 0.6), (half[0], half[1], 2.0))


def _corridor(rng: np.random.Generator) -> Scene:
    builder = _Builder(rng)
    size = np.array([rng.uniform(10, 50), rng.uniform(1.5, 4.0), rng.uniform(2.3, 4.0)])
    builder.walls(size, repeated=0.6, ceiling=True)
    builder.posters(size, int(rng.integers(0, 14)))
    for _ in range(rng.integers(0, 8)):
        side = rng.choice([-0.5, 0.5])
        centre = np.array([rng.uniform(-0.5, 0.5) * size[0], side * size[1], 0.0])
        builder.box(centre, rng.uniform(0.2, 1.0, 3))
    half = size * [0.45, 0.3, 0]
    return builder.scene((-half[0], -half[1], 0.8), (half[0], half[1], 1.9))


def _courtyard(rng: np.random.Generator) -> Scene:
    builder = _Builder(rng)
    size = np.array([*rng.uniform(12, 60, 2), rng.uniform(5, 20)])
    builder.walls(size, repeated=0.7, ceiling=False)
    builder.scatter(int(rng.integers(2, 10)), 2, 0.5 * size[:2].min(), (0.5, 3.0), 0.3)
    half = 0.42 * size
    return builder.scene((-half[0], -half[1], 1.0), (half[0], half[1], 2.5))


def _facade(rng: np.random.Generator) -> Scene:
    builder = _Builder(rng)
    for _ in range(rng.integers(1, 5)):
        yaw = rng.normal(0, 0.5)
        along = np.array([np.cos(yaw), np.sin(yaw), 0.0]) * rng.uniform(6, 40)
        up = np.array([0.0, 0.0, rng.uniform(4, 25)])
        middle = np.array([rng.normal(0, 10), rng.uniform(5, 30), 0.0])
        builder.rectangle(middle - along / 2, along, up, repeated=0.75)
        relief = along * rng.uniform(0.05, 0.3)
        front = middle - [0.0, rng.uniform(0.1, 2.0), 0.0] + along * rng.uniform(-0.4, 0.2)
        builder.rectangle(front, relief, up * rng.uniform(0.2, 1.0), repeated=0.4)
    builder.rectangle(
        np.array([-50.0, -30, 0]), np.array([100.0, 0, 0]), np.array([0, 100.0, 0]), texture=0.15
    )
    builder.scatter(int(rng.integers(0, 10)), 3, 20, (0.3, 3.0), 0.5)
    return builder.scene((-12, -12, 1.0), (12, 2, 3.0), np.array([0.0, 12.0, rng.uniform(1, 8)]))


def _object(rng: np.random.Generator) -> Scene:
    builder = _Builder(rng)
    extent = 10 ** rng.uniform(-1, 0.5)
    room = np.array([*rng.uniform(6, 20, 2), rng.uniform(4, 8)])
    builder.walls(extent * room, repeated=0.3, ceiling=False)
    height = rng.uniform(0, 1) * extent
    for _ in range(rng.integers(2, 9)):
        size = extent * rng.uniform(0.2, 1.0, 3)
        centre = np.array([*(rng.normal(0, 0.35, 2) * extent), height])
        builder.box(centre, size, roughness=0.15 * size.min() * (rng.random() < 0.5))
    reach = 2.5 * extent
    target = np.array([0.0, 0.0, height + 0.4 * extent])
    return builder.scene((-reach, -reach, 0.3 * extent), (reach, reach, 3 * extent), target)


def _outdoor(rng: np.random.Generator) -> Scene:
    builder = _Builder(rng)
    builder.rectangle(
        np.array([-150.0, -150, 0]), np.array([300.0, 0, 0]), np.array([0, 300.0, 0]), texture=0.1
    )
    builder.scatter(int(rng.integers(4, 12)), 3, 30, (0.3, 3.0), 0.7)
    builder.scatter(int(rng.integers(2, 8)), 15, 100, (5.0, 20.0), 0.3)
    return builder.scene((-3, -3, 1.0), (3, 3, 2.2))


KINDS: tuple[Callable[[np.random.Generator], Scene], ...] = (
    _room,
    _room,
    _corridor,
    _courtyard,
    _facade,
    _object,
    _outdoor,
)


def random_scene(rng: np.random.Generator) -> Scene:
    """A room, corridor, courtyard, facade, object on a stand or open ground."""
    return KINDS[rng.integers(len(KINDS))](rng)
