# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Places that lead a localizer astray: a corridor of identical doors, and views of one picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from gam_relocalizer.demo import textures
from gam_relocalizer.demo.trajectories import CAMERA_LINK_FROM_OPTICAL
from gam_relocalizer.demo.world import (
    FLOOR_DENSITY,
    ROOM_HEIGHT,
    WALL_DENSITY,
    Builder,
    Room,
    World,
    add_lamp_panels,
    hang,
)
from gam_relocalizer.geometry import rigid3d_from_rotation

if TYPE_CHECKING:
    import pycolmap
    from numpy.typing import NDArray

BAYS = 6
BAY = 2.4
"""Length of a bay of the corridor [m]: most views across it show no thing twice."""
WIDTH = 1.9
# A camera that looks across the corridor sees no end from here on.
NO_END_WITHIN = 3.0
EYE_HEIGHT = (1.1, 1.6)
PICTURE_SIDES = (0.5, 1.7)
PICTURE_HEIGHTS = (1.0, 1.9)


def corridor_world(seed: int = 0, bays: int = BAYS) -> World:
    """A corridor along x whose bays look alike to the last texel, on both sides; its ends differ.

    Args:
        seed: Chooses prints and wear.
        bays: Each of `BAY` metres, with a lamp, a door, pictures and notices on either side.

    Raises:
        UsageError: The package with the photographs is not installed.
    """
    builder, rng = Builder(), np.random.default_rng(seed)
    room = Room((0.0, bays * BAY), (0.0, WIDTH), ('drywall_1', 1.1), ('floor_tiles_white', 1.6))
    portraits = [textures.photo(name) for name in textures.portrait_names()]
    portraits = [portraits[index] for index in rng.permutation(len(portraits))]
    _add_bays(builder, room, portraits, rng)
    _add_ends(builder, room, portraits, rng)
    lamps = [((bay + 0.3) * BAY, WIDTH / 2, ROOM_HEIGHT - 0.15) for bay in range(bays)]
    add_lamp_panels(builder, lamps)
    way = np.array([(0.7, 0.9), (bays * BAY / 2, 1.0), (bays * BAY - 0.7, 0.9)])
    return World(tuple(builder.quads), tuple(builder.textures), np.array(lamps), way, way)


def corridor_walk(world: World, spacing: float = 0.6) -> list[pycolmap.Rigid3d]:
    """`camera_from_map` of a walk that maps a corridor: across it at every stop, along it at some.

    Args:
        world: The corridor.
        spacing: Between two stops [m].
    """
    length, rng = _length(world), np.random.default_rng(0)
    stops = np.linspace(0.7, length - 0.7, round((length - 1.4) / spacing) + 1)
    across = [
        # From the far side, to see more of the wall.
        _view((x, WIDTH / 2 - 0.35 * side), side * 90.0 + rng.uniform(-12.0, 12.0), rng)
        for side in (1.0, -1.0)
        for x in stops
    ]
    along = [
        _view((x, WIDTH / 2), yaw + rng.uniform(-12.0, 12.0), rng)
        for yaw in (0.0, 180.0)
        for x in stops[2:-2:3]
    ]
    ends = [
        _view((x, WIDTH / 2), yaw + turn, rng)
        for x, yaw in ((1.5, 180.0), (2.2, 180.0), (length - 1.5, 0.0), (length - 2.2, 0.0))
        for turn in (-8.0, 8.0)
    ]
    return [*across, *along, *ends]


def bay_views(world: World, count: int, rng: np.random.Generator) -> list[pycolmap.Rigid3d]:
    """`camera_from_map` of views across a corridor that show its repeated bays and nothing else."""
    length = _length(world)
    return [
        _view(
            (
                rng.uniform(NO_END_WITHIN, length - NO_END_WITHIN),
                WIDTH / 2 + rng.uniform(-0.3, 0.3),
            ),
            rng.choice([-90.0, 90.0]) + rng.uniform(-20.0, 20.0),
            rng,
        )
        for _ in range(count)
    ]


