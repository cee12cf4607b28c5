# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Which frames of a moving camera make a map: sharp ones that overlap as much as is needed."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from numpy.typing import NDArray

MILLISECOND = 1_000_000

# Frames are judged at this many pixels on the longer side, whatever their own size.
LONGER_SIDE = 640
# A keyframe is due when what the last one shows has moved by this share of the longer side ...
DUE_DISPLACEMENT = 0.08
# ... or when no more than this share of it can be found again.
DUE_SURVIVAL = 0.7
# Where the rest has moved by less than this share of the longer side, the camera stands, and what
# is lost is merely hidden by somebody in front of it, if it is less than this share.
AT_REST = 0.01
HIDDEN = 0.7
# The sharpest frame is taken of those that have used up from so much to so much of what is due.
EARLIEST = 0.8
LATEST = 1.25
# Where the camera moves too far from frame to frame for that, the frame before a leap will do if
# it has used up so much: the leap is then a smaller one.
STEPPING_STONE = 0.35

# A frame is blurred when it is less sharp than this share of the median of the frames around it,
# which are so many on either side.
BLURRED = 0.5
NEIGHBOURS = 7
# Grey levels: a frame that varies less shows nothing.
EMPTY = 4.0

MAX_CORNERS = 150
# With fewer there is nothing to go by.
MIN_CORNERS = 15
CORNER_SPACING = 20
CORNER_BLOCK = 7
CORNER_QUALITY = 0.01
# The least eigenvalue that no sensor noise has (up to 8 grey levels, after `NOISE_SIGMA`).
CORNER_FLOOR = 1e-4
NOISE_SIGMA = 1.5
TEXTURE_SIDE = 241
# A corner that was followed to a frame is there when its surroundings correlate so well.
LIKENESS = 0.8
# Where fewer than this share are found, the camera may have leapt.
LEAP = 0.7
_AROUND = np.mgrid[-7:8, -7:8].astype(np.float32)
_FLOW_WINDOW = (21, 21)
# Levels of the image pyramid: few first, where the corner is expected, since coarse levels are led
# astray by whatever passes nearby; then many, for a motion that nobody expected.
_FLOW_LEVELS = (1, 4)
_SHIFT_SCALE = 0.5


@dataclass(frozen=True, eq=False)
class Frame:
    """One picture of a moving camera.

    Attributes:
        stamp_ns: When it was taken [ns].
        image: RGB [H,W,3] or grey [H,W].
        log_ns: When a recorder received it [ns].
        frame_id: Name of the camera's frame, where it has one.
    """

    stamp_ns: int
    image: NDArray[np.uint8]
    log_ns: int = 0
    frame_id: str = ''


@dataclass(frozen=True)
class KeyframeCounts:
    """What became of the frames.

    Attributes:
        read: Frames in all.
        late: Left out, since their stamps are not after those of the frames before them.
        empty: Left out, since they show nothing: black, or of one colour.
        blurred: Left out, since those around them are clearly sharper.
        chosen: Keyframes.
    """

    read: int
    late: int
    empty: int
    blurred: int
    chosen: int


def select_keyframes(frames: Iterable[Frame], keep: Callable[[Frame], None]) -> KeyframeCounts:
    """Chooses the frames that make a map; holds a few frames at a time, however many there are.

    The first frame is a keyframe, and each next one is due when corners of the last one have moved
    by `DUE_DISPLACEMENT` or are lost by `DUE_SURVIVAL`: by turning as well as by walking, for it
    is overlap that has to be kept. So a camera at rest gives none, and frames between which
    nothing can be followed all are. The same frames give the same keyframes.

    Args:
        frames: In the order in which they were taken.
        keep: Is handed each keyframe, in order, with at least a millisecond between two.

    Returns:
        What became of the frames.
    """
    tally = _Tally()
    selector = _Selector(keep)
    for view, blurred in _judged(_usable(frames, tally)):
        if blurred:
            tally.blurred += 1
        else:
            selector.consider(view)
    selector.finish()
    return KeyframeCounts(tally.read, tally.late, tally.empty, tally.blurred, selector.chosen)


@dataclass
class _Tally:
    read: int = 0
    late: int = 0
    empty: int = 0
    blurred: int = 0


