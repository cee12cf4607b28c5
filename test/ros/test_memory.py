# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

from gam_relocalizer.ros.memory import give_back_freed_memory

KIBIBYTES = 1024
BLOCK = 4 * KIBIBYTES  # far below what the allocator asks the system for by itself
BLOCKS = 16 * KIBIBYTES


def own_kib() -> int:
    lines = Path('/proc/self/status').read_text(encoding='utf-8').splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith('RssAnon:'))


def test_memory_that_was_freed_in_pieces_goes_back_to_the_system() -> None:
    blocks = [bytearray(BLOCK) for _ in range(BLOCKS)]
    last = bytearray(BLOCK)  # keeps the end of the heap in use, so that it cannot shrink
    full = own_kib()
    del blocks
    give_back_freed_memory()
    assert full - own_kib() > BLOCKS * BLOCK / KIBIBYTES / 2
    assert len(last) == BLOCK
