# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Virtual arrows, and the file that they are kept in."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from gam_relocalizer.errors import UsageError
from gam_relocalizer.geometry import write_text

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

MAX_ARROWS = 1000
MAX_ARROWS_BYTES = 2**20

_KEYS = ('position', 'direction', 'length', 'colour')
_COLOUR = re.compile(r'#[0-9a-fA-F]{6}')


@dataclass(frozen=True)
class Arrow:
    """A virtual object of the map.

    Attributes:
        position: Its tail, map frame [map units].
        direction: Where it points, map frame; of any length but zero.
        length: From tail to tip [map units].
        colour: `#rrggbb`.
    """

    position: tuple[float, float, float]
    direction: tuple[float, float, float]
    length: float
    colour: str

    @property
    def tail(self) -> NDArray[np.float64]:
        """[3], map frame."""
        return np.array(self.position)

    @property
    def tip(self) -> NDArray[np.float64]:
        """[3], map frame."""
        return self.tail + self.length * np.array(self.direction) / math.hypot(*self.direction)

    @property
    def rgb(self) -> tuple[int, int, int]:
        """The colour, 0 to 255."""
        red, green, blue = bytes.fromhex(self.colour[1:])
        return red, green, blue


def read_arrows(path: Path) -> tuple[Arrow, ...]:
    """Reads a YAML list of arrows, each with position, direction, length and colour.

    Raises:
        UsageError: Missing, too large, no YAML, or not such a list.
    """
    entries = _read_yaml(path)
    if not isinstance(entries, list) or not entries:
        msg = f'{path}: expected a list of arrows, each with {", ".join(_KEYS)}'
        raise UsageError(msg)
    if len(entries) > MAX_ARROWS:
        msg = f'{path}: {len(entries)} arrows are more than {MAX_ARROWS}'
        raise UsageError(msg)
    return tuple(
        _arrow_from(entry, f'{path}: arrow {number}') for number, entry in enumerate(entries, 1)
    )


def write_arrows(path: Path, arrows: Sequence[Arrow]) -> None:
    """Writes a file that `read_arrows` reads."""
    entries = [
        {
            'position': [*arrow.position],
            'direction': [*arrow.direction],
            'length': arrow.length,
            'colour': arrow.colour,
        }
        for arrow in arrows
    ]
    head = '# Tails, directions and lengths of arrows in the frame of the map; edit, and pass in\n'
    head += '# again with --arrows.\n'
    write_text(path, head + yaml.safe_dump(entries, sort_keys=False, default_flow_style=None))


def _read_yaml(path: Path) -> Any:  # noqa: ANN401 - whatever is in the file
    try:
        size = path.stat().st_size
        if size > MAX_ARROWS_BYTES:
            msg = f'{path}: {size} bytes are more than {MAX_ARROWS_BYTES}; this is no arrows file'
            raise UsageError(msg)
        return yaml.safe_load(path.read_text(encoding='utf-8'))
    except FileNotFoundError as err:
        msg = f'{path}: no such arrows file'
        raise UsageError(msg) from err
    except (OSError, ValueError, yaml.YAMLError, RecursionError) as err:
        msg = f'{path}: cannot be read as YAML: {err}'
        raise UsageError(msg) from err


def _arrow_from(entry: Any, where: str) -> Arrow:  # noqa: ANN401 - whatever is in the file
    if not isinstance(entry, dict) or set(entry) != set(_KEYS):
        found = ', '.join(map(str, entry)) if isinstance(entry, dict) else type(entry).__name__
        msg = f'{where}: expected {", ".join(_KEYS)}, found {found[:80]}'
        raise UsageError(msg)
    position = _vector(entry['position'], f'{where}: position')
    direction = _vector(entry['direction'], f'{where}: direction')
    length = _number(entry['length'], f'{where}: length')
    colour = entry['colour']
    if math.hypot(*direction) < 1e-9:
        msg = f'{where}: the direction is zero; expected where the arrow points, as [1, 0, 0]'
        raise UsageError(msg)
    if length <= 0.0:
        msg = f'{where}: the length is {length}; expected more than 0'
        raise UsageError(msg)
    if not isinstance(colour, str) or not _COLOUR.fullmatch(colour):
        msg = f"{where}: the colour is {str(colour)[:20]}; expected one in quotes, as '#e4572e'"
        raise UsageError(msg)
    return Arrow(position, direction, length, colour)


def _vector(value: Any, where: str) -> tuple[float, float, float]:  # noqa: ANN401
    if not isinstance(value, list) or len(value) != 3:
        msg = f'{where}: expected [x, y, z], found {str(value)[:80]}'
        raise UsageError(msg)
    x, y, z = (_number(each, where) for each in value)
    return x, y, z


def _number(value: Any, where: str) -> float:  # noqa: ANN401 - whatever is in the file
    # beyond that no arrow is in view, and products overflow; True is an int to Python
    usable = isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e9
    if not usable:
        msg = f'{where}: expected a number, found {str(value)[:80]}'
        raise UsageError(msg)
    return float(value)
