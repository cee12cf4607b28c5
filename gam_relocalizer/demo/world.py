# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The demo world: rooms of textured quads in the map frame (REP-103: metres, z up)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from gam_relocalizer.demo import textures

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    Vector = Sequence[float] | NDArray[np.float64]

ROOM_HEIGHT = 2.7
DOOR_HEIGHT = 2.1
WALL_DENSITY = 220.0
FLOOR_DENSITY = 160.0


@dataclass(frozen=True, eq=False)
class Quad:
    """A textured parallelogram, seen from its front only.

    Attributes:
        corners: [4,3] in the map frame [m]: the texture's top-left, top-right, bottom-right and
            bottom-left corner, clockwise for who looks at the front.
        texture: Index into the world's textures.
        emission: Light it sends out by itself, as a share of a white surface in full light.
    """

    corners: NDArray[np.float64]
    texture: int
    emission: float = 0.0


@dataclass(frozen=True, eq=False)
class World:
    """A scene, and the ways through it that are free of furniture.

    Attributes:
        quads: Everything that can be seen.
        textures: RGB uint8 images.
        lamps: Places of the lamps [L,3].
        drive_route: Way points [K,2] of a robot's drive through the rooms.
        mapping_route: Way points [K,2] of the walk that maps the rooms.
    """

    quads: tuple[Quad, ...]
    textures: tuple[NDArray[np.uint8], ...]
    lamps: NDArray[np.float64]
    drive_route: NDArray[np.float64]
    mapping_route: NDArray[np.float64]


@dataclass(frozen=True)
class Doorway:
    """An opening between two rooms: the rectangle of floor between their walls."""

    x: tuple[float, float]
    y: tuple[float, float]


@dataclass(frozen=True)
class Room:
    """A rectangular room.

    Attributes:
        x: West and east wall [m].
        y: South and north wall [m].
        wall: Photograph on the walls and the width of one copy of it [m].
        floor: The same for the floor.
    """

    x: tuple[float, float]
    y: tuple[float, float]
    wall: tuple[str, float]
    floor: tuple[str, float]


OFFICE = Room((0.0, 6.9), (5.52, 9.0), ('stucco_1', 1.6), ('wood_planks_1', 1.5))
GALLERY = Room((7.02, 14.0), (5.52, 9.0), ('brick_wall_1', 2.2), ('marble_1', 1.3))
WORKSHOP = Room((3.0, 11.5), (0.0, 3.48), ('cinder_blocks_1', 1.9), ('concrete_tiles_1', 1.8))
CORRIDOR = Room((0.0, 14.0), (3.6, 5.4), ('drywall_1', 1.1), ('floor_tiles_white', 1.6))
ROOMS = (OFFICE, GALLERY, WORKSHOP, CORRIDOR)
DOORWAYS = (
    Doorway((1.6, 2.6), (5.4, 5.52)),
    Doorway((11.2, 12.2), (5.4, 5.52)),
    Doorway((6.9, 7.02), (6.8, 7.8)),
    Doorway((6.6, 7.6), (3.48, 3.6)),
)

DRIVE_ROUTE = (
    (0.9, 4.5), (1.7, 4.75), (2.15, 5.5), (2.5, 6.4), (3.6, 7.1), (5.2, 7.3), (6.95, 7.3),
    (8.6, 7.35), (10.2, 7.5), (11.4, 7.0), (11.75, 6.2), (11.6, 5.3), (10.9, 4.65), (9.6, 4.4),
    (8.2, 4.55), (7.3, 4.2), (7.1, 3.4), (7.5, 2.7), (8.6, 2.45), (9.7, 2.25), (10.05, 1.6),
    (9.4, 1.0), (8.0, 0.85), (6.4, 0.85), (5.1, 1.05), (4.65, 1.75), (5.3, 2.4), (6.4, 2.65),
    (7.0, 3.3), (6.7, 4.1), (5.8, 4.5), (4.4, 4.55), (2.6, 4.4),
)  # fmt: skip
MAPPING_ROUTE = (
    (0.9, 4.3), (1.8, 4.5), (2.0, 5.4), (2.2, 6.3), (3.3, 7.4), (5.0, 7.6), (6.9, 7.4),
    (8.4, 7.1), (10.0, 7.1), (11.2, 7.3), (11.9, 6.6), (11.7, 5.5), (12.3, 4.6), (12.8, 4.2),
    (11.6, 4.2), (10.0, 4.7), (8.4, 4.4), (7.0, 4.4), (7.1, 3.4), (7.3, 2.6), (8.8, 2.7),
    (10.0, 2.4), (10.4, 1.5), (9.6, 0.8), (8.0, 0.7), (6.4, 0.7), (5.0, 0.8), (4.3, 1.6),
    (4.9, 2.6), (6.5, 2.8), (7.0, 3.4), (6.3, 4.3), (5.0, 4.4), (3.4, 4.7), (2.0, 4.3),
)  # fmt: skip


