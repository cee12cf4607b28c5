# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The frames of a track with arrows in them: as videos, and some of them on one sheet."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import cv2
import numpy as np

from gam_relocalizer.augmentation.drawing import draw_arrows
from gam_relocalizer.augmentation.tracking import Way
from gam_relocalizer.augmentation.video import SUFFIX, video_file

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from gam_relocalizer.augmentation.arrows import Arrow
    from gam_relocalizer.augmentation.tracking import Track, TrackedFrame

SIDE_BY_SIDE = 'side_by_side'
SHEET_FRAMES = 12
SHEET_COLUMNS = 4
_CELL_WIDTH = 480
_MARGIN_PX = 6

_NAMES = {Way.FRAME_BY_FRAME: 'each frame by itself', Way.ODOMETRY: 'corrected odometry'}


@dataclass
class Shown:
    """What was drawn.

    Attributes:
        videos: File names.
        sheet: RGB [H,W,3], some frames evenly spread; a row of each way below the other.
    """

    videos: list[str] = field(default_factory=list)
    sheet: NDArray[np.uint8] | None = None


def show_track(
    folder: Path,
    track: Track,
    frames: Iterable[tuple[TrackedFrame, NDArray[np.uint8]]],
    arrows: Sequence[Arrow],
    up: NDArray[np.float64],
) -> Shown:
    """Writes a video for each way, and with two ways one of both side by side.

    Args:
        folder: An existing one.
        track: All frames.
        frames: Those that have an image, RGB [H,W,3] or grey [H,W].
        arrows: What to draw.
        up: [3] of length one, map frame.

    Raises:
        VideoError: A file cannot be written.
    """
    names = [way.value for way in track.ways]
    names += [SIDE_BY_SIDE] if len(names) > 1 else []
    wanted = _evenly([f.stamp_ns for f in track.frames if f.camera is not None], SHEET_FRAMES)
    cells: list[list[NDArray[np.uint8]]] = []
    with ExitStack() as stack:
        files = [
            stack.enter_context(video_file(folder / f'{name}{SUFFIX}', 1.0 / track.interval))
            for name in names
        ]
        for frame, image in frames:
            rgb = image if image.ndim == 3 else np.stack([image] * 3, axis=-1)
            pictures = [_picture(rgb, frame, way, track, arrows, up) for way in track.ways]
            if frame.stamp_ns in wanted:
                cells.append(pictures)
            if len(pictures) > 1:
                pictures = [*pictures, np.hstack(pictures)]
            for file, picture in zip(files, pictures, strict=True):
                file.write(picture)
    written = [f'{name}{SUFFIX}' for name in names if cells]
    return Shown(written, _sheet(cells) if cells else None)


def _picture(
    rgb: NDArray[np.uint8],
    frame: TrackedFrame,
    way: Way,
    track: Track,
    arrows: Sequence[Arrow],
    up: NDArray[np.float64],
) -> NDArray[np.uint8]:
    """A frame with the arrows as one way places them, and a line that says which."""
    seconds = (frame.stamp_ns - track.frames[0].stamp_ns) / 1e9
    label = f'{seconds:.1f} s  {_NAMES[way]}'
    camera_from_map = frame.pose(way)
    if camera_from_map is None or frame.camera is None:
        why = frame.status.name if way is Way.FRAME_BY_FRAME else 'no correction'
        return _labelled(rgb, f'{label}: {why}', (255, 120, 110))
    drawn = draw_arrows(rgb, frame.camera, camera_from_map, arrows, up)
    return _labelled(drawn, label, (255, 255, 255))


def _labelled(rgb: NDArray[np.uint8], text: str, colour: tuple[int, int, int]) -> NDArray[np.uint8]:
    """A copy with a line of text in its upper left corner."""
    labelled = rgb.copy()
    scale = rgb.shape[1] / 1100.0
    thickness = max(1, round(2 * scale))
    font = cv2.FONT_HERSHEY_SIMPLEX
    (width, height), below = cv2.getTextSize(text, font, scale, thickness)
    margin = max(2, height // 2)
    strip = labelled[: height + below + 2 * margin, : width + 2 * margin]
    strip[:] = (strip * 0.45).astype(np.uint8)
    cv2.putText(
        labelled, text, (margin, margin + height), font, scale, colour, thickness, cv2.LINE_AA
    )
    return labelled


def _evenly(stamps: Sequence[int], count: int) -> set[int]:
    """So many of them, from the first to the last."""
    if not stamps:
        return set()
    return {stamps[index] for index in np.linspace(0, len(stamps) - 1, count).round().astype(int)}


def _sheet(cells: Sequence[Sequence[NDArray[np.uint8]]]) -> NDArray[np.uint8]:
    """All pictures, in columns; the ways of a frame below each other."""
    height, width = cells[0][0].shape[:2]
    size = (_CELL_WIDTH, max(1, round(_CELL_WIDTH * height / width)))
    stacks = [np.vstack(list(_framed(pictures, size))) for pictures in cells]
    blank = np.full_like(stacks[0], 255)
    rows = [
        np.hstack([*row, *[blank] * (SHEET_COLUMNS - len(row))])
        for row in (
            stacks[begin : begin + SHEET_COLUMNS] for begin in range(0, len(stacks), SHEET_COLUMNS)
        )
    ]
    return np.vstack(rows)


def _framed(
    pictures: Sequence[NDArray[np.uint8]], size: tuple[int, int]
) -> Iterator[NDArray[np.uint8]]:
    for index, picture in enumerate(pictures):
        small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        bottom = _MARGIN_PX * (3 if index == len(pictures) - 1 else 1)
        border = (0, bottom, 0, _MARGIN_PX)
        framed = cv2.copyMakeBorder(small, *border, cv2.BORDER_CONSTANT, value=(255, 255, 255))
        yield np.asarray(framed, np.uint8)
