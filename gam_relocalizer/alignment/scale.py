# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The scale of a map from lengths that are known in metres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.alignment.similarity import widened
from gam_relocalizer.errors import AlignmentError

if TYPE_CHECKING:
    from numpy.typing import NDArray

# Beyond so many standard deviations a measurement is a mistake.
_GROSS = 3.5
# The standard deviation is so many times the median absolute deviation of normal errors.
_SIGMA_OF_MEDIAN = 1.4826
# Nobody measures better than so: smaller deviations are no mistakes.
_NEVER_GROSS = 0.01
# With fewer there is no telling which one is wrong.
_MIN_TO_JUDGE = 3


@dataclass(frozen=True)
class ScaleFit:
    """A scale and how well the lengths agree on it.

    Attributes:
        scale: Metres per unit of the map.
        residuals: [n] how far each length is off [m].
        inliers: [n] which lengths were used.
        sigma: Standard deviation of the scale as a share of it; None with a single length.
    """

    scale: float
    residuals: NDArray[np.float64]
    inliers: NDArray[np.bool_]
    sigma: float | None


def fit_scale(lengths: NDArray[np.float64], metres: NDArray[np.float64]) -> ScaleFit:
    """The scale that lengths in units of the map [n] have in metres [n].

    Mistakes are told by their ratio to the median ratio; what remains is fitted by least squares,
    in which long lengths count more: an error of a centimetre is the smaller share of them.

    Raises:
        AlignmentError: A length is zero in the map.
    """
    if not (lengths > 0.0).all():
        msg = 'a length is zero in the map, although it is not in metres; remove it'
        raise AlignmentError(msg)
    inliers = _inliers(np.log(metres / lengths))
    used, known = lengths[inliers], metres[inliers]
    scale = float((used * known).sum() / (used**2).sum())
    residuals = np.abs(scale * lengths - metres)
    freedom = int(inliers.sum()) - 1
    if freedom < 1:
        return ScaleFit(scale, residuals, inliers, None)
    # of errors that may be the same for all lengths or grow with them: what leaving one out
    # changes (MacKinnon and White 1985, HC3)
    shares = used**2 / (used**2).sum()
    changes = shares / (1.0 - shares) * residuals[inliers] / (scale * used)
    return ScaleFit(scale, residuals, inliers, widened(float(np.linalg.norm(changes)), freedom))


def _inliers(ratios: NDArray[np.float64]) -> NDArray[np.bool_]:
    if len(ratios) < _MIN_TO_JUDGE:
        return np.ones(len(ratios), dtype=bool)
    deviations = np.abs(ratios - np.median(ratios))
    noise = _SIGMA_OF_MEDIAN * float(np.median(deviations))
    # which is too small for few (Rousseeuw and Leroy 1987)
    noise *= 1.0 + 5.0 / (len(ratios) - 1)
    result: NDArray[np.bool_] = deviations <= max(_GROSS * noise, _NEVER_GROSS)
    return result