class Builder:
    """Collects quads and textures; lengths in metres, in the map frame."""

    def __init__(self) -> None:
        self.quads: list[Quad] = []
        self.textures: list[NDArray[np.uint8]] = []

    def texture(self, image: NDArray[np.uint8]) -> int:
        """Registers an image and returns its index."""
        self.textures.append(np.ascontiguousarray(image))
        return len(self.textures) - 1

    def quad(
        self,
        top_left: Vector,
        across: Vector,
        down: Vector,
        texture: int,
        emission: float = 0.0,
    ) -> None:
        """Adds a parallelogram."""
        origin, right, below = (np.asarray(v, dtype=float) for v in (top_left, across, down))
        corners = np.stack([origin, origin + right, origin + right + below, origin + below])
        self.quads.append(Quad(corners, texture, emission))

    def box(
        self,
        centre: Vector,
        size: Vector,
        faces: Mapping[str, int],
        rotation: Rotation | None = None,
    ) -> None:
        """Adds a box.

        Args:
            centre: Of the box.
            size: Along its own x, y, z.
            faces: Textures by face: `+x`, `-x`, `+y`, `-y`, `+z`, `-z`, or `side` (the four
                upright ones) and `any` for faces that are not named.
            rotation: From the box's axes to the map's.
        """
        turn = (rotation or Rotation.identity()).as_matrix()
        half = np.asarray(size, dtype=float) / 2
        for axis in range(3):
            for sign in (1.0, -1.0):
                name = f'{"+" if sign > 0 else "-"}{"xyz"[axis]}'
                upright = faces.get('side', faces.get('any')) if axis < 2 else faces.get('any')
                face = faces.get(name, upright)
                if face is None:
                    continue
                normal = sign * np.eye(3)[axis]
                up = np.array([0.0, 0.0, 1.0]) if axis < 2 else np.array([0.0, sign, 0.0])
                right = np.cross(up, normal)
                top_left = (normal + up - right) * half
                self.quad(
                    turn @ top_left + centre,
                    turn @ (2 * right * half),
                    turn @ (-2 * up * half),
                    face,
                )


def demo_world(seed: int = 0, *, rearranged: bool = False) -> World:
    """Three rooms and a corridor, about 14 x 9 m, full of pictures, furniture and clutter.

    Args:
        seed: Chooses textures, places and attitudes.
        rearranged: Chairs, cartons and clutter lie elsewhere than in the world of the same seed;
            walls, pictures and heavy furniture are the same.

    Raises:
        UsageError: The package with the photographs is not installed.
    """
    builder, rng = Builder(), np.random.default_rng(seed)
    loose = np.random.default_rng((seed, int(rearranged)))
    for room in ROOMS:
        _add_shell(builder, room, rng)
    for doorway in DOORWAYS:
        _add_doorway(builder, doorway, rng)
    prints = _Prints(builder, rng)
    _furnish_office(builder, prints, loose)
    _furnish_gallery(builder, prints, loose)
    _furnish_workshop(builder, prints, loose)
    _furnish_corridor(builder, prints, loose)
    lamps = [
        (x, (room.y[0] + room.y[1]) / 2, ROOM_HEIGHT - 0.15)
        for room in ROOMS
        for x in np.arange(room.x[0] + 1.7, room.x[1] - 1.0, 3.4)
    ]
    add_lamp_panels(builder, lamps)
    return World(
        tuple(builder.quads),
        tuple(builder.textures),
        np.array(lamps),
        np.array(DRIVE_ROUTE),
        np.array(MAPPING_ROUTE),
    )


