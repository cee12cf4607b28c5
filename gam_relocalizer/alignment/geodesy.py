# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Places on earth in a local frame: x east, y north, z up (REP-103)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pycolmap

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from gam_relocalizer.alignment.constraints import Triple


def datum_of(fixes: NDArray[np.float64]) -> Triple:
    """The median of fixes [n,3] (latitude, longitude [deg], altitude [m]).

    Taken of places in space: the median of longitudes fails where they jump from 180 to -180.
    """
    places = np.asarray(_wgs84().ellipsoid_to_ecef(fixes * [1.0, 1.0, 0.0]))
    middle = _wgs84().ecef_to_ellipsoid(np.median(places, axis=0)[None])[0]
    return float(middle[0]), float(middle[1]), float(np.median(fixes[:, 2]))


def enu_of(fixes: NDArray[np.float64], datum: Triple) -> NDArray[np.float64]:
    """[n,3] metres east, north and up of the datum, on the ellipsoid WGS 84."""
    return np.asarray(_wgs84().ellipsoid_to_enu(fixes, *datum), np.float64)


def _wgs84() -> pycolmap.GPSTransform:
    return pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
