# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from gam_relocalizer.alignment.constraints import Distance, MarkerPlace, Place
from gam_relocalizer.alignment.files import (
    read_distances,
    read_gps,
    read_marker_places,
    read_pixels,
    read_positions,
)
from gam_relocalizer.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

READERS = {
    read_positions: 'a.png 1 2 3',
    read_gps: 'a.png 48.1 11.5 520',
    read_pixels: 'a.png 10 20',
    read_distances: 'a.png b.png 2.5',
    read_marker_places: '7 1 2 3',
}


def test_names_may_hold_spaces_and_lines_comments(tmp_path: Path) -> None:
    file = tmp_path / 'positions.txt'
    file.write_text('\ufeff# surveyed\n\nmy view 1.png 1 2e0 -3.5\r\n', encoding='utf-8')

    assert read_positions(file) == {'my view 1.png': (1.0, 2.0, -3.5)}


def test_places_of_a_distance_are_images_or_pixels_in_them(tmp_path: Path) -> None:
    file = tmp_path / 'distances.txt'
    file.write_text('"view 1.png" b@home.png@10.5,20 2.5\n')

    first, second = Place('view 1.png'), Place('b@home.png', (10.5, 20.0))
    assert read_distances(file) == [Distance(first, second, 2.5)]


def test_markers_have_a_centre_and_perhaps_an_orientation(tmp_path: Path) -> None:
    file = tmp_path / 'markers.txt'
    file.write_text('7 1 2 3\n9 1 2 3 1 0 0 0\n')

    places = {7: MarkerPlace((1, 2, 3)), 9: MarkerPlace((1, 2, 3), (1, 0, 0, 0))}
    assert read_marker_places(file) == places


@pytest.mark.parametrize('metres', ['0', '-2', '1e300', '1e-300'])
def test_a_distance_that_nothing_has_is_refused(metres: str, tmp_path: Path) -> None:
    file = tmp_path / 'distances.txt'
    file.write_text(f'a.png b.png {metres}\n')

    with pytest.raises(UsageError, match=':1: a distance'):
        read_distances(file)


@pytest.mark.parametrize('read', READERS)
@pytest.mark.parametrize('spoil', ['1 2', '{} x', '{} nan'])
def test_a_malformed_line_is_named(
    read: Callable[[Path], object], spoil: str, tmp_path: Path
) -> None:
    line = spoil.format(READERS[read].rpartition(' ')[0])
    (tmp_path / 'given.txt').write_text(f'# head\n{line}\n')

    with pytest.raises(UsageError, match=r'given\.txt:2'):
        read(tmp_path / 'given.txt')


@pytest.mark.parametrize('read', [read_positions, read_gps, read_pixels, read_marker_places])
def test_a_name_given_twice_is_refused(read: Callable[[Path], object], tmp_path: Path) -> None:
    (tmp_path / 'given.txt').write_text(f'{READERS[read]}\n{READERS[read]}\n')

    with pytest.raises(UsageError, match=r'given\.txt:2'):
        read(tmp_path / 'given.txt')


@pytest.mark.parametrize('read', READERS)
def test_missing_empty_and_undecodable_files_are_refused(
    read: Callable[[Path], object], tmp_path: Path
) -> None:
    (tmp_path / 'empty.txt').write_text('# nothing\n')
    (tmp_path / 'binary.txt').write_bytes(b'\xff\xfe\x00 1 2 3')

    for name in ('nowhere.txt', 'empty.txt', 'binary.txt'):
        with pytest.raises(UsageError, match=name):
            read(tmp_path / name)


@pytest.mark.parametrize('line', ['a.png 91 11 520', 'a.png 48 181 520'])
def test_degrees_that_are_on_no_globe_are_refused(line: str, tmp_path: Path) -> None:
    (tmp_path / 'gps.txt').write_text(line)

    with pytest.raises(UsageError, match=r'a\.png'):
        read_gps(tmp_path / 'gps.txt')


@pytest.mark.parametrize(
    'line', ['a.png b.png 0', 'a.png b.png -1', 'a.png a.png 2', 'a.png@1 b.png 2', '"a.png b 2']
)
def test_distances_that_cannot_be_are_refused(line: str, tmp_path: Path) -> None:
    (tmp_path / 'distances.txt').write_text(line)

    with pytest.raises(UsageError, match=r'distances\.txt:1'):
        read_distances(tmp_path / 'distances.txt')