def tiny_world(seed: int = 0) -> World:
    """One room of 4 x 3 m with pictures and boxes: quick to build and to render.

    Raises:
        UsageError: The package with the photographs is not installed.
    """
    builder, rng = Builder(), np.random.default_rng(seed)
    room = Room((0.0, 4.0), (0.0, 3.0), ('stucco_1', 1.6), ('wood_planks_1', 1.5))
    _add_shell(builder, room, rng)
    prints = _Prints(builder, rng)
    for along in (0.7, 2.0, 3.3):
        hang(builder, prints.next_painting(), room, 'north', along, (0.8, 0.8))
        hang(builder, prints.next_painting(), room, 'south', along, (0.8, 0.8))
    hang(builder, prints.boards[0], room, 'east', 1.5, (1.8, 1.2))
    hang(builder, prints.boards[1], room, 'west', 1.5, (1.8, 1.2))
    for x, y in ((0.3, 0.3), (3.7, 0.3), (3.7, 2.7), (0.3, 2.7)):
        _stack_cartons(builder, prints, rng, (x, y, 0.0), 3)
    lamp = (2.0, 1.5, ROOM_HEIGHT - 0.15)
    add_lamp_panels(builder, [lamp])
    loop = ((1.0, 1.1), (2.0, 0.9), (3.0, 1.1), (3.1, 1.6), (2.4, 2.0), (1.4, 2.0))
    return World(
        tuple(builder.quads),
        tuple(builder.textures),
        np.array([lamp]),
        np.array(loop),
        np.array(loop) + np.array([0.05, -0.1]),
    )


class _Prints:
    """Textures that furniture and walls share; the same print may hang in several places."""

    def __init__(self, builder: Builder, rng: np.random.Generator) -> None:
        photo = textures.photo
        portraits = [textures.photo(name) for name in textures.portrait_names()]
        order = rng.permutation(len(portraits))
        self.portraits = [portraits[index] for index in order]
        woods = [photo('wood_1'), photo('wood_2'), photo('cardboard_3')]
        self.paintings = [
            builder.texture(
                textures.framed(textures.resized(image, 300, 300), woods[index % 3], 0.09)
            )
            for index, image in enumerate(self.portraits[:44])
        ]
        self._next = 0
        pictures = self.portraits[44:]
        self.posters = [
            builder.texture(textures.poster(rng, pictures[index], 330, 480)) for index in range(10)
        ]
        self.pages = [builder.texture(textures.printed_page(rng, 150, 210)) for _ in range(8)]
        board_grounds = [photo('cardboard_1'), photo('cardboard_4')]
        self.boards = [
            builder.texture(
                textures.notice_board(rng, board_grounds[index % 2], pictures, 620, 400)
            )
            for index in range(4)
        ]
        self.books = [builder.texture(textures.book_row(rng, pictures, 640, 190)) for _ in range(8)]
        self.cartons = [
            builder.texture(
                textures.carton(rng, photo(f'cardboard_{1 + index % 2}'), pictures[index % 20], 240)
            )
            for index in range(12)
        ]
        self.photographs = [
            builder.texture(textures.resized(image, 130, 130)) for image in pictures[:24]
        ]
        self.window = builder.texture(textures.window_view(rng, 560, 420))
        self.rugs = [
            builder.texture(textures.rug(pictures[first : first + 7], 9, 6, 60)) for first in (0, 9)
        ]
        self.materials = {
            name: builder.texture(
                textures.weathered(textures.resized(photo(name), 320, 320), rng, 0.2)
            )
            for name in (
                'wood_1', 'wood_2', 'wood_planks_1', 'metal_grill_1', 'concrete_1', 'cardboard_1',
                'cardboard_2', 'marble_1', 'marble_2', 'rock_1', 'airduct_grate_1', 'asphalt_1',
            )
        }  # fmt: skip
        self.doors = {
            name: builder.texture(
                textures.weathered(textures.resized(photo(name), 260, 500), rng, 0.1)
            )
            for name in ('door_steel_brown', 'door_steel_grey', 'door_steel_red')
        }
        self.garage = builder.texture(
            textures.weathered(textures.resized(photo('door_garage_red'), 520, 480), rng, 0.15)
        )

    def next_painting(self) -> int:
        """The next painting that does not hang anywhere yet."""
        self._next += 1
        return self.paintings[(self._next - 1) % len(self.paintings)]


