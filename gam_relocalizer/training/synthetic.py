# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Bipartite graphs with true labels from geometry and random descriptors, without any image.

A random scene is seen by a query camera and by mapping cameras around it. Rays of the mapping
cameras make the map's points (noisy along the ray as triangulated points are, some of them wrong,
some of them doubled), projections of those visible in the query plus rays of the query itself make
its keypoints. Descriptors are drawn around shared words so that repeated elements look alike. The
candidates then come from the kNN ratio matching of inference, so negatives are as hard as there. An
edge is true when its point, as the map has it, projects close enough to its keypoint.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from gam_relocalizer.training.labelled import meet
from gam_relocalizer.training.scenes import PATTERN, Hits, Scene, cast, random_scene

if TYPE_CHECKING:
    from numpy.typing import NDArray

DIMENSION = 64
MIN_SEEN = 24
"""Points of the map that a query sees at least."""


@dataclass(frozen=True)
class SyntheticView:
    """A query and the retrieved part of a map, as a matcher gets them, and the truth.

    Attributes:
        keypoints: [M, 2] normalised keypoints.
        focal_length: In the unit of the keypoints.
        descriptors: [M, D] of the keypoints.
        points: [N, 3] in the frame of a mapping camera near the query, any unit.
        point_descriptors: [N, D] of the points.
        projections: [N, 2] true normalised projections of the points, nan behind the camera.
    """

    keypoints: NDArray[np.float32]
    focal_length: float
    descriptors: NDArray[np.float32]
    points: NDArray[np.float32]
    point_descriptors: NDArray[np.float32]
    projections: NDArray[np.float32]

    def labels(self, edges: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which of the edges [T, 2] are true."""
        return meet(edges, self.keypoints, self.projections)


@dataclass(frozen=True)
class _Camera:
    """A camera in the scene; `extent` is half the image on the plane at distance 1."""

    position: NDArray[np.float64]
    world_from_camera: Rotation
    extent: NDArray[np.float64]

    def rays(self, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
        """[count, 3] directions through random pixels, in the scene, with depth 1."""
        on_plane = np.ones((count, 3))
        on_plane[:, :2] = rng.uniform(-1, 1, (count, 2)) * self.extent
        return np.asarray(self.world_from_camera.apply(on_plane))

    def from_scene(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """[N, 3] points in the frame of the camera."""
        return np.asarray(self.world_from_camera.inv().apply(points - self.position))

    @property
    def focal_length(self) -> float:
        """In the unit of normalised keypoints."""
        return 1.0 / (2.4 * float(self.extent.max()))

    def project(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """[N, 2] normalised keypoint coordinates, nan behind the camera."""
        in_camera = self.from_scene(points)
        depth = np.where(in_camera[:, 2] > 1e-3, in_camera[:, 2], np.nan)
        return np.asarray(in_camera[:, :2] / depth[:, None] * self.focal_length)


@dataclass(frozen=True)
class _Looks:
    """How alike the elements of a scene look: the difficulty of its descriptors."""

    words: NDArray[np.float32]
    word_of_spot: NDArray[np.int64]
    repeated_specificity: float
    specificity: float
    query_noise: float
    map_noise: float


@dataclass(frozen=True)
class _Elements:
    """Physical surface elements: place, looks, and how far a visibility test may be off."""

    positions: NDArray[np.float64]
    looks: NDArray[np.float32]
    tolerance: NDArray[np.float64]

    def __getitem__(self, index: NDArray[np.int64] | NDArray[np.bool_]) -> _Elements:
        return _Elements(self.positions[index], self.looks[index], self.tolerance[index])


def synthetic_view(
    rng: np.random.Generator,
    keypoints: tuple[int, int] = (200, 1500),
    points: tuple[int, int] = (500, 6000),
) -> SyntheticView:
    """Draw a scene, cameras, a map and a query.

    Args:
        rng: Source of everything random.
        keypoints: Least and greatest number of keypoints.
        points: Least and greatest number of points of the map.
    """
    wanted_keypoints = round(np.exp(rng.uniform(*np.log(keypoints))))
    wanted_points = round(np.exp(rng.uniform(*np.log(points))))
    while True:
        scene = random_scene(rng)
        query = _random_camera(scene, rng)
        looks = _random_looks(scene, rng)
        cameras = _mapping_cameras(scene, query, rng)
        elements, origins = _map_elements(scene, cameras, looks, wanted_points, rng)
        seen = np.flatnonzero(_visible(scene, query, elements))
        if len(seen) >= MIN_SEEN:
            break
    positions, point_descriptors = _triangulated(elements, origins, looks, rng)

    matched = round(wanted_keypoints * rng.uniform(0.05, 0.7))
    seen = rng.permutation(seen)[:matched]
    others = _surface_elements(scene, looks, query, wanted_keypoints - len(seen), rng)
    true_places = query.project(np.concatenate([elements.positions[seen], others.positions]))
    noise = np.exp(rng.uniform(np.log(0.3), np.log(2.5))) / 640 / 1.2
    descriptors = _observed(
        np.concatenate([elements.looks[seen], others.looks]), looks.query_noise, rng
    )
    reference = _reference_camera(scene, cameras, elements, seen, rng)
    unit = np.exp(rng.normal(0, 1))
    return SyntheticView(
        keypoints=(true_places + rng.normal(0, noise, true_places.shape)).astype(np.float32),
        focal_length=query.focal_length,
        descriptors=descriptors,
        points=(unit * reference.from_scene(positions)).astype(np.float32),
        point_descriptors=point_descriptors,
        projections=query.project(positions).astype(np.float32),
    )


def _reference_camera(
    scene: Scene,
    cameras: list[_Camera],
    elements: _Elements,
    seen: NDArray[np.int64],
    rng: np.random.Generator,
) -> _Camera:
    """The camera that retrieval might choose: mostly the best one, sometimes any, rarely rolled."""
    chosen = cameras[rng.integers(len(cameras))]
    if rng.random() < 0.75:
        sample = elements[rng.permutation(seen)[:200]]
        chosen = max(cameras, key=lambda camera: int(_visible(scene, camera, sample).sum()))
    if rng.random() < 0.9:
        return chosen
    roll = Rotation.from_euler('z', rng.uniform(0, 2 * np.pi))
    return replace(chosen, world_from_camera=chosen.world_from_camera * roll)


def _random_camera(scene: Scene, rng: np.random.Generator) -> _Camera:
    position = rng.uniform(scene.free_low, scene.free_high)
    yaw, pitch = rng.uniform(0, 2 * np.pi), rng.normal(0, 0.25)
    if scene.target is not None:
        x, y, z = scene.target - position
        yaw = np.arctan2(y, x) + rng.normal(0, 0.2)
        pitch = np.arctan2(z, np.hypot(x, y)) + rng.normal(0, 0.15)
    roll = rng.uniform(0, 2 * np.pi) if rng.random() < 0.2 else rng.normal(0, 0.08)
    half_angle = np.radians(rng.uniform(40, 110)) / 2
    extent = np.tan(half_angle) * np.array([1.0, rng.choice([0.5625, 0.667, 0.75])])
    if rng.random() < 0.15:
        extent = extent[::-1]
    return _Camera(position, _attitude(yaw, pitch, roll), extent)


def _attitude(yaw: float, pitch: float, roll: float) -> Rotation:
    """World from camera for a camera that looks along x at zero (world: z up; camera: z ahead)."""
    ahead = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    return Rotation.from_euler('ZYX', [yaw, -pitch, roll]) * ahead


def _mapping_cameras(scene: Scene, query: _Camera, rng: np.random.Generator) -> list[_Camera]:
    """Cameras around the query, and sometimes a few from elsewhere in the scene."""
    depths = cast(scene, query.position, query.rays(64, rng)).depth
    depth = float(np.median(depths[np.isfinite(depths)])) if np.isfinite(depths).any() else 1.0
    spread, turn = depth * rng.uniform(0.02, 0.6), rng.uniform(0.05, 0.9)
    cameras = []
    for _ in range(rng.integers(1, 10)):
        position = query.position + rng.normal(0, spread, 3) * [1, 1, 0.3]
        position = np.clip(position, scene.free_low, scene.free_high)
        turned = Rotation.from_rotvec(rng.normal(0, turn, 3) * [0.3, 0.3, 1.0])
        extent = query.extent * rng.uniform(0.7, 1.4)
        cameras.append(_Camera(position, turned * query.world_from_camera, extent))
    if rng.random() < 0.4:
        cameras += [_random_camera(scene, rng) for _ in range(rng.integers(1, 6))]
    return cameras


def _random_looks(scene: Scene, rng: np.random.Generator) -> _Looks:
    vocabulary = int(np.exp(rng.uniform(np.log(60), np.log(4000))))
    words = rng.normal(size=(vocabulary, DIMENSION)).astype(np.float32)
    words += rng.uniform(0, 1.0) * rng.normal(size=DIMENSION).astype(np.float32)
    return _Looks(
        words=_unit(words),
        word_of_spot=rng.integers(vocabulary, size=(len(scene.origins), PATTERN)),
        repeated_specificity=rng.uniform(0.05, 0.6),
        specificity=rng.uniform(0.2, 1.5),
        query_noise=rng.uniform(0.4, 1.5),
        map_noise=rng.uniform(0.2, 0.7),
    )


def _elements_at(
    scene: Scene,
    looks: _Looks,
    origin: NDArray[np.float64],
    rays: NDArray[np.float64],
    hits: Hits,
    rng: np.random.Generator,
) -> tuple[_Elements, NDArray[np.int64]]:
    """Elements where rays met texture, and the indices of those rays."""
    textured = (hits.surface >= 0) & (rng.random(len(rays)) < scene.texture[hits.surface])
    index = np.flatnonzero(textured)
    surface, place = hits.surface[index], hits.place[index].astype(np.float64)
    spot = rng.integers(PATTERN, size=len(index))
    cells = scene.cells[surface]
    repeated = cells[:, 0] > 0
    looks_of = looks.words[looks.word_of_spot[surface, spot]]
    own = _unit(rng.normal(size=looks_of.shape).astype(np.float32))

    # in a repeated texture the same spots come back in every cell
    counts = np.maximum(cells, 1)
    within = np.stack([spot * 0.618, spot * 0.3819 + surface * 0.17], axis=1) % 1.0
    cell = np.minimum(np.floor(place * counts), counts - 1)
    place = np.where(repeated[:, None], (cell + within) / counts, place)
    key = np.concatenate([surface[:, None], cell, spot[:, None]], axis=1).astype(np.int64)
    _, first, same = np.unique(key, axis=0, return_index=True, return_inverse=True)
    own = np.where(repeated[:, None], own[first[same.reshape(-1)]], own)
    specificity = np.where(repeated, looks.repeated_specificity, looks.specificity)

    sides = scene.sides[surface].astype(np.float64)
    normals = np.cross(sides[:, 0], sides[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    stand_off = rng.normal(0, 1, len(index)) * scene.roughness[surface]
    positions = scene.origins[surface] + np.einsum('ri,ric->rc', place, sides)
    positions = positions + normals * stand_off[:, None]
    distance = np.linalg.norm(positions - origin, axis=1)
    elements = _Elements(
        positions=positions,
        looks=_unit(looks_of + specificity[:, None].astype(np.float32) * own),
        tolerance=3.0 * scene.roughness[surface] + 0.02 * distance,
    )
    return elements, index


def _surface_elements(
    scene: Scene, looks: _Looks, camera: _Camera, count: int, rng: np.random.Generator
) -> _Elements:
    """`count` elements (fewer where little is textured) that a camera sees in its image."""
    rays = camera.rays(4 * count, rng)
    hits = cast(scene, camera.position, rays)
    elements, _ = _elements_at(scene, looks, camera.position, rays, hits, rng)
    inside = np.isfinite(camera.project(elements.positions)).all(axis=1)
    return elements[np.flatnonzero(inside)[:count]]


def _map_elements(
    scene: Scene, cameras: list[_Camera], looks: _Looks, count: int, rng: np.random.Generator
) -> tuple[_Elements, NDArray[np.float64]]:
    """Elements seen by mapping cameras, some of them doubled, and where they were seen from."""
    share = -(-count // len(cameras))
    parts = [_surface_elements(scene, looks, camera, share, rng) for camera in cameras]
    origins = np.concatenate(
        [np.tile(c.position, (len(p.looks), 1)) for c, p in zip(cameras, parts, strict=True)]
    )
    positions = np.concatenate([part.positions for part in parts])
    elements = _Elements(
        positions=positions,
        looks=np.concatenate([part.looks for part in parts]),
        tolerance=np.concatenate([part.tolerance for part in parts]),
    )
    if not len(positions):
        return elements, origins
    doubles = rng.integers(len(positions), size=int(len(positions) * rng.uniform(0, 0.3)))
    near = _near_doubles(elements[doubles], origins[doubles], rng)
    both = _Elements(
        positions=np.concatenate([elements.positions, near.positions]),
        looks=np.concatenate([elements.looks, near.looks]),
        tolerance=np.concatenate([elements.tolerance, near.tolerance]),
    )
    return both, np.concatenate([origins, origins[doubles]])


def _near_doubles(
    elements: _Elements, origins: NDArray[np.float64], rng: np.random.Generator
) -> _Elements:
    """Points of the same or of a neighbouring element, which look almost the same."""
    distance = np.linalg.norm(elements.positions - origins, axis=1)
    apart = distance * rng.choice([0.0, 0.005, 0.02, 0.05], size=len(distance))
    return _Elements(
        positions=elements.positions + rng.normal(0, 0.6, (len(apart), 3)) * apart[:, None],
        looks=_observed(elements.looks, rng.uniform(0.05, 0.5), rng),
        tolerance=elements.tolerance + apart,
    )


def _visible(scene: Scene, camera: _Camera, elements: _Elements) -> NDArray[np.bool_]:
    """Which elements lie inside the image and before all else on their line of sight."""
    projections = camera.project(elements.positions) / camera.focal_length
    with np.errstate(invalid='ignore'):
        visible = np.asarray((np.abs(projections) < camera.extent).all(axis=1))
    rays = elements.positions[visible] - camera.position
    hits = cast(scene, camera.position, rays)
    slack = elements.tolerance[visible] / np.linalg.norm(rays, axis=1)
    visible[visible] = hits.depth > 1.0 - slack
    return np.asarray(visible)


def _triangulated(
    elements: _Elements, origins: NDArray[np.float64], looks: _Looks, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Positions [N, 3] and descriptors [N, D] of a map: noisy along the ray, some wrong."""
    rays = elements.positions - origins
    count = len(rays)
    depth = 1.0 + rng.normal(0, np.exp(rng.uniform(np.log(0.001), np.log(0.03))), count)
    wrong = rng.random(count) < rng.uniform(0, 0.15)
    depth = np.where(wrong, np.exp(rng.normal(0, 0.7, count)), depth)
    aside = rng.normal(0, 0.001, rays.shape) * np.linalg.norm(rays, axis=1, keepdims=True)
    positions = origins + rays * depth[:, None] + aside
    return positions, _observed(elements.looks, looks.map_noise, rng)


def _observed(
    looks: NDArray[np.float32], noise: float, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Descriptors [R, D] of elements in an image; some views are much worse than others."""
    disturbance = _unit(rng.normal(size=looks.shape).astype(np.float32))
    strength = noise * np.exp(rng.normal(-0.1, 0.45, (len(looks), 1)))
    return _unit(looks + strength.astype(np.float32) * disturbance)


def _unit(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True))
