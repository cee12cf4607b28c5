# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""How much arrows shake in the image, in pixels.

Both measures are in the unit of the error of a single frame: where each frame puts an end of an
arrow off by a random step of its own, of root mean square s (length of the step), they are s.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.augmentation.projection import in_image, project
from gam_relocalizer.replay.bag import NANOSECONDS

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.augmentation.tracking import Track, Way

# Frames further apart than so many intervals are not consecutive.
CONSECUTIVE = 1.5
# The residual is one of a quadratic through so many seconds to either side [s]; through two frames
# to either side where that would be fewer.
WINDOW = 0.25
FEWEST_ON_A_SIDE = 2
_UNKNOWNS = 3


@dataclass(frozen=True)
class Spread:
    """Sizes of something [px].

    Attributes:
        count: Number of values.
        rms: Root of the mean square.
        median: The median.
        percentile_95: 95 % are no larger.
        largest: The largest.
    """

    count: int
    rms: float
    median: float
    percentile_95: float
    largest: float

    @staticmethod
    def of(values: NDArray[np.float64]) -> Spread | None:
        """Of all finite values of any shape; None without any."""
        finite = values[np.isfinite(values)]
        if not len(finite):
            return None
        return Spread(
            len(finite),
            float(np.sqrt(np.mean(np.square(finite)))),
            float(np.median(finite)),
            float(np.quantile(finite, 0.95)),
            float(np.max(finite)),
        )


@dataclass(frozen=True)
class Jitter:
    """How the ends of arrows behave that one way draws.

    Attributes:
        frames: Number of frames.
        frames_with_pose: Frames that have a pose, and so show arrows.
        ends: Tails and tips that are drawn in the image, over all frames.
        shake: Against the truth: change of the error from frame to frame, by the root of two; None
            without truth.
        offset: Against the truth: the error itself, how far off ends are drawn.
        residual: Without truth: what a smooth motion does not explain.
    """

    frames: int
    frames_with_pose: int
    ends: int
    shake: Spread | None
    offset: Spread | None
    residual: Spread | None


def jitter_of(track: Track, way: Way, ends: NDArray[np.float64]) -> Jitter:
    """Measures one way.

    Args:
        track: The frames.
        way: Whose poses.
        ends: [N,3] tails and tips, map frame.
    """
    cameras = [frame.camera for frame in track.frames]
    stamps = np.array([frame.stamp_ns for frame in track.frames], np.int64)
    poses = [frame.pose(way) for frame in track.frames]
    drawn = pixels_of(ends, cameras, poses)
    true = pixels_of(ends, cameras, [frame.truth for frame in track.frames])
    drawn_inside = _inside(drawn, cameras)
    seconds = (stamps - stamps[:1]) / NANOSECONDS
    errors = drawn - np.where(_inside(true, cameras)[..., None], true, np.nan)
    return Jitter(
        frames=len(poses),
        frames_with_pose=sum(pose is not None for pose in poses),
        ends=int(drawn_inside.sum()),
        shake=Spread.of(shake(errors, seconds, track.interval)),
        offset=Spread.of(np.linalg.norm(errors, axis=-1)),
        residual=Spread.of(
            residuals(np.where(drawn_inside[..., None], drawn, np.nan), seconds, track.interval)
        ),
    )


def shake(
    errors: NDArray[np.float64], seconds: NDArray[np.float64], interval: float
) -> NDArray[np.float64]:
    """[F-1,N] how far the error moves from one frame to the next, by the root of two.

    The difference of two independent errors is larger than one of them by the root of two, so this
    is the error that each frame makes for itself; what all frames have in common, or what drifts
    slowly, is not in it.

    Args:
        errors: [F,N,2] drawn minus true pixel; NaN where one of them is not known.
        seconds: [F] times of the frames.
        interval: Usual time between two of them [s].
    """
    moved = np.diff(errors, axis=0)
    moved[np.diff(seconds) > CONSECUTIVE * interval] = np.nan
    return np.asarray(np.linalg.norm(moved, axis=-1) / np.sqrt(2.0), np.float64)


def residuals(
    pixels: NDArray[np.float64], seconds: NDArray[np.float64], interval: float
) -> NDArray[np.float64]:
    """[F,N] how far each pixel is from a quadratic through those around it in time, and itself.

    The fit follows its own frame a little: each distance is divided by the root of the share that
    the fit leaves of an error in that frame.

    Args:
        pixels: [F,N,2] where an end is drawn; NaN where it is not.
        seconds: [F] times of the frames.
        interval: Usual time between two of them [s].
    """
    reach = max(WINDOW, FEWEST_ON_A_SIDE * interval) + 0.25 * interval
    sizes = np.full(pixels.shape[:2], np.nan)
    known: NDArray[np.bool_] = np.isfinite(pixels[..., 0] + pixels[..., 1])
    for frame in range(len(seconds)):
        first, last = np.searchsorted(seconds, seconds[frame] + np.array([-reach, reach]))
        around = slice(int(first), int(last))
        times = (seconds[around] - seconds[frame]) / interval
        for end in np.flatnonzero(known[frame]):
            used = known[around, end]
            # on one side alone it would be an extrapolation
            if min((used & (times < 0)).sum(), (used & (times > 0)).sum()) < FEWEST_ON_A_SIDE:
                continue
            powers = np.vander(times[used], _UNKNOWNS, increasing=True)
            # the first coefficient is the fit at the frame's own time
            weights = np.linalg.pinv(powers)[0]
            left = 1.0 - weights[times[used] == 0.0].sum()
            off = pixels[frame, end] - weights @ pixels[around, end][used]
            sizes[frame, end] = np.linalg.norm(off) / np.sqrt(left)
    return sizes


def pixels_of(
    ends: NDArray[np.float64],
    cameras: Sequence[pycolmap.Camera | None],
    poses: Sequence[pycolmap.Rigid3d | None],
) -> NDArray[np.float64]:
    """[F,N,2] where places [N,3] lie in each frame; NaN without a pose or out of sight."""
    pixels = np.full((len(poses), len(ends), 2), np.nan)
    for frame, (camera, camera_from_map) in enumerate(zip(cameras, poses, strict=True)):
        if camera is not None and camera_from_map is not None:
            pixels[frame] = project(camera, np.asarray(camera_from_map * ends))
    return pixels


def _inside(
    pixels: NDArray[np.float64], cameras: Sequence[pycolmap.Camera | None]
) -> NDArray[np.bool_]:
    """[F,N] which pixels lie in the image."""
    inside = np.zeros(pixels.shape[:2], bool)
    for frame, camera in enumerate(cameras):
        if camera is not None:
            inside[frame] = in_image(camera, pixels[frame])
    return inside