def _add_shell(builder: Builder, room: Room, rng: np.random.Generator) -> None:
    """Walls with openings, floor and ceiling of a room."""
    (west, east), (south, north) = room.x, room.y
    walls = (
        ((west, north), (east, north)),
        ((east, north), (east, south)),
        ((east, south), (west, south)),
        ((west, south), (west, north)),
    )
    for start, end in walls:
        _add_wall(builder, np.array(start), np.array(end), room.wall, rng)
    width, depth = east - west, north - south
    floor = _surface(room.floor, (width, depth), FLOOR_DENSITY, rng, 0.22)
    builder.quad((west, north, 0.0), (width, 0, 0), (0, -depth, 0), builder.texture(floor))
    ceiling = _surface(('ceiling_tiles_1', 2.4), (width, depth), 0.6 * FLOOR_DENSITY, rng, 0.12)
    builder.quad((west, south, ROOM_HEIGHT), (width, 0, 0), (0, depth, 0), builder.texture(ceiling))


def _surface(
    material: tuple[str, float],
    size: tuple[float, float],
    density: float,
    rng: np.random.Generator,
    wear: float,
) -> NDArray[np.uint8]:
    """The baked texture of a wall, floor or ceiling."""
    name, tile_width = material
    ground = textures.tiled(textures.photo(name), size, tile_width, density)
    worn = textures.weathered(ground, rng, wear)
    return textures.with_dark_borders(worn, reach=round(0.25 * density))


def _add_wall(
    builder: Builder,
    start: NDArray[np.float64],
    end: NDArray[np.float64],
    material: tuple[str, float],
    rng: np.random.Generator,
) -> None:
    """One wall from its left to its right end, seen from inside, cut around the doorways."""
    length = float(np.linalg.norm(end - start))
    along = (end - start) / length
    baked = _surface(material, (length, ROOM_HEIGHT), WALL_DENSITY, rng, 0.25)
    skirting = round(0.1 * WALL_DENSITY)
    baked[-skirting:] = (0.35 * baked[-skirting:] + (40, 32, 24)).astype(np.uint8)
    panels = [(0.0, length, 0.0, ROOM_HEIGHT)]
    for low, high in _openings(start, along, length):
        left, right, _, _ = panels.pop()
        panels += [
            (left, low, 0.0, ROOM_HEIGHT),
            (low, high, DOOR_HEIGHT, ROOM_HEIGHT),
            (high, right, 0.0, ROOM_HEIGHT),
        ]
    for left, right, bottom, top in panels:
        columns = slice(round(left * WALL_DENSITY), round(right * WALL_DENSITY))
        rows = slice(
            round((ROOM_HEIGHT - top) * WALL_DENSITY), round((ROOM_HEIGHT - bottom) * WALL_DENSITY)
        )
        texture = builder.texture(baked[rows, columns])
        corner = start + left * along
        across = (*((right - left) * along), 0.0)
        builder.quad((*corner, top), across, (0.0, 0.0, bottom - top), texture)


def _openings(
    start: NDArray[np.float64], along: NDArray[np.float64], length: float
) -> list[tuple[float, float]]:
    """Where along a wall doorways touch it, from left to right [m]."""
    found = []
    for doorway in DOORWAYS:
        corners = np.array([(x, y) for x in doorway.x for y in doorway.y])
        forward = (corners - start) @ along
        sideways = (corners - start) @ np.array([-along[1], along[0]])
        touches = np.min(np.abs(sideways)) < 1e-6 and forward.min() > 0 and forward.max() < length
        if touches and np.ptp(forward) > np.ptp(sideways):
            found.append((float(forward.min()), float(forward.max())))
    return sorted(found)


