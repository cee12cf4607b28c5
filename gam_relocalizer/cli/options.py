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
