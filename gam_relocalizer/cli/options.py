# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

# Written out: the registry of the matchers imports torch, which takes seconds.
DEFAULT_MATCHER = 'gam'
MATCHERS = (
    'gam, bmnet, knn-bmnet, bmnet-small, bmnet-no-mining, plainnet, plainnet-hp, nn-lgcnet, '
    'nn-oanet, nn-ratio, nn-cross or nn-distance'
)

MatcherOption = Annotated[str, typer.Option('--matcher', help=f'2D-3D matcher: {MATCHERS}.')]
WeightsOption = Annotated[
    Path | None,
    typer.Option(
        '--weights',
        help='Weights file of the matcher, as `train` writes it; by default the shipped one.',
    ),
]
GlobalWeightsOption = Annotated[
    Path | None,
    typer.Option(
        '--global-weights',
        help='Weights file of NetVLAD; a map built with `--global netvlad` needs it.',
    ),
]

# What is read of a bag.
ImageTopicOption = Annotated[
    str | None,
    typer.Option('--image-topic', help='Image or CompressedImage; needed when there are several.'),
]
CameraInfoTopicOption = Annotated[
    str | None,
    typer.Option(
        '--camera-info-topic', help='CameraInfo; by default the one beside the image topic.'
    ),
]
TruthTopicOption = Annotated[
    str | None,
    typer.Option('--truth-topic', help='True poses of the base in the map frame, to compare with.'),
]
BaseFrameOption = Annotated[
    str,
    typer.Option('--base-frame', help='Frame whose pose is wanted; empty: that of the camera.'),
]
MapFrameOption = Annotated[str, typer.Option('--map-frame', help='Name of the frame of the poses.')]
CameraOption = Annotated[
    str | None,
    typer.Option(
        '--camera', help='File or text `MODEL WIDTH HEIGHT PARAMS...`; overrides CameraInfo.'
    ),
]
ImageIsRectifiedOption = Annotated[
    bool,
    typer.Option('--image-is-rectified', help='Use P of the CameraInfo, no distortion.'),
]