def _add_doorway(builder: Builder, doorway: Doorway, rng: np.random.Generator) -> None:
    """Threshold, jambs and lintel; wooden, standing out of the wall a little."""
    wood = textures.weathered(textures.resized(textures.photo('wood_1'), 60, 440), rng, 0.2)
    texture = builder.texture(wood)
    (x0, x1), (y0, y1) = doorway.x, doorway.y
    trim, middle = 0.06, DOOR_HEIGHT / 2
    faces = {'any': texture}
    centre = ((x0 + x1) / 2, (y0 + y1) / 2)
    if x1 - x0 > y1 - y0:
        deep = y1 - y0 + 0.06
        for x in (x0 + trim / 2, x1 - trim / 2):
            builder.box((x, centre[1], middle), (trim, deep, DOOR_HEIGHT), faces)
        lintel = (x1 - x0, deep, trim)
    else:
        deep = x1 - x0 + 0.06
        for y in (y0 + trim / 2, y1 - trim / 2):
            builder.box((centre[0], y, middle), (deep, trim, DOOR_HEIGHT), faces)
        lintel = (deep, y1 - y0, trim)
    builder.box((*centre, DOOR_HEIGHT - trim / 2), lintel, faces)
    builder.box((*centre, 0.0), (x1 - x0, y1 - y0, 0.012), faces)


def add_lamp_panels(builder: Builder, lamps: Sequence[tuple[float, float, float]]) -> None:
    """Bright panels under the ceiling at every lamp."""
    panel = np.full((48, 48, 3), 245, np.uint8)
    panel[::12] = panel[:, ::12] = 205
    texture = builder.texture(panel)
    grate = builder.texture(textures.resized(textures.photo('airduct_grate_1'), 120, 120))
    for x, y, _ in lamps:
        builder.quad((x - 0.3, y - 0.3, ROOM_HEIGHT - 0.01), (0.6, 0, 0), (0, 0.6, 0), texture, 0.9)
        builder.quad((x + 0.9, y - 0.2, ROOM_HEIGHT - 0.02), (0.4, 0, 0), (0, 0.4, 0), grate)


def hang(
    builder: Builder,
    texture: int,
    room: Room,
    side: str,
    along: float,
    size: tuple[float, float],
    height: float = 1.4,
) -> None:
    """Hangs a picture on a wall.

    Args:
        builder: Takes the quads.
        texture: The picture.
        room: Whose wall.
        side: `north`, `east`, `south` or `west`.
        along: x (north and south) or y (east and west) of the picture's middle [m].
        size: Width and height [m].
        height: Of its middle above the floor [m].
    """
    thickness = 0.035
    wall, degrees = {
        'north': (room.y[1], -90.0),
        'south': (room.y[0], 90.0),
        'east': (room.x[1], 180.0),
        'west': (room.x[0], 0.0),
    }[side]
    inward = Rotation.from_euler('z', degrees, degrees=True)
    foot = (along, wall) if side in {'north', 'south'} else (wall, along)
    centre = np.array((*foot, height)) + inward.apply((thickness / 2, 0.0, 0.0))
    faces = {'+x': texture, '+y': texture, '-y': texture, '+z': texture}
    builder.box(centre, (thickness, *size), faces, inward)


def _gallery_wall(
    builder: Builder,
    prints: _Prints,
    room: Room,
    side: str,
    places: Sequence[float],
) -> None:
    """Paintings of varied sizes along a wall, small ones in pairs above each other."""
    for index, along in enumerate(places):
        if index % 3 == 1:
            for height in (1.05, 1.75):
                hang(builder, prints.next_painting(), room, side, along, (0.55, 0.55), height)
        else:
            side_length = 0.75 if index % 3 == 0 else 0.95
            size = (side_length, side_length)
            hang(builder, prints.next_painting(), room, side, along, size, 1.45)


def _table(
    builder: Builder, prints: _Prints, centre: tuple[float, float], size: tuple[float, float]
) -> None:
    """A table 0.74 m high on two panels."""
    x, y = centre
    wood = prints.materials['wood_1']
    faces = {'any': wood, '+z': prints.materials['wood_2']}
    builder.box((x, y, 0.72), (*size, 0.04), faces)
    for sign in (-1, 1):
        builder.box((x + sign * (size[0] / 2 - 0.06), y, 0.35), (0.04, size[1] - 0.1, 0.7), faces)