def end_views(world: World, count: int, rng: np.random.Generator) -> list[pycolmap.Rigid3d]:
    """`camera_from_map` of views of one of the ends of a corridor, from 1.2 to 2.5 m."""
    length = _length(world)
    views = []
    for index in range(count):
        away, yaw = rng.uniform(1.2, 2.5), rng.uniform(-15.0, 15.0)
        x, yaw = (away, 180.0 + yaw) if index % 2 else (length - away, yaw)
        views.append(_view((x, WIDTH / 2 + rng.uniform(-0.3, 0.3)), yaw, rng))
    return views


def along_views(world: World, count: int, rng: np.random.Generator) -> list[pycolmap.Rigid3d]:
    """`camera_from_map` of views along a corridor, from anywhere in it."""
    length = _length(world)
    return [
        _view(
            (rng.uniform(1.0, length - 1.0), WIDTH / 2 + rng.uniform(-0.3, 0.3)),
            rng.choice([0.0, 180.0]) + rng.uniform(-20.0, 20.0),
            rng,
        )
        for _ in range(count)
    ]


def random_views(world: World, count: int, rng: np.random.Generator) -> list[pycolmap.Rigid3d]:
    """`camera_from_map` of views from near the robot's route, in any direction."""
    route = world.drive_route
    views = []
    for first, share in zip(
        rng.integers(len(route) - 1, size=count), rng.random(count), strict=True
    ):
        place = route[first] + share * (route[first + 1] - route[first]) + rng.normal(0.0, 0.15, 2)
        views.append(_view(tuple(place), rng.uniform(0.0, 360.0), rng))
    return views


def picture_views(
    world: World, camera: pycolmap.Camera, rng: np.random.Generator
) -> list[pycolmap.Rigid3d]:
    """`camera_from_map` of views of every picture on a wall, so close that nothing else is seen."""
    views = []
    for quad in world.quads:
        across, down = quad.corners[1] - quad.corners[0], quad.corners[3] - quad.corners[0]
        sides = np.linalg.norm([across, down], axis=1)
        centre = quad.corners.mean(axis=0)
        is_upright = np.allclose(across[2], 0.0) and np.allclose(down[:2], 0.0)
        if not (
            is_upright and _within(sides, PICTURE_SIDES) and _within(centre[2], PICTURE_HEIGHTS)
        ):
            continue
        inward = np.cross(down, across) / np.prod(sides)
        focal = np.array([camera.focal_length_x, camera.focal_length_y])
        distance = float(np.min(sides * focal / (camera.width, camera.height)))
        yaw = np.degrees(np.arctan2(-inward[1], -inward[0])) + rng.uniform(-4.0, 4.0)
        place = centre + rng.uniform(0.75, 0.9) * distance * inward
        views.append(_camera_from_map(place, yaw, rng.uniform(-4.0, 4.0), 0.0))
    return views


def _add_bays(
    builder: Builder,
    room: Room,
    portraits: list[NDArray[np.uint8]],
    rng: np.random.Generator,
) -> None:
    """Walls, floor, ceiling and what hangs there, bay by bay from the same textures."""
    wall = builder.texture(_panel(room.wall, (BAY, ROOM_HEIGHT), WALL_DENSITY, rng))
    floor = builder.texture(_panel(room.floor, (BAY, WIDTH), FLOOR_DENSITY, rng))
    ceiling = builder.texture(_panel(('ceiling_tiles_1', 2.4), (BAY, WIDTH), FLOOR_DENSITY, rng))
    door = builder.texture(textures.resized(textures.photo('door_steel_grey'), 260, 500))
    wood = textures.photo('wood_1')
    framed = textures.framed(textures.resized(portraits[0], 220, 220), wood, 0.09)
    picture, notice = builder.texture(framed), builder.texture(textures.printed_page(rng, 150, 210))
    pinned = textures.notice_board(rng, textures.photo('cardboard_4'), portraits[21:40], 400, 300)
    board = builder.texture(pinned)
    for bay in range(round((room.x[1] - room.x[0]) / BAY)):
        left = bay * BAY
        builder.quad((left, WIDTH, ROOM_HEIGHT), (BAY, 0, 0), (0, 0, -ROOM_HEIGHT), wall)
        builder.quad((left + BAY, 0, ROOM_HEIGHT), (-BAY, 0, 0), (0, 0, -ROOM_HEIGHT), wall)
        builder.quad((left, WIDTH, 0), (BAY, 0, 0), (0, -WIDTH, 0), floor)
        builder.quad((left, 0, ROOM_HEIGHT), (BAY, 0, 0), (0, WIDTH, 0), ceiling)
        for side, start, turn in (('north', left, 1.0), ('south', left + BAY, -1.0)):
            hang(builder, door, room, side, start + turn * 0.55, (0.9, 2.08), 1.05)
            hang(builder, notice, room, side, start + turn * 1.15, (0.21, 0.3), 1.35)
            hang(builder, picture, room, side, start + turn * 1.52, (0.42, 0.42), 1.5)
            hang(builder, board, room, side, start + turn * 2.06, (0.56, 0.42), 1.45)


