# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Builds the maps that the shipped weights were trained on, from short videos.

Every frame of a video becomes an image; each video is mapped from images alone, once with each
extractor. Prints the options that `gam_relocalizer train` wants.

    python scripts/build_training_maps.py DATA/walks --out build/training
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2

from gam_relocalizer.errors import UsageError
from gam_relocalizer.image_set import ImageSet
from gam_relocalizer.mapping.build import MapBuildOptions, build_map

VIDEOS = ('ditch_02', 'drone_park_01', 'holiday_display_01', 'stone_sign', 'tree_snow_01')
EXTRACTORS = ('xfeat', 'sift')


def main() -> None:
    """Maps every video with every extractor."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('videos', type=Path, help='folder of the videos')
    parser.add_argument('--out', type=Path, default=Path('build/training'))
    arguments = parser.parse_args()
    for name in VIDEOS:
        write_frames(arguments.videos / f'{name}.mp4', arguments.out / 'frames' / name)
    for extractor in EXTRACTORS:
        for name in VIDEOS:
            frames, out = arguments.out / 'frames' / name, arguments.out / f'{name}-{extractor}'
            build_map(ImageSet.of_folder(frames), out, MapBuildOptions(extractor=extractor))
            print(f'--map {out} --images {frames}', flush=True)


def write_frames(video: Path, folder: Path) -> None:
    """Writes every frame as a PNG, which loses nothing more.

    Raises:
        UsageError: The video is missing or empty.
    """
    folder.mkdir(parents=True, exist_ok=True)
    capture = cv2.VideoCapture(str(video))
    count = 0
    while (frame := capture.read())[0]:
        cv2.imwrite(str(folder / f'{count:04d}.png'), frame[1])
        count += 1
    if not count:
        msg = f'{video}: not a readable video'
        raise UsageError(msg)


if __name__ == '__main__':
    main()