def _chair(builder: Builder, prints: _Prints, place: tuple[float, float], heading: float) -> None:
    """One of many identical chairs; `heading` [rad] is where the one who sits looks."""
    turn = Rotation.from_euler('z', heading)
    wood, back = prints.materials['wood_planks_1'], prints.materials['metal_grill_1']
    parts = (
        ((0.0, 0.0, 0.44), (0.42, 0.42, 0.05), {'any': wood}),
        ((-0.2, 0.0, 0.7), (0.04, 0.42, 0.5), {'any': wood, '+x': back, '-x': back}),
        ((0.0, 0.18, 0.21), (0.36, 0.04, 0.42), {'side': wood}),
        ((0.0, -0.18, 0.21), (0.36, 0.04, 0.42), {'side': wood}),
    )
    for centre, size, faces in parts:
        builder.box(np.array((*place, 0.0)) + turn.apply(centre), size, faces, turn)


def _bookshelf(
    builder: Builder, prints: _Prints, centre: tuple[float, float], degrees: float, first: int
) -> None:
    """A shelf 1.2 m wide and 1.9 m high, five rows of books; its back is at its -x side."""
    turn = Rotation.from_euler('z', degrees, degrees=True)
    wood = prints.materials['wood_2']
    place = np.array((*centre, 0.0))
    for side in (-0.59, 0.59):
        builder.box(place + turn.apply((0, side, 0.95)), (0.3, 0.03, 1.9), {'any': wood}, turn)
    for row in range(6):
        builder.box(
            place + turn.apply((0, 0, 0.03 + 0.37 * row)), (0.3, 1.15, 0.03), {'any': wood}, turn
        )
    for row in range(5):
        books = prints.books[(first + row) % len(prints.books)]
        builder.box(
            place + turn.apply((-0.04, 0, 0.21 + 0.37 * row)),
            (0.2, 1.15, 0.33),
            {'+x': books},
            turn,
        )


def _stack_cartons(
    builder: Builder,
    prints: _Prints,
    rng: np.random.Generator,
    foot: tuple[float, float, float],
    count: int,
) -> None:
    """Cartons on top of each other, each turned a little."""
    x, y, z = foot
    for _ in range(count):
        size = rng.uniform((0.3, 0.3, 0.22), (0.46, 0.46, 0.38))
        faces = {
            name: prints.cartons[int(rng.integers(len(prints.cartons)))]
            for name in ('+x', '-x', '+y', '-y')
        }
        faces['+z'] = prints.materials['cardboard_1']
        turn = Rotation.from_euler('z', rng.normal(0, 0.25))
        builder.box((x, y, z + size[2] / 2), size, faces, turn)
        z += size[2]


def _clutter(
    builder: Builder,
    prints: _Prints,
    rng: np.random.Generator,
    area: tuple[float, float, float, float, float],
    count: int,
) -> None:
    """Small boxes at random attitudes.

    Args:
        builder: Takes the quads.
        prints: What is printed on the boxes.
        rng: Chooses places.
        area: x0, y0, x1, y1 and height of the surface they lie on [m].
        count: How many.
    """
    x0, y0, x1, y1, z = area
    for _ in range(count):
        size = rng.uniform(0.07, 0.2, 3)
        pictures = rng.choice([*prints.photographs, *prints.cartons, *prints.pages], 3)
        faces = {'side': int(pictures[0]), '+z': int(pictures[1]), 'any': int(pictures[2])}
        tilt = rng.normal(0, 0.35, 2)
        turn = Rotation.from_euler('zyx', (rng.uniform(0, 2 * np.pi), *tilt))
        centre = (rng.uniform(x0, x1), rng.uniform(y0, y1), z + 0.55 * size[2])
        builder.box(centre, size, faces, turn)


def _lay(
    builder: Builder, texture: int, centre: tuple[float, float, float], size: tuple[float, float]
) -> None:
    """Lays a sheet or a rug flat on a surface."""
    x, y, z = centre
    builder.quad((x - size[0] / 2, y + size[1] / 2, z), (size[0], 0, 0), (0, -size[1], 0), texture)


