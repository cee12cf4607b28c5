# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What a map's manifest and points tell of it, for people; the manifest may hold anything."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import takewhile
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from gam_relocalizer.scene_map import SFM

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from numpy.typing import NDArray

    from gam_relocalizer.scene_map import Manifest, SceneMap

RUN_TIME = 'run time'
_T = TypeVar('_T')
_TEXT_LENGTH = 200
_MOST_DEPTH = 20
_MOST_VALUES = 1_000_000


def number_in(mapping: Mapping[str, Any], name: str) -> float | None:
    """A finite number of a mapping that came from a file, or nothing."""
    value = mapping.get(name)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        return None
    return float(value)


def text_of(value: object) -> str:
    """A value of a file in one line of characters that do nothing to a terminal."""
    text = str(value) if isinstance(value, (str, bool, int, float)) else repr(plain(value))
    shown = ''.join(one if one.isprintable() else '?' for one in text[: _TEXT_LENGTH + 1])
    return shown if len(shown) <= _TEXT_LENGTH else f'{shown[: _TEXT_LENGTH - 3]}...'


def plain(value: object) -> Any:  # noqa: ANN401 - any JSON value
    """A value of a YAML file as JSON has them.

    YAML knows dates, keys of any kind, and lists that hold themselves or each other a million times
    over: what is too deep or too much becomes `...`.
    """
    return _plain(value, 0, _Budget(_MOST_VALUES))


def mapping_in(mapping: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """A mapping of a mapping that came from a file; empty where there is none."""
    value = mapping.get(name)
    return value if isinstance(value, dict) else {}


def bytes_per_point(manifest: Manifest) -> dict[str, float]:
    """Bytes for each point of all that is needed at run time, and of the COLMAP model."""
    by_file = bytes_per_point_by_file(manifest)
    model = sum(size for name, size in by_file.items() if name.startswith(f'{SFM}/'))
    return {RUN_TIME: sum(by_file.values()) - model, SFM: model}


def bytes_per_point_by_file(manifest: Manifest) -> dict[str, float]:
    """Bytes for each point by file, the largest first."""
    points = max(manifest.counts['points'], 1)
    sizes = {name: entry.size / points for name, entry in manifest.files.items()}
    return dict(sorted(sizes.items(), key=lambda entry: -entry[1]))


def bounds_of(scene_map: SceneMap) -> dict[str, dict[str, list[float]]]:
    """Where a map lies: the box of its cameras, and that of all its points but the outermost 4 %.

    Returns:
        `cameras` and `points`, each with `low`, `high` and `extent` [3], map frame.
    """
    places = {
        'cameras': _box(scene_map.camera_positions, 0.0),
        'points': _box(scene_map.points, 0.02),
    }
    return {name: box for name, box in places.items() if box}


def _box(places: NDArray[np.float64], margin: float) -> dict[str, list[float]]:
    if not len(places):
        return {}
    low, high = np.quantile(places, [margin, 1.0 - margin], axis=0)
    return {'low': low.tolist(), 'high': high.tolist(), 'extent': (high - low).tolist()}


@dataclass
class _Budget:
    """How many values may still be copied."""

    left: int


def _plain(value: object, depth: int, budget: _Budget) -> Any:  # noqa: ANN401 - any JSON value
    budget.left -= 1
    if budget.left < 0 or depth > _MOST_DEPTH:
        return '...'
    if isinstance(value, dict):
        return {
            text_of(name) if isinstance(name, (str, int, float)) else '...': _plain(
                entry, depth + 1, budget
            )
            for name, entry in _some(value.items(), budget)
        }
    if isinstance(value, (list, tuple)):
        return [_plain(entry, depth + 1, budget) for entry in _some(value, budget)]
    if value is None or isinstance(value, (str, bool, int)):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    return str(value)


def _some(values: Iterable[_T], budget: _Budget) -> Iterator[_T]:
    return takewhile(lambda _: budget.left > 0, values)
