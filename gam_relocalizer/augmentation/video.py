# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Writes videos that browsers and phones play: VP8 in WebM.

It is what OpenCV's wheels can encode of what browsers play: H.264 is not in them for its licence,
MPEG-4 Part 2 (mp4v) is played by no browser, and VP9 takes four times as long.
"""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

import cv2
import numpy as np

from gam_relocalizer.errors import VideoError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

SUFFIX = '.webm'
_CODEC = cv2.VideoWriter.fourcc(*'VP80')


class VideoFile:
    """A video being written; made by `video_file`."""

    def __init__(self, path: Path, rate: float) -> None:
        self._path = path
        self._rate = rate
        self._writer: cv2.VideoWriter | None = None
        self._size = (0, 0)

    def write(self, image: NDArray[np.uint8]) -> None:
        """Appends a frame, RGB [H,W,3]; one of another size than the first is resized to it.

        Odd sizes, which the codec cannot store, grow by a pixel.

        Raises:
            VideoError: The file cannot be written.
        """
        if self._writer is None:
            self._writer = self._opened(image)
        if (image.shape[1], image.shape[0]) != self._size:
            image = np.asarray(cv2.resize(image, self._size), np.uint8)
        bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
        below, right = self._size[1] % 2, self._size[0] % 2
        self._writer.write(cv2.copyMakeBorder(bgr, 0, below, 0, right, cv2.BORDER_REPLICATE))

    def close(self) -> None:
        """Completes the file."""
        if self._writer is not None:
            self._writer.release()

    def _opened(self, image: NDArray[np.uint8]) -> cv2.VideoWriter:
        height, width = image.shape[:2]
        self._size = (width, height)
        stored = (width + width % 2, height + height % 2)
        writer = cv2.VideoWriter(
            str(self._path.absolute()), cv2.CAP_FFMPEG, _CODEC, self._rate, stored
        )
        if not writer.isOpened():
            msg = (
                f'{self._path}: cannot be written as a VP8 video; the folder may not be writable, '
                f'or this OpenCV was built without FFmpeg and libvpx'
            )
            raise VideoError(msg)
        return writer


@contextmanager
def video_file(path: Path, rate: float) -> Iterator[VideoFile]:
    """A video to fill; it is there under its name when all went well, and not before.

    Args:
        path: The file, `*.webm`.
        rate: Frames per second.
    """
    temporary = path.with_name(f'.part.{path.name}')
    video = VideoFile(temporary, rate)
    try:
        yield video
        video.close()
        if temporary.exists():
            temporary.replace(path)
    finally:
        video.close()
        temporary.unlink(missing_ok=True)