def _furnish_office(builder: Builder, prints: _Prints, loose: np.random.Generator) -> None:
    room = OFFICE
    _gallery_wall(builder, prints, room, 'west', (6.1, 7.2, 8.3))
    hang(builder, prints.window, room, 'north', 1.5, (1.7, 1.25), 1.55)
    hang(builder, prints.boards[0], room, 'north', 3.5, (1.6, 1.05), 1.5)
    hang(builder, prints.window, room, 'north', 5.5, (1.7, 1.25), 1.55)
    hang(builder, prints.posters[0], room, 'east', 6.2, (0.62, 0.9))
    hang(builder, prints.paintings[0], room, 'east', 8.4, (0.7, 0.7))
    hang(builder, prints.boards[1], room, 'south', 3.6, (1.4, 0.95), 1.45)
    hang(builder, prints.posters[1], room, 'south', 0.8, (0.66, 0.96))
    hang(builder, prints.posters[2], room, 'south', 6.35, (0.66, 0.96))
    _bookshelf(builder, prints, (4.9, 5.7), 90.0, 0)
    _bookshelf(builder, prints, (0.18, 6.7), 0.0, 3)
    _lay(builder, prints.rugs[0], (3.6, 7.0, 0.008), (2.9, 1.9))
    for x in (1.3, 3.6, 5.6):
        _table(builder, prints, (x, 8.55), (1.5, 0.75))
        _clutter(builder, prints, loose, (x - 0.6, 8.35, x + 0.6, 8.85, 0.74), 7)
        for page in range(3):
            place = (x + loose.uniform(-0.6, 0.6), loose.uniform(8.3, 8.6), 0.744 + 0.001 * page)
            _lay(builder, prints.pages[int(loose.integers(8))], place, (0.21, 0.29))
        _chair(builder, prints, (x + loose.normal(0, 0.1), 8.05), np.pi / 2 + loose.normal(0, 0.3))
    _chair(builder, prints, (0.75, 7.5 + loose.normal(0, 0.1)), loose.uniform(0, 6))
    _stack_cartons(builder, prints, loose, (0.4, 5.9, 0.0), 4)
    _stack_cartons(builder, prints, loose, (6.5, 5.95, 0.0), 3)
    _clutter(builder, prints, loose, (3.2, 5.75, 4.1, 5.9, 0.0), 6)


def _furnish_gallery(builder: Builder, prints: _Prints, loose: np.random.Generator) -> None:
    room = GALLERY
    _gallery_wall(builder, prints, room, 'north', (7.6, 8.6, 9.6, 10.8, 11.8, 12.9))
    _gallery_wall(builder, prints, room, 'east', (6.2, 7.3, 8.4))
    _gallery_wall(builder, prints, room, 'south', (7.7, 8.8, 9.9, 13.2))
    hang(builder, prints.paintings[0], room, 'west', 8.45, (0.7, 0.7))
    hang(builder, prints.posters[3], room, 'west', 6.2, (0.66, 0.96))
    hang(builder, prints.paintings[1], room, 'south', 10.75, (0.55, 0.55))
    _lay(builder, prints.rugs[1], (9.3, 7.2, 0.008), (2.9, 1.9))
    for x, y in ((7.6, 8.5), (13.5, 8.5), (13.5, 6.1)):
        faces = {'side': prints.materials['marble_2'], 'any': prints.materials['marble_1']}
        builder.box((x, y, 0.45), (0.45, 0.45, 0.9), faces)
        _clutter(builder, prints, loose, (x - 0.08, y - 0.08, x + 0.08, y + 0.08, 0.9), 3)
    bench = {'any': prints.materials['wood_planks_1']}
    for x in (9.2, 12.3):
        builder.box((x, 8.55, 0.22), (1.5, 0.4, 0.44), bench)
        _clutter(builder, prints, loose, (x - 0.6, 8.45, x + 0.6, 8.65, 0.44), 4)
    builder.box((8.6, 5.85, 0.22), (1.5, 0.4, 0.44), bench)
    _clutter(builder, prints, loose, (8.0, 5.8, 9.2, 5.9, 0.44), 4)
    _chair(builder, prints, (13.2, 7.3 + loose.normal(0, 0.1)), np.pi + loose.normal(0, 0.4))
    _chair(builder, prints, (10.4, 5.95), np.pi / 2 + loose.normal(0, 0.4))
    _stack_cartons(builder, prints, loose, (7.4, 5.9, 0.0), 2)