@dataclass(frozen=True, eq=False)
class _View:
    """A frame, with what is judged of it.

    Attributes:
        frame: As it came.
        texture: [h,w] uint8, small, for following corners.
        sharpness: Variance of the Laplacian over that of the grey values: a darker exposure of
            the same scene is as sharp.
        is_empty: Whether it shows nothing.
    """

    frame: Frame
    texture: NDArray[np.uint8]
    sharpness: float
    is_empty: bool

    @staticmethod
    def of(frame: Frame) -> _View:
        small = _small(frame.image)
        grey = small
        if small.ndim == 3:
            grey = np.asarray(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
        deviation = _deviation(grey)
        is_empty = deviation < EMPTY
        edges = cv2.Laplacian(grey, cv2.CV_32F)
        sharpness = 0.0 if is_empty else (_deviation(edges) / deviation) ** 2
        return _View(frame, _texture(grey), sharpness, is_empty)


def _texture(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """What is left of an image without noise and without brightness, which exposure changes."""
    smooth = cv2.GaussianBlur(grey, (0, 0), NOISE_SIGMA)
    around = cv2.blur(grey, (TEXTURE_SIDE, TEXTURE_SIDE))
    return np.asarray(cv2.addWeighted(smooth, 1.0, around, -1.0, 128.0), dtype=np.uint8)


def _deviation(values: cv2.typing.MatLike) -> float:
    """Standard deviation; NumPy's takes far longer for pixels."""
    return float(cv2.meanStdDev(values)[1][0, 0])


def _small(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = image.shape[:2]
    scale = LONGER_SIDE / max(height, width)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    if scale >= 1.0:
        return image
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _usable(frames: Iterable[Frame], tally: _Tally) -> Iterator[_View]:
    """The frames that show something, in the order of time."""
    last_ns = -MILLISECOND
    for frame in frames:
        tally.read += 1
        if frame.stamp_ns < last_ns + MILLISECOND:
            tally.late += 1
            continue
        last_ns = frame.stamp_ns
        view = _View.of(frame)
        if view.is_empty:
            tally.empty += 1
        else:
            yield view


def _judged(views: Iterator[_View]) -> Iterator[tuple[_View, bool]]:
    """Each view, and whether it is blurred in comparison with its neighbours in time."""
    before: deque[float] = deque(maxlen=NEIGHBOURS)
    ahead = deque(islice(views, NEIGHBOURS))
    while ahead:
        ahead.extend(islice(views, 1))
        median = float(np.median([*before, *(view.sharpness for view in ahead)]))
        view = ahead.popleft()
        before.append(view.sharpness)
        yield view, view.sharpness < BLURRED * median


class _Selector:
    """Compares each frame with the last keyframe; holds the best candidate for the next."""

    def __init__(self, keep: Callable[[Frame], None]) -> None:
        self.chosen = 0
        self._keep = keep
        self._last: _Keyframe | None = None
        self._held: tuple[_View, float] | None = None

    def consider(self, view: _View) -> None:
        """Takes in the next frame."""
        used = math.inf if self._last is None else self._last.overlap_used_by(view)
        if used < LATEST:
            self._hold(view, used)
        elif self._held is None:
            self._take(view)
        else:
            self._take(self._held[0])
            self.consider(view)

    def finish(self) -> None:
        """Takes the last candidate, if one is due."""
        if self._held is not None and self._held[1] >= EARLIEST:
            self._take(self._held[0])

    def _hold(self, view: _View, used: float) -> None:
        """Of the frames around the due moment the sharpest, else the last one before it.

        None, when the view is again what it was: somebody walked by.
        """
        if used < STEPPING_STONE:
            self._held = None
            return
        if self._held is not None and self._held[1] >= EARLIEST:
            best = self._held[0]
            if used < EARLIEST or view.sharpness <= best.sharpness:
                return
        self._held = (view, used)

    def _take(self, view: _View) -> None:
        self._keep(view.frame)
        self.chosen += 1
        self._last = _Keyframe(view.texture)
        self._held = None


class _Keyframe:
    """The corners of a keyframe, followed from it to the frames after it.

    Each frame is compared with the keyframe itself, and the last frame merely tells where to look:
    so nothing adds up while the camera stands, and what was hidden for a while is found again.
    """

    def __init__(self, texture: NDArray[np.uint8]) -> None:
        self._texture = texture
        self._corners = _corners(texture)
        self._expected = self._corners.copy()
        self._patches = _patches(texture, self._corners)

    def overlap_used_by(self, view: _View) -> float:
        """How much of what may change until the next keyframe has changed.

        Returns:
            0 for the same view; 1 when a keyframe is due; infinite when nothing is found again.
        """
        if view.texture.shape != self._texture.shape:
            return math.inf
        if len(self._corners) < MIN_CORNERS:
            return math.inf if len(_corners(view.texture)) >= MIN_CORNERS else 0.0
        found, survived = self._followed_to(view.texture)
        if not survived.any():
            self._expected = self._corners.copy()
            return math.inf
        motion = found - self._corners
        self._expected = np.where(
            survived[:, None], found, self._corners + np.median(motion[survived], axis=0)
        ).astype(np.float32)
        moved = float(np.median(np.linalg.norm(motion[survived], axis=1)))
        displacement = moved / float(max(view.texture.shape))
        lost = 1.0 - float(survived.mean())
        if displacement < AT_REST and lost < HIDDEN:
            lost = 0.0
        return max(displacement / DUE_DISPLACEMENT, lost / (1.0 - DUE_SURVIVAL))

    def _followed_to(
        self, texture: NDArray[np.uint8]
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Where the corners are in another view [C,2], and which of them are really there [C]."""
        found = self._expected.copy()
        survived = np.zeros(len(found), dtype=np.bool_)
        for levels in _FLOW_LEVELS:
            self._follow(texture, self._expected, levels, found, survived)
        if survived.mean() < LEAP:
            leap = self._corners + _shift(self._texture, texture)
            self._follow(texture, leap, _FLOW_LEVELS[-1], found, survived)
        return found, survived

    def _follow(
        self,
        texture: NDArray[np.uint8],
        expected: NDArray[np.float32],
        levels: int,
        found: NDArray[np.float32],
        survived: NDArray[np.bool_],
    ) -> None:
        """Lucas-Kanade for those that did not survive so far; there they must look alike."""
        lost = ~survived
        if not lost.any():
            return
        flow = cv2.calcOpticalFlowPyrLK(
            self._texture,
            texture,
            self._corners[lost],
            expected[lost],
            winSize=_FLOW_WINDOW,
            maxLevel=levels,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        places, tracked = np.asarray(flow[0], np.float32), np.asarray(flow[1]).ravel() == 1
        height, width = texture.shape
        inside = (places >= 0).all(axis=1) & (places[:, 0] < width) & (places[:, 1] < height)
        likeness = np.einsum('cp,cp->c', self._patches[lost], _patches(texture, places))
        found[lost] = places
        survived[lost] = inside & tracked & (likeness > LIKENESS)


def _shift(source: NDArray[np.uint8], target: NDArray[np.uint8]) -> NDArray[np.float32]:
    """How far most of an image has moved [2], by phase correlation: any way, but only roughly."""
    height, width = source.shape
    size = (max(2, round(width * _SHIFT_SCALE)), max(2, round(height * _SHIFT_SCALE)))
    first, second = (
        cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        for image in (source, target)
    )
    moved, _ = cv2.phaseCorrelate(first, second, cv2.createHanningWindow(size, cv2.CV_32F))
    return np.array(moved, np.float32) / np.float32(_SHIFT_SCALE)


def _patches(texture: NDArray[np.uint8], places: NDArray[np.float32]) -> NDArray[np.float32]:
    """Surroundings of places [C,2], such that a product of two is their correlation: [C,P]."""
    if not len(places):
        return np.zeros((0, _AROUND[0].size), np.float32)
    columns = places[:, :1] + _AROUND[0].ravel()
    rows = places[:, 1:] + _AROUND[1].ravel()
    pixels = cv2.remap(texture, columns, rows, cv2.INTER_LINEAR).astype(np.float32)
    pixels -= pixels.mean(axis=1, keepdims=True)
    lengths = np.linalg.norm(pixels, axis=1, keepdims=True)
    return np.asarray(pixels / np.maximum(lengths, 1.0), np.float32)


def _corners(texture: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Corners that stand out from noise, spread over the image: [C,2]."""
    strongest = float(cv2.cornerMinEigenVal(texture, CORNER_BLOCK).max())
    if strongest <= CORNER_FLOOR:
        return np.zeros((0, 2), np.float32)
    found = cv2.goodFeaturesToTrack(
        texture,
        MAX_CORNERS,
        max(CORNER_QUALITY, CORNER_FLOOR / strongest),
        CORNER_SPACING,
        blockSize=CORNER_BLOCK,
    )
    return np.asarray(found, np.float32).reshape(-1, 2)
