# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Where the map of the demo scene lies: in a checkout, or where an installation puts it."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from gam_relocalizer.errors import MapError
from gam_relocalizer.scene_map import MANIFEST

_IN_CHECKOUT = Path('maps', 'demo')
_IN_PREFIX = Path('share', 'gam_relocalizer', 'maps', 'demo')


def demo_map_path() -> Path:
    """The bundle of the demo map.

    Raises:
        MapError: It is nowhere to be found.
    """
    ament_prefixes = os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
    candidates = [
        Path(__file__).resolve().parents[2] / _IN_CHECKOUT,
        *(Path(prefix) / _IN_PREFIX for prefix in [sys.prefix, *ament_prefixes] if prefix),
    ]
    for candidate in candidates:
        if (candidate / MANIFEST).is_file():
            return candidate
    msg = f'the demo map is not installed; looked in {", ".join(map(str, candidates))}'
    raise MapError(msg)