def _furnish_workshop(builder: Builder, prints: _Prints, loose: np.random.Generator) -> None:
    room = WORKSHOP
    hang(builder, prints.garage, room, 'west', 1.75, (2.3, 2.1), 1.06)
    hang(builder, prints.boards[2], room, 'south', 4.3, (1.6, 1.05), 1.5)
    _gallery_wall(builder, prints, room, 'south', (8.9, 9.9, 10.9))
    hang(builder, prints.posters[4], room, 'south', 5.6, (0.66, 0.96))
    hang(builder, prints.posters[5], room, 'south', 7.9, (0.66, 0.96))
    hang(builder, prints.boards[3], room, 'east', 1.9, (1.6, 1.05), 1.6)
    hang(builder, prints.posters[6], room, 'east', 0.6, (0.62, 0.9))
    _gallery_wall(builder, prints, room, 'north', (3.7, 4.8, 5.8))
    hang(builder, prints.posters[7], room, 'north', 8.2, (0.66, 0.96))
    hang(builder, prints.posters[0], room, 'north', 9.2, (0.66, 0.96))
    hang(builder, prints.window, room, 'north', 10.5, (1.3, 1.0), 1.55)
    _table(builder, prints, (7.4, 1.72), (2.2, 0.7))
    _clutter(builder, prints, loose, (6.5, 1.5, 8.3, 1.95, 0.74), 14)
    _clutter(builder, prints, loose, (6.6, 1.6, 8.2, 1.85, 0.0), 6)
    _bookshelf(builder, prints, (6.7, 0.17), 90.0, 5)
    _bookshelf(builder, prints, (9.9, 3.3), -90.0, 1)
    for x, y, count in (
        (3.35, 0.35, 4), (3.35, 3.1, 3), (3.9, 3.15, 2), (11.1, 0.4, 4), (11.15, 3.1, 5),
        (11.15, 2.55, 3), (8.7, 3.2, 2), (5.3, 3.2, 3),
    ):  # fmt: skip
        _stack_cartons(builder, prints, loose, (x, y, 0.0), count)
    _chair(builder, prints, (11.0, 1.3 + loose.normal(0, 0.1)), np.pi + loose.normal(0, 0.4))


def _furnish_corridor(builder: Builder, prints: _Prints, loose: np.random.Generator) -> None:
    room = CORRIDOR
    doors = prints.doors
    for side, along, name in (
        ('south', 1.6, 'door_steel_grey'), ('south', 12.6, 'door_steel_grey'),
        ('north', 4.2, 'door_steel_grey'), ('north', 9.0, 'door_steel_grey'),
        ('south', 4.6, 'door_steel_brown'), ('south', 9.4, 'door_steel_brown'),
        ('west', 4.5, 'door_steel_red'),
    ):  # fmt: skip
        hang(builder, doors[name], room, side, along, (0.95, 2.08), 1.05)
    hang(builder, prints.window, room, 'east', 4.5, (1.3, 1.0), 1.55)
    for side, along, picture in (
        ('north', 0.8, prints.posters[8]), ('north', 3.2, prints.posters[9]),
        ('north', 13.2, prints.posters[1]), ('south', 0.6, prints.posters[2]),
        ('south', 5.7, prints.posters[6]), ('south', 13.5, prints.posters[8]),
    ):  # fmt: skip
        hang(builder, picture, room, side, along, (0.62, 0.9))
    hang(builder, prints.boards[3], room, 'north', 5.8, (1.5, 1.0), 1.45)
    hang(builder, prints.boards[0], room, 'south', 11.0, (1.5, 1.0), 1.45)
    _gallery_wall(builder, prints, room, 'south', (2.7, 3.5))
    _gallery_wall(builder, prints, room, 'north', (7.1, 7.95, 10.2))
    hang(builder, prints.paintings[1], room, 'south', 8.3, (0.7, 0.7))
    builder.box((8.3, 3.78, 0.22), (1.2, 0.34, 0.44), {'any': prints.materials['wood_planks_1']})
    _clutter(builder, prints, loose, (7.9, 3.72, 8.7, 3.84, 0.44), 4)
    _stack_cartons(builder, prints, loose, (13.7, 5.1, 0.0), 3)
    _stack_cartons(builder, prints, loose, (13.65, 3.9, 0.0), 2)
    _stack_cartons(builder, prints, loose, (0.3, 3.9, 0.0), 3)
    _stack_cartons(builder, prints, loose, (0.28, 5.15, 0.0), 2)
    _stack_cartons(builder, prints, loose, (3.4, 5.17, 0.0), 2)
