# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Memory that is free in the process but not yet for the system."""

from __future__ import annotations

import ctypes


def give_back_freed_memory() -> None:
    """Hands free memory back to the system, after a map or a network is gone.

    The allocator of glibc keeps what one thread frees for that thread, in pieces: loading map after
    map, the process would hold more and more that nobody uses. Other C libraries do without.
    """
    trim = getattr(ctypes.CDLL(None), 'malloc_trim', None)
    if trim is not None:
        trim(0)
