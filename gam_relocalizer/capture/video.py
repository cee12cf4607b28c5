# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframes of a video file."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

import cv2
import numpy as np

from gam_relocalizer import MAX_IMAGE_PIXELS
from gam_relocalizer.capture.capture import Capture, keep_keyframes
from gam_relocalizer.capture.keyframes import MILLISECOND, Frame
from gam_relocalizer.errors import CameraError, VideoError
from gam_relocalizer.image_set import ImageSet
from gam_relocalizer.mapping.progress import Progress, ignore_progress

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    import pycolmap

    from gam_relocalizer.capture.capture import Selection
    from gam_relocalizer.mapping.workspace import Workspace

# Where a file does not say how long a frame is shown [frames/s].
USUAL_RATE = 30.0
# Some containers merely estimate how many frames they hold.
TRUNCATED = 0.9


def capture_video(
    path: Path,
    workspace: Workspace,
    camera: pycolmap.Camera | None = None,
    progress: Progress = ignore_progress,
) -> Capture:
    """Chooses the keyframes of a video; nothing is known of where they were taken.

    Frames come upright: a rotation that the file states (phones held upright) is applied.

    Args:
        path: The video; only read.
        workspace: Where the keyframes are stored.
        camera: Of the upright frames; without it the camera is guessed and refined.
        progress: Told of the step frames.

    Raises:
        VideoError: Missing, no video, damaged from its start, or too large.
        CameraError: The camera is not of the size of the frames.
        MapBuildError: The keyframes cannot be stored, or there are none.
    """
    selection = keep_keyframes(VideoFrames(path, progress), workspace)
    if camera is not None:
        _check_size(selection, camera, path)
    cameras = {} if camera is None else dict.fromkeys(selection.names, camera)
    images = ImageSet(selection.folder, selection.names, cameras, source=path.absolute().name)
    return Capture(str(path), images, selection.counts, warnings=selection.warnings)


class VideoFrames:
    """The frames of a video file.

    Attributes:
        name: Of the file.
        identity: The file as it was found.
        warnings: Filled when all frames were read.
    """

    def __init__(self, path: Path, progress: Progress) -> None:
        with _opened(path):
            pass
        found = path.stat()
        self.name = str(path)
        self.identity = {
            'video': str(path.absolute()),
            'size': found.st_size,
            'modified': found.st_mtime_ns,
        }
        self.warnings: list[str] = []
        self._path = path
        self._progress = progress

    def frames(self) -> Iterator[Frame]:
        """All that can be decoded, RGB; stamps count from the start of the video.

        Raises:
            VideoError: Not one frame can be decoded.
        """
        with _opened(self._path) as video:
            stated = max(0, round(video.get(cv2.CAP_PROP_FRAME_COUNT)))
            rate = video.get(cv2.CAP_PROP_FPS)
            step_ns = round(1e9 / (rate if rate > 0.0 else USUAL_RATE))
            read, stamp_ns = 0, -step_ns
            while (image := _next_image(video)) is not None:
                read += 1
                stated_ns = round(video.get(cv2.CAP_PROP_POS_MSEC) * MILLISECOND)
                # the frames of a file are in order, whatever it says of their times
                stamp_ns = stated_ns if stated_ns > stamp_ns else stamp_ns + step_ns
                self._progress('frames', read, max(read, stated))
                yield Frame(stamp_ns, image)
        if not read:
            msg = f'{self._path}: not one frame can be decoded; the video is damaged or truncated'
            raise VideoError(msg)
        self._progress('frames', read, read)
        if read < TRUNCATED * stated:
            self.warnings.append(
                f'{self._path}: {read} frames could be read of {stated} that it states; the video '
                f'is damaged or truncated'
            )


@contextmanager
def _opened(path: Path) -> Iterator[cv2.VideoCapture]:
    """An open video.

    Raises:
        VideoError: Missing, empty, or nothing that can be read as a video.
    """
    if not path.is_file():
        msg = f'{path}: no such video file'
        raise VideoError(msg)
    try:
        with path.open('rb') as stream:
            empty = not stream.read(1)
    except OSError as err:
        msg = f'{path}: cannot be read: {err.strerror}'
        raise VideoError(msg) from err
    if empty:
        msg = f'{path}: the file is empty'
        raise VideoError(msg)
    # an absolute path is never taken for an address or a pattern of names
    video = cv2.VideoCapture(str(path.absolute()), cv2.CAP_FFMPEG)
    try:
        if not video.isOpened():
            msg = (
                f'{path}: cannot be opened as a video; it holds no pictures (sound alone), is '
                f'damaged or truncated, or of an unknown format'
            )
            raise VideoError(msg)
        width, height = (
            video.get(side) for side in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
        )
        if width * height > MAX_IMAGE_PIXELS:
            msg = f'{path}: {width:.0f} x {height:.0f} pixels are more than {MAX_IMAGE_PIXELS}'
            raise VideoError(msg)
        video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
        yield video
    finally:
        video.release()


def _next_image(video: cv2.VideoCapture) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]] | None:
    """The next frame, RGB; None at the end."""
    read, image = video.read()
    if not read:
        return None
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def _check_size(selection: Selection, camera: pycolmap.Camera, path: Path) -> None:
    first = selection.keyframes[0]
    if (first.width, first.height) != (camera.width, camera.height):
        msg = (
            f'{path}: frames are {first.width} x {first.height} pixels, but the camera is '
            f'{camera.width} x {camera.height}; give the camera of the upright frames'
        )
        raise CameraError(msg)
