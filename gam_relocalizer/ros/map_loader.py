# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Loads another map beside the one in use."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING

from gam_relocalizer.errors import RelocalizerError
from gam_relocalizer.localization.localizer import Localizer

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from gam_relocalizer.localization.localizer import LocalizerOptions


class MapLoader:
    """One map at a time, in a thread of its own.

    All methods are for one thread, the one that spins the node.
    """

    def __init__(self, on_done: Callable[[], None]) -> None:
        """Starts idle.

        Args:
            on_done: Called from the loader's thread when `finish` has something to do.
        """
        self._on_done = on_done
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix='map_loader')
        self._loading: Future[Localizer] | None = None
        self._on_loaded: Callable[[Localizer | RelocalizerError], None] | None = None

    @property
    def busy(self) -> bool:
        """Whether a map is being loaded, or loaded and not yet handed on."""
        return self._loading is not None

    def begin(
        self,
        path: Path,
        options: LocalizerOptions,
        on_loaded: Callable[[Localizer | RelocalizerError], None],
    ) -> None:
        """Starts to load; the loader must not be busy.

        Args:
            path: Map bundle.
            options: How to search it.
            on_loaded: Called by `finish`, with what is wrong when it cannot be loaded.
        """
        if self.busy:
            msg = 'the loader is busy'
            raise RuntimeError(msg)
        self._on_loaded = on_loaded
        self._loading = self._pool.submit(Localizer.load, path, options)
        self._loading.add_done_callback(lambda _future: self._on_done())

    def finish(self) -> None:
        """Hands on what was loaded, which makes the loader idle."""
        if self._loading is None or self._on_loaded is None or not self._loading.done():
            return
        loading, on_loaded = self._loading, self._on_loaded
        self._loading = self._on_loaded = None
        try:
            localizer = loading.result()
        except RelocalizerError as err:
            on_loaded(err)
        else:
            on_loaded(localizer)

    def close(self) -> None:
        """Waits for what is being loaded, then ends the thread."""
        self._pool.shutdown(wait=True, cancel_futures=True)