def _add_ends(
    builder: Builder,
    room: Room,
    portraits: list[NDArray[np.uint8]],
    rng: np.random.Generator,
) -> None:
    """An end with a red door and paintings, and one with a notice board and a poster."""
    (west, east), wood = room.x, textures.photo('wood_2')
    size = (WIDTH, ROOM_HEIGHT)
    for material, corner, across in (
        ('brick_wall_1', (west, 0.0, ROOM_HEIGHT), (0, WIDTH, 0)),
        ('cinder_blocks_1', (east, WIDTH, ROOM_HEIGHT), (0, -WIDTH, 0)),
    ):
        wall = builder.texture(_panel((material, 1.9), size, WALL_DENSITY, rng))
        builder.quad(corner, across, (0, 0, -ROOM_HEIGHT), wall)
    door = builder.texture(textures.resized(textures.photo('door_steel_red'), 260, 500))
    hang(builder, door, room, 'west', 0.55, (0.9, 2.08), 1.05)
    for height, portrait in zip((1.05, 1.7), portraits[1:], strict=False):
        image = textures.framed(textures.resized(portrait, 220, 220), wood, 0.09)
        hang(builder, builder.texture(image), room, 'west', 1.45, (0.55, 0.55), height)
    board = textures.notice_board(rng, textures.photo('cardboard_1'), portraits[3:20], 520, 400)
    hang(builder, builder.texture(board), room, 'east', 0.65, (1.1, 0.85), 1.45)
    print_ = textures.poster(rng, portraits[20], 330, 480)
    hang(builder, builder.texture(print_), room, 'east', 1.55, (0.5, 0.73), 1.4)


def _panel(
    material: tuple[str, float],
    size: tuple[float, float],
    density: float,
    rng: np.random.Generator,
) -> NDArray[np.uint8]:
    """The worn surface of a wall, floor or ceiling."""
    name, tile_width = material
    return textures.weathered(
        textures.tiled(textures.photo(name), size, tile_width, density), rng, 0.3
    )


def _length(world: World) -> float:
    """From one end of a corridor to the other [m]."""
    return float(max(quad.corners[:, 0].max() for quad in world.quads))


def _within(values: NDArray[np.float64], limits: tuple[float, float]) -> bool:
    return bool(np.all((values >= limits[0]) & (values <= limits[1])))


def _view(place: tuple[float, ...], yaw_deg: float, rng: np.random.Generator) -> pycolmap.Rigid3d:
    """A hand-held camera, not quite level."""
    eye = np.array([*place, rng.uniform(*EYE_HEIGHT)])
    return _camera_from_map(eye, yaw_deg, rng.uniform(-6.0, 6.0), rng.uniform(-3.0, 3.0))


def _camera_from_map(
    eye: NDArray[np.float64], yaw_deg: float, pitch_deg: float, roll_deg: float
) -> pycolmap.Rigid3d:
    turn = Rotation.from_euler('ZYX', (yaw_deg, pitch_deg, roll_deg), degrees=True)
    return (rigid3d_from_rotation(turn, eye) * CAMERA_LINK_FROM_OPTICAL).inverse()
