# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What a map can be aligned with: one class per method."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    import pycolmap

    from gam_relocalizer.alignment.occupancy import OccupancyMap

Triple: TypeAlias = tuple[float, float, float]


@dataclass(frozen=True)
class Poses:
    """Where reference images were taken, and how the camera was turned.

    Attributes:
        camera_from_world: By image name, metres; COLMAP's camera (x right, y down, z forward).
            The map's frame becomes that world.
    """

    camera_from_world: Mapping[str, pycolmap.Rigid3d]


@dataclass(frozen=True)
class Positions:
    """Where reference images were taken.

    Attributes:
        positions: x, y, z by image name [m]. The map's frame becomes theirs.
        level: Take the up direction (their z) from the cameras and the floor, and of the heights
            only their median.
    """

    positions: Mapping[str, Triple]
    level: bool = False


@dataclass(frozen=True)
class GpsFixes:
    """Where on earth reference images were taken.

    Attributes:
        fixes: Latitude, longitude [deg], altitude above the ellipsoid WGS 84 [m] by image name.
        datum: The same three numbers of the map's origin; None takes the median fix. The map's
            axes are east, north and up there.
        level: As for `Positions`: altitudes then give no more than the height of the origin.
    """

    fixes: Mapping[str, Triple]
    datum: Triple | None = None
    level: bool = False


@dataclass(frozen=True)
class Place:
    """A place that can be pointed at in the map.

    Attributes:
        image: A reference image.
        pixel: Column and row in it, COLMAP's (the centre of the first pixel is 0.5, 0.5), that
            shows the place; None is the place of the camera itself.
    """

    image: str
    pixel: tuple[float, float] | None = None


@dataclass(frozen=True)
class Distance:
    """A measured distance between two places [m]."""

    first: Place
    second: Place
    metres: float


@dataclass(frozen=True)
class Distances:
    """Distances that somebody measured: they give the scale and nothing else.

    Attributes:
        distances: One at least; errors show from two on, mistakes from three on.
        level: Level the map as well.
    """

    distances: Sequence[Distance]
    level: bool = False


@dataclass(frozen=True)
class MarkerPlace:
    """Where a marker hangs.

    Attributes:
        centre: Of the print, map frame [m].
        map_from_marker_wxyz: Its orientation, where known: x to the right and y to the top of the
            print, z out of it towards the beholder.
    """

    centre: Triple
    map_from_marker_wxyz: tuple[float, float, float, float] | None = None


@dataclass(frozen=True)
class Markers:
    """Printed square markers that the reference images show.

    Attributes:
        size: Side of the black square [m].
        dictionary: OpenCV's name, such as `DICT_4X4_50` or `DICT_APRILTAG_36h11`.
        images: The folder of the reference images.
        places: By id of marker; None when only the scale is wanted.
        level: Level the map as well; only without places.
    """

    size: float
    dictionary: str
    images: Path
    places: Mapping[int, MarkerPlace] | None = None
    level: bool = False


@dataclass(frozen=True)
class Level:
    """The up direction from the cameras, which are mostly upright, and the floor.

    Attributes:
        camera_height: Of the cameras above the floor [m], when it was the same for all; gives the
            scale. None leaves the scale as it was.
    """

    camera_height: float | None = None


@dataclass(frozen=True)
class Picks:
    """Where reference images were taken, as pixels of an occupancy map.

    Attributes:
        occupancy: The map that the picks were made in; the map's frame becomes its frame.
        pixels: Column and row by image name, counted from the upper left corner of the image; the
            centre of the first pixel is 0.5, 0.5.
        level: Take the up direction from cameras and floor. Otherwise the map must be level.
    """

    occupancy: OccupancyMap
    pixels: Mapping[str, tuple[float, float]]
    level: bool = False


Constraint: TypeAlias = Poses | Positions | GpsFixes | Distances | Markers | Level | Picks
