# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Which image is tried next: the newest one, once, and at most one per period."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

# An image this much older than the last one is no straggler: the source has started again.
RESTART_NS = 10**9


@dataclass(frozen=True)
class StampedImage:
    """An image message as it arrived.

    Attributes:
        message: sensor_msgs/Image or CompressedImage.
        stamp_ns: Stamp of the message [ns].
    """

    message: Any
    stamp_ns: int


class Schedule:
    """Holds the newest image and whether an attempt is due.

    The first attempt is due at once. Every period makes the next one due; while the worker is busy
    nothing piles up: there is room for one image, and being due twice is being due.
    """

    def __init__(self) -> None:
        self._newest: StampedImage | None = None
        self._due = True
        self._last_stamp_ns: int | None = None

    @property
    def ready(self) -> bool:
        """Whether an attempt is due and there is an image for it."""
        return self._due and self._newest is not None

    def offer(self, image: StampedImage) -> None:
        """Keeps an image in place of the one that was waiting."""
        self._newest = image

    def tick(self) -> None:
        """A period has passed."""
        self._due = True

    def rest(self) -> None:
        """Nothing is due until the next tick."""
        self._due = False

    def take(self) -> StampedImage:
        """The image to try now; it will not come again. Ask `ready` first."""
        if self._newest is None:
            msg = 'no image is waiting'
            raise RuntimeError(msg)
        image, self._newest = self._newest, None
        self._due = False
        return image

    def accepts(self, stamp_ns: int) -> bool:
        """Whether an image is newer than all tried before; if so it counts as tried."""
        if self._last_stamp_ns is not None and stamp_ns <= self._last_stamp_ns:
            return False
        self._last_stamp_ns = stamp_ns
        return True

    def went_back(self, stamp_ns: int) -> bool:
        """Whether a stamp lies so far before the last image that the source has started again."""
        return self._last_stamp_ns is not None and stamp_ns < self._last_stamp_ns - RESTART_NS

    def restart(self, *, due: bool = True) -> None:
        """Forgets images and stamps, as when time jumped back."""
        self._newest = None
        self._due = due
        self._last_stamp_ns = None
