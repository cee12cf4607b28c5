# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The scale from distances between places that can be pointed at in the map."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.alignment.reference import examples
from gam_relocalizer.alignment.scale import ScaleFit, fit_scale
from gam_relocalizer.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from gam_relocalizer.alignment.constraints import Distance, Place
    from gam_relocalizer.alignment.reference import Reference

# A point further from the pixel than this shows something else.
MAX_PIXELS = 20.0


def scale_from_distances(reference: Reference, distances: Sequence[Distance]) -> ScaleFit:
    """The scale that makes the map's distances those that were measured.

    Raises:
        UsageError: A place is in no reference image, or no point of the map is near its pixel.
        AlignmentError: A pixel is given and the map has no COLMAP model, or two places are one.
    """
    lengths = [
        np.linalg.norm(_position(reference, one.first) - _position(reference, one.second))
        for one in distances
    ]
    return fit_scale(np.array(lengths), np.array([one.metres for one in distances]))


def describe_distance(distance: Distance) -> str:
    """Both places, as they were given."""
    return ' - '.join(_describe(place) for place in (distance.first, distance.second))


def _position(reference: Reference, place: Place) -> NDArray[np.float64]:
    """[3] SfM frame."""
    if place.image not in reference.names:
        msg = (
            f'`{place.image}` is no reference image of the map, which has '
            f'{examples(reference.names)}; a point of an image is given as `image@column,row`'
        )
        raise UsageError(msg)
    if place.pixel is None:
        return np.asarray(reference.positions[reference.names.index(place.image)])
    return _point_at(reference, place)


def _point_at(reference: Reference, place: Place) -> NDArray[np.float64]:
    """The point that the image sees nearest to the pixel."""
    image = reference.model.find_image_with_name(place.image)
    seen = [] if image is None else image.get_observation_points2D()
    pixels = np.array([point.xy for point in seen]).reshape(-1, 2)
    off = np.linalg.norm(pixels - np.asarray(place.pixel), axis=1)
    if not len(off) or off.min() > MAX_PIXELS:
        nearest = f'the nearest is {off.min():.0f} pixels off' if len(off) else 'it sees none'
        msg = (
            f'{_describe(place)}: the map has no point within {MAX_PIXELS:.0f} pixels of there '
            f'({nearest}); choose a corner or spot with texture that several images show'
        )
        raise UsageError(msg)
    point = reference.model.point3D(seen[int(off.argmin())].point3D_id)
    return np.asarray(point.xyz, np.float64)


def _describe(place: Place) -> str:
    if place.pixel is None:
        return place.image
    return f'{place.image}@{place.pixel[0]:g},{place.pixel[1]:g}'
