# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""True poses at any time between the samples of a recording."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass
from typing import TYPE_CHECKING

from gam_relocalizer.errors import DatasetError
from gam_relocalizer.transforms import interpolated

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    import pycolmap

# Motion capture loses sight now and then; across a longer gap nobody knows the way.
_MAX_GAP_NS = 100_000_000
# Beyond the first and the last sample, as others associate stamps.
_MAX_OFFSET_NS = 20_000_000


@dataclass(frozen=True)
class Trajectory:
    """Samples of a moving pose.

    Attributes:
        stamps_ns: Rising.
        poses: One for each.
    """

    stamps_ns: tuple[int, ...]
    poses: tuple[pycolmap.Rigid3d, ...]

    @classmethod
    def of_samples(cls, samples: Mapping[int, pycolmap.Rigid3d], source: Path) -> Trajectory:
        """From poses by stamp, in any order.

        Raises:
            DatasetError: No samples.
        """
        if not samples:
            msg = f'{source}: no poses in it'
            raise DatasetError(msg)
        stamps = sorted(samples)
        return cls(tuple(stamps), tuple(samples[stamp] for stamp in stamps))

    def at(self, stamp_ns: int) -> pycolmap.Rigid3d | None:
        """The pose at a time: interpolated between samples at most 0.1 s apart.

        Else it is that of a sample at most 0.02 s away, or None.
        """
        after = bisect_left(self.stamps_ns, stamp_ns)
        if 0 < after < len(self.stamps_ns):
            begin, end = self.stamps_ns[after - 1], self.stamps_ns[after]
            if end - begin <= _MAX_GAP_NS:
                share = (stamp_ns - begin) / (end - begin)
                return interpolated(self.poses[after - 1], self.poses[after], share)
        candidates = range(max(0, after - 1), min(after + 1, len(self.stamps_ns)))
        nearest = min(candidates, key=lambda one: abs(self.stamps_ns[one] - stamp_ns))
        near = abs(self.stamps_ns[nearest] - stamp_ns) <= _MAX_OFFSET_NS
        return self.poses[nearest] if near else None
