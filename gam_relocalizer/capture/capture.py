# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframes on disk, and what was captured along with them."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Protocol

import cv2

from gam_relocalizer import __version__
from gam_relocalizer.capture.keyframes import MILLISECOND, KeyframeCounts, select_keyframes
from gam_relocalizer.errors import MapBuildError
from gam_relocalizer.mapping.workspace import key_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from gam_relocalizer.alignment.constraints import GpsFixes, Poses, Positions
    from gam_relocalizer.capture.keyframes import Frame
    from gam_relocalizer.image_set import ImageSet
    from gam_relocalizer.mapping.workspace import Workspace

STEP = 'keyframes'
# A quarter of the size of PNG, and maps of it have as many points.
JPEG_QUALITY = 95
_SELECTION = 'keyframes.json'


class FrameSource(Protocol):
    """Where frames come from."""

    @property
    def name(self) -> str:
        """For people."""

    @property
    def identity(self) -> Mapping[str, object]:
        """Everything that the frames depend on; keys and values as `key_of` takes them."""

    @property
    def warnings(self) -> Sequence[str]:
        """What is to be said of the frames, once all were read."""

    def frames(self) -> Iterator[Frame]:
        """All frames, in the order in which they were taken."""


@dataclass(frozen=True)
class Keyframe:
    """A keyframe, as an image file.

    Attributes:
        name: Of the file; their order is the order of time.
        stamp_ns: When it was taken [ns].
        log_ns: When a recorder received it [ns].
        frame_id: Name of the camera's frame, where it has one.
        width: [px].
        height: [px].
    """

    name: str
    stamp_ns: int
    log_ns: int
    frame_id: str
    width: int
    height: int


@dataclass(frozen=True)
class Selection:
    """The keyframes of a source.

    Attributes:
        folder: Where their files are.
        keyframes: In the order of time.
        counts: What became of the frames.
        warnings: What is to be said of them.
    """

    folder: Path
    keyframes: tuple[Keyframe, ...]
    counts: KeyframeCounts
    warnings: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Of the files."""
        return tuple(keyframe.name for keyframe in self.keyframes)


@dataclass(frozen=True)
class Reference:
    """Something recorded along with the images that tells where they were taken.

    Attributes:
        source: What it is, for people.
        constraint: What a map of the images can be aligned with.
    """

    source: str
    constraint: Poses | Positions | GpsFixes


@dataclass(frozen=True)
class Capture:
    """What a video or a bag gives for a map.

    Attributes:
        name: Of video or bag, for people.
        images: The keyframes, with the cameras that are known.
        counts: What became of the frames.
        references: What a map of them can be aligned with, the best first.
        warnings: What is to be said of all that.
    """

    name: str
    images: ImageSet
    counts: KeyframeCounts
    references: tuple[Reference, ...] = ()
    warnings: tuple[str, ...] = ()


def keep_keyframes(source: FrameSource, workspace: Workspace) -> Selection:
    """Chooses keyframes and stores them in a workspace; takes them from there when they are there.

    Raises:
        MapBuildError: There are no keyframes, or they cannot be stored.
        RelocalizerError: The source cannot be read.
    """
    key = key_of(
        **source.identity,
        jpeg_quality=JPEG_QUALITY,
        software=[__version__, cv2.__version__],
    )
    if workspace.finished(STEP, key) is None:
        with workspace.scratch() as scratch:
            _write_keyframes(source, scratch)
            with workspace.writing(STEP, key) as folder:
                for file in scratch.iterdir():
                    file.rename(folder / file.name)
    return _read_selection(workspace.path / STEP / key)


def _write_keyframes(source: FrameSource, folder: Path) -> None:
    keyframes: list[Keyframe] = []

    def keep(frame: Frame) -> None:
        keyframe = _keyframe(frame)
        (folder / keyframe.name).write_bytes(_jpeg(frame))
        keyframes.append(keyframe)

    counts = select_keyframes(source.frames(), keep)
    if not keyframes:
        msg = (
            f'{source.name}: no frame can be used: {counts.read} were read, {counts.empty} of them '
            f'show nothing (black, or of one colour)'
        )
        raise MapBuildError(msg)
    selection = {
        'keyframes': [asdict(keyframe) for keyframe in keyframes],
        'counts': asdict(counts),
        'warnings': [*source.warnings, *_warnings(counts)],
    }
    (folder / _SELECTION).write_text(json.dumps(selection, indent=1), encoding='utf-8')


def _read_selection(folder: Path) -> Selection:
    stored = json.loads((folder / _SELECTION).read_text(encoding='utf-8'))
    return Selection(
        folder=folder,
        keyframes=tuple(Keyframe(**keyframe) for keyframe in stored['keyframes']),
        counts=KeyframeCounts(**stored['counts']),
        warnings=tuple(stored['warnings']),
    )


def _keyframe(frame: Frame) -> Keyframe:
    height, width = frame.image.shape[:2]
    seconds, milliseconds = divmod(frame.stamp_ns // MILLISECOND, 1000)
    name = f'{seconds:06d}.{milliseconds:03d}.jpg'
    return Keyframe(name, frame.stamp_ns, frame.log_ns, frame.frame_id, width, height)


def _jpeg(frame: Frame) -> bytes:
    image = frame.image
    stored = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode('.jpg', stored, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return bytes(data)


def _warnings(counts: KeyframeCounts) -> Iterator[str]:
    if counts.late:
        yield (
            f'{counts.late} of {counts.read} images are left out, since their stamps are not after '
            f'those of the images before them'
        )
