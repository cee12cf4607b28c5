# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Renders the mapping walk through the demo scene and builds `maps/demo` from it.

python scripts/build_demo_map.py [OUT]
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from rich.progress import Progress

from gam_relocalizer.cameras import parse_camera
from gam_relocalizer.demo.recording import record_mapping_pass
from gam_relocalizer.demo.world import demo_world
from gam_relocalizer.geometry import read_poses
from gam_relocalizer.image_set import ImageSet
from gam_relocalizer.mapping.build import MapBuildOptions, build_map

DEFAULT_OUT = Path(__file__).resolve().parents[1] / 'maps' / 'demo'
# Keeps the bundle below 15 MB, for it is part of the repository.
MAX_KEYPOINTS = 1536


def main() -> None:
    """Builds the map from images with known poses, so that it lies in the frame of the scene."""
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else DEFAULT_OUT
    with tempfile.TemporaryDirectory() as folder, Progress() as progress:
        walk = Path(folder, 'walk')
        tasks = {}

        def show(step: str, done: int, total: int) -> None:
            if step not in tasks:
                tasks[step] = progress.add_task(step)
            progress.update(tasks[step], completed=done, total=total)

        record_mapping_pass(
            demo_world(), walk, progress=lambda done, total: show('render', done, total)
        )
        images = ImageSet.of_folder(
            walk / 'images',
            parse_camera(walk / 'camera.txt'),
            read_poses(walk / 'poses.txt'),
        )
        options = MapBuildOptions(max_keypoints=MAX_KEYPOINTS)
        report = build_map(images, out, options, show)
    size = sum(file.stat().st_size for file in out.rglob('*') if file.is_file())
    print(
        f'{out}: {report.images_registered} of {report.images_given} images, {report.points} '
        f'points, {report.mean_reprojection_error:.2f} px, {size / 1e6:.1f} MB'
    )


if __name__ == '__main__':
    main()
