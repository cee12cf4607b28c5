# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Renders the walk that `maps/demo` was built from, and the robot's drive, as folders of images.

python scripts/render_demo_images.py OUT

OUT/walk and OUT/drive each get `images/`, `camera.txt` and `poses.txt` (camera_from_map). The drive
is that of `gam_relocalizer demo`, an image for each of its attempts.
"""

from __future__ import annotations

import sys
from pathlib import Path

from rich.progress import Progress, TaskID

from gam_relocalizer.cli.demo import DURATION_S, PERIOD_S
from gam_relocalizer.demo.recording import record_drive_images, record_mapping_pass
from gam_relocalizer.demo.world import demo_world


def main() -> None:
    """Renders both."""
    out = Path(sys.argv[1])
    with Progress() as bars:

        def show(task: TaskID, done: int, total: int) -> None:
            bars.update(task, completed=done, total=total)

        walk, drive = (bars.add_task(name, total=None) for name in ('walk', 'drive'))
        record_mapping_pass(demo_world(), out / 'walk', progress=lambda *at: show(walk, *at))
        record_drive_images(
            demo_world(rearranged=True),
            out / 'drive',
            period_s=PERIOD_S,
            duration_s=DURATION_S,
            progress=lambda *at: show(drive, *at),
        )


if __name__ == '__main__':
    main()
