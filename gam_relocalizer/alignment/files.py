# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The text files that alignments are made from: one line per thing, `#` comments, UTF-8.

Names may hold spaces; only where a line has two of them such names stand in quotes.
"""

from __future__ import annotations

import math
import shlex
from typing import TYPE_CHECKING

from gam_relocalizer.alignment.constraints import Distance, MarkerPlace, Place
from gam_relocalizer.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from gam_relocalizer.alignment.constraints import Triple

MAX_BYTES = 64 * 2**20
# A typing error, and not what a tape measure shows.
MIN_METRES, MAX_METRES = 1e-6, 1e9


def read_positions(path: Path) -> dict[str, Triple]:
    """Reads lines `name x y z`.

    Raises:
        UsageError: Missing file, malformed line, number that is not finite, or a name twice.
    """
    return {name: (x, y, z) for name, (x, y, z) in _by_name(path, 'name x y z').items()}


def read_gps(path: Path) -> dict[str, Triple]:
    """Reads lines `name latitude longitude altitude` (degrees, degrees, metres).

    Raises:
        UsageError: As `read_positions`, or angles that are on no globe.
    """
    fixes: dict[str, Triple] = {}
    for name, (latitude, longitude, altitude) in _by_name(
        path, 'name latitude longitude altitude'
    ).items():
        check_geodetic((latitude, longitude, altitude), f'{path}: {name}')
        fixes[name] = (latitude, longitude, altitude)
    return fixes


def read_pixels(path: Path) -> dict[str, tuple[float, float]]:
    """Reads lines `name column row`.

    Raises:
        UsageError: As `read_positions`.
    """
    given = _by_name(path, 'name column row')
    return {name: (column, row) for name, (column, row) in given.items()}


def read_distances(path: Path) -> list[Distance]:
    """Reads lines `A B metres`; A and B are `name` or `name@column,row`.

    Raises:
        UsageError: Missing file, malformed line, or a distance that nothing has.
    """
    expected = 'A B metres'
    distances = []
    for where, line in _lines(path, expected):
        try:
            words = shlex.split(line)
        except ValueError as err:
            msg = f'{where}: {err} in `{line[:80]}`'
            raise UsageError(msg) from err
        if len(words) != 3:
            raise _malformed(where, f'{expected}` (names with spaces in quotes', line)
        (metres,) = _numbers(words[2:], where)
        if not MIN_METRES <= metres <= MAX_METRES:
            msg = (
                f'{where}: a distance of {metres:g} m; expected metres, from {MIN_METRES:g} to '
                f'{MAX_METRES:g}'
            )
            raise UsageError(msg)
        first, second = (_place(word, where) for word in words[:2])
        if first == second:
            msg = f'{where}: a distance from `{words[0]}` to itself'
            raise UsageError(msg)
        distances.append(Distance(first, second, metres))
    return distances


def read_marker_places(path: Path) -> dict[int, MarkerPlace]:
    """Reads lines `id x y z` or `id x y z qw qx qy qz` (centre, map_from_marker).

    Raises:
        UsageError: Missing file, malformed line, or an id twice.
    """
    expected = 'id x y z` or `id x y z qw qx qy qz'
    places: dict[int, MarkerPlace] = {}
    for where, line in _lines(path, expected):
        words = line.split()
        if len(words) not in {4, 8} or not words[0].isdecimal():
            raise _malformed(where, expected, line)
        x, y, z, *quaternion = _numbers(words[1:], where)
        marker = int(words[0])
        if marker in places:
            msg = f'{where}: marker {marker} has a second place'
            raise UsageError(msg)
        if not quaternion:
            places[marker] = MarkerPlace((x, y, z))
            continue
        qw, qx, qy, qz = quaternion
        if math.hypot(*quaternion) < 1e-6:
            msg = f'{where}: the quaternion is zero'
            raise UsageError(msg)
        places[marker] = MarkerPlace((x, y, z), (qw, qx, qy, qz))
    return places


def check_geodetic(place: Triple, where: str) -> None:
    """Refuses what is no latitude [deg], longitude [deg] and altitude [m].

    Raises:
        UsageError: With what was expected.
    """
    latitude, longitude, altitude = place
    known = math.isfinite(latitude) and math.isfinite(longitude) and math.isfinite(altitude)
    if not known or abs(latitude) > 90.0 or abs(longitude) > 180.0:
        msg = (
            f'{where}: latitude {latitude:g}, longitude {longitude:g}, altitude {altitude:g} is no '
            f'place; expected degrees within 90 and 180, then metres'
        )
        raise UsageError(msg)


def _by_name(path: Path, expected: str) -> dict[str, list[float]]:
    """Lines of a name, which may hold spaces, and some numbers."""
    count = len(expected.split()) - 1
    given: dict[str, list[float]] = {}
    for where, line in _lines(path, expected):
        words = line.rsplit(maxsplit=count)
        if len(words) != count + 1:
            raise _malformed(where, expected, line)
        if words[0] in given:
            msg = f'{where}: `{words[0]}` is given a second time'
            raise UsageError(msg)
        given[words[0]] = _numbers(words[1:], where)
    return given


def _lines(path: Path, expected: str) -> Iterator[tuple[str, str]]:
    """Where each line stands, and what it says."""
    if not path.is_file():
        msg = f'{path}: no such file'
        raise UsageError(msg)
    if path.stat().st_size > MAX_BYTES:
        msg = f'{path}: larger than {MAX_BYTES} bytes; expected lines `{expected}`'
        raise UsageError(msg)
    try:
        text = path.read_text(encoding='utf-8-sig')
    except (OSError, UnicodeDecodeError) as err:
        msg = f'{path}: cannot be read as UTF-8 text: {err}'
        raise UsageError(msg) from err
    empty = True
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip() and not line.lstrip().startswith('#'):
            empty = False
            yield f'{path}:{number}', line.strip()
    if empty:
        msg = f'{path}: nothing in it; expected lines `{expected}`'
        raise UsageError(msg)


def _place(word: str, where: str) -> Place:
    image, at, pixel = word.rpartition('@')
    if not at:
        return Place(word)
    numbers = pixel.split(',')
    if len(numbers) != 2 or not image:
        raise _malformed(where, 'name@column,row', word)
    column, row = _numbers(numbers, where)
    return Place(image, (column, row))


def _numbers(words: Sequence[str], where: str) -> list[float]:
    try:
        numbers = [float(word) for word in words]
    except ValueError as err:
        msg = f'{where}: not a number: {err}'
        raise UsageError(msg) from err
    if not all(math.isfinite(number) for number in numbers):
        msg = f'{where}: a number is not finite'
        raise UsageError(msg)
    return numbers


def _malformed(where: str, expected: str, line: str) -> UsageError:
    return UsageError(f'{where}: expected `{expected}`, found `{line[:80]}`')
