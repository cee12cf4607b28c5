# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The one thread that owns the model."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

from gam_relocalizer.ros.attempt import carry_out

if TYPE_CHECKING:
    from collections.abc import Callable

    from gam_relocalizer.localization.localizer import Localizer, LocalizerOptions
    from gam_relocalizer.localization.result import LocalizationResult
    from gam_relocalizer.ros.attempt import Attempt
    from gam_relocalizer.scene_map import SceneMap


@dataclass(frozen=True)
class _Job:
    future: Future[LocalizationResult]
    on_result: Callable[[LocalizationResult], None]


class Worker:
    """Carries out one attempt at a time; there is no queue.

    All methods are for one thread, the one that spins the node.
    """

    def __init__(self, localizer: Localizer, on_done: Callable[[], None]) -> None:
        """Starts idle.

        Args:
            localizer: The model.
            on_done: Called from the worker's thread when `finish` has something to do.
        """
        self._localizer = localizer
        self._on_done = on_done
        self._job: _Job | None = None
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix='relocalizer')

    @property
    def busy(self) -> bool:
        """Whether an attempt is under way, or done and not yet finished."""
        return self._job is not None

    @property
    def map_id(self) -> str:
        """Identity of the map that the next attempt searches."""
        return self.scene_map.manifest.map_id

    @property
    def scene_map(self) -> SceneMap:
        """The map that the next attempt searches."""
        return self._localizer.scene_map

    def begin(self, attempt: Attempt, on_result: Callable[[LocalizationResult], None]) -> None:
        """Starts an attempt; the worker must not be busy.

        Args:
            attempt: The attempt.
            on_result: Called by `finish`.
        """
        if self.busy:
            msg = 'the worker is busy'
            raise RuntimeError(msg)
        future = self._pool.submit(carry_out, attempt, self._localizer)
        self._job = _Job(future, on_result)
        future.add_done_callback(lambda _future: self._on_done())

    def finish(self) -> None:
        """Hands on the result of an attempt that is over, which makes the worker idle.

        An exception of the attempt is raised here: it is a defect, and hiding it would leave a
        node that looks alive.
        """
        if self._job is None or not self._job.future.done():
            return
        job, self._job = self._job, None
        job.on_result(job.future.result())

    def use(self, options: LocalizerOptions) -> None:
        """Takes other options from the next attempt on."""
        self._localizer = self._localizer.with_options(options)

    def replace(self, localizer: Localizer) -> None:
        """Takes another model, with another map, from the next attempt on."""
        self._localizer = localizer

    def close(self) -> None:
        """Waits for the attempt under way, then ends the thread."""
        self._pool.shutdown(wait=True, cancel_futures=True)
