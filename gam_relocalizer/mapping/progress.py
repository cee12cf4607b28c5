# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""How long-running work tells where it stands, without knowing who listens."""

from __future__ import annotations

import time
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Iterator


class Progress(Protocol):
    """Is told every advance of a build."""

    def __call__(self, step: str, done: int, total: int) -> None:
        """`done` of `total` units of the named step are finished; a total of 0 is unknown."""


def ignore_progress(step: str, done: int, total: int) -> None:
    """Listens to nothing."""


@dataclass
class StepTimer:
    """Seconds spent per named step.

    Attributes:
        seconds: Step to seconds, in the order the steps were taken.
    """

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Times the block under that name."""
        start = time.monotonic()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.monotonic() - start
