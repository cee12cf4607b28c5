# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What an alignment found, and how well it fits."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from gam_relocalizer.alignment.constraints import Triple
    from gam_relocalizer.scene_map import MapFrame

_WORST = 5


@dataclass(frozen=True)
class Residual:
    """How far one given thing lies from where the map has it.

    Attributes:
        name: Of the image, the pair of places or the marker.
        metres: Distance; horizontal only where just that was fitted.
        degrees: Angle between the orientations, where they were given.
        inlier: Whether it was used.
    """

    name: str
    metres: float
    degrees: float | None
    inlier: bool


@dataclass(frozen=True)
class Findings:
    """What is known of an alignment besides the transform.

    Attributes:
        scale_sigma: Standard deviation of the scale as a share of it, from the residuals; widened
            where these are few, or alike from one to the next. None for a single length.
        rotation_sigma_deg: Standard deviation of the rotation about its worst axis [deg].
        roll_median_deg: How far the cameras' x axes are off the horizontal, in the median [deg].
        floor_points: Points of the map on the floor; None when the floor was not looked for.
        datum: Latitude, longitude [deg] and altitude [m] of the map's origin.
        warnings: What to know before the map is used.
    """

    scale_sigma: float | None = None
    rotation_sigma_deg: float | None = None
    roll_median_deg: float | None = None
    floor_points: int | None = None
    datum: Triple | None = None
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class AlignmentReport:
    """The outcome of `align_map`.

    Attributes:
        method: Name of the constraint, with ` + level` where the map was levelled, too.
        frame: map_from_sfm as it was or would be written.
        residuals: One per given thing that the map knows, the worst first.
        unknown: Given names that are no reference images.
        findings: See there.
        written: Whether the map was changed; False after a dry run.
        map_id: The map's id with this frame; empty after a dry run.
    """

    method: str
    frame: MapFrame
    residuals: tuple[Residual, ...]
    unknown: tuple[str, ...] = ()
    findings: Findings = field(default_factory=Findings)
    written: bool = False
    map_id: str = ''

    @property
    def inliers(self) -> int:
        """Number of things that were used."""
        return sum(one.inlier for one in self.residuals)

    @property
    def residual_median(self) -> float | None:
        """Of those that were used [m]; None where nothing has a residual."""
        used = [one.metres for one in self.residuals if one.inlier]
        return float(np.median(used)) if used else None

    @property
    def residual_max(self) -> float | None:
        """Of those that were used [m]; None where nothing has a residual."""
        return max((one.metres for one in self.residuals if one.inlier), default=None)

    @property
    def residual_median_deg(self) -> float | None:
        """Of the orientations that were used [deg]; None where none were given."""
        used = [one.degrees for one in self.residuals if one.inlier and one.degrees is not None]
        return float(np.median(used)) if used else None

    def record(self) -> dict[str, Any]:
        """What manifest.yaml keeps of it."""
        known = {name: value for name, value in asdict(self.findings).items() if value is not None}
        return {
            'method': self.method,
            'given': len(self.residuals) + len(self.unknown),
            'matched': len(self.residuals),
            'inliers': self.inliers,
            'residual_median': self.residual_median,
            'residual_max': self.residual_max,
            'residual_median_deg': self.residual_median_deg,
            **known,
            'worst': [asdict(one) for one in self.residuals[:_WORST]],
        }

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for JSON: the record, the frame and all residuals."""
        record = self.record()
        del record['worst']
        return {
            **record,
            'frame': asdict(self.frame),
            'unknown': list(self.unknown),
            'residuals': [asdict(one) for one in self.residuals],
            'written': self.written,
            'map_id': self.map_id,
        }
