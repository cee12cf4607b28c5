# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Memory that nobody uses any more but the process still holds."""

from __future__ import annotations

import ctypes
import gc


def give_back_freed_memory() -> None:
    """Hands unused memory back to the system, after a map or a network is gone.

    Subscriptions and what they call hold each other: left alone, Python keeps both, and the
    map with them, until some later time. And the allocator of glibc keeps what one thread frees for
    that thread, in pieces: loading map after map, the process would hold more and more that nobody
    uses. Other C libraries do without.
    """
    gc.collect()
    trim = getattr(ctypes.CDLL(None), 'malloc_trim', None)
    if trim is not None:
        trim(0)
