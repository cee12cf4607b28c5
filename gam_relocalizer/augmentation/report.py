# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What an augmentation leaves: numbers as a table and as JSON, a sheet of frames, a page."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from html import escape
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from matplotlib.figure import Figure

from gam_relocalizer import pages
from gam_relocalizer.geometry import write_text
from gam_relocalizer.plots import DPI

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from gam_relocalizer.augmentation.jitter import Jitter, Spread
    from gam_relocalizer.augmentation.showing import Shown
    from gam_relocalizer.augmentation.tracking import Track, Way

ARROWS = 'arrows.yaml'
JITTER = 'jitter.json'
CONTACT_SHEET = 'contact_sheet.png'
PAGE = 'augmented.html'

HEADER = ('poses', 'frames', 'what', 'values', 'RMS [px]', 'median [px]', '95 % [px]', 'max [px]')

_KIND = 'gam_relocalizer augment'
_SHOWN_WIDTH_PX = 1600
_WAYS = {'frame_by_frame': 'each frame by itself', 'odometry': 'corrected odometry'}
_MEASURES = {
    'shake': 'shake, against the truth',
    'offset': 'offset, against the truth',
    'residual': 'shake, without the truth',
}


@dataclass(frozen=True)
class Augmentation:
    """All that is reported.

    Attributes:
        title: What was augmented.
        track: The frames.
        jitters: By way.
        shown: What was drawn.
        facts: What was run; values that JSON knows.
    """

    title: str
    track: Track
    jitters: Mapping[Way, Jitter]
    shown: Shown
    facts: Mapping[str, Any]


def table_rows(augmentation: Augmentation) -> list[list[str]]:
    """A row under `HEADER` for each way and measure."""
    return [
        [_WAYS[way.value], _frames(jitter), _MEASURES[name], *_cells(spread)]
        for way, jitter in augmentation.jitters.items()
        for name, spread in _spreads(jitter).items()
    ]


def write_augmentation(folder: Path, augmentation: Augmentation) -> None:
    """Writes numbers, sheet and page; equal poses give equal numbers.

    Args:
        folder: An existing one, with the videos in it.
        augmentation: What was found.
    """
    write_text(folder / JITTER, json.dumps(_as_json(augmentation), indent=2) + '\n')
    if augmentation.shown.sheet is not None:
        _write_png(folder / CONTACT_SHEET, augmentation.shown.sheet)
    write_text(folder / PAGE, _page(augmentation))


def _as_json(augmentation: Augmentation) -> dict[str, Any]:
    track = augmentation.track
    return {
        'kind': _KIND,
        **augmentation.facts,
        'frames': len(track.frames),
        'interval': track.interval,
        'corrections': track.corrections,
        'ways': {way.value: asdict(jitter) for way, jitter in augmentation.jitters.items()},
        'videos': augmentation.shown.videos,
    }


def _page(augmentation: Augmentation) -> str:
    tiles = {}
    for way, jitter in augmentation.jitters.items():
        spread = jitter.shake or jitter.residual
        tiles[f'of frames have a pose, {_WAYS[way.value]}'] = (
            f'{jitter.frames_with_pose / max(1, jitter.frames):.0%}'
        )
        if spread is not None:
            tiles[f'median shake, {_WAYS[way.value]}'] = f'{spread.median:.2f} px'
    parts = [
        pages.numbers(tiles),
        _links(augmentation.shown.videos),
        pages.heading('Shake of the arrows'),
        pages.paragraph(
            'Measured at the tails and tips of the arrows, where they lie in the image. Shake is '
            'the error that each frame makes for itself; offset is how far off arrows are drawn, '
            'all in all. Without the truth, shake is what a smooth motion over a quarter of a '
            'second to either side does not explain: it does not see an error that changes slowly, '
            'and takes jerks of the camera for shake.'
        ),
        pages.table(HEADER, table_rows(augmentation)),
    ]
    if augmentation.shown.sheet is not None:
        parts += [
            pages.heading('Frames'),
            pages.picture(
                _figure(augmentation.shown.sheet),
                'Frames evenly spread over the recording, left to right and top to bottom; with '
                'odometry, the same frame by it below. Nothing of the scene hides an arrow.',
            ),
        ]
    facts = [[name, str(value)] for name, value in augmentation.facts.items()]
    parts += [pages.heading('What was run'), pages.table(['', ''], facts)]
    return pages.page(augmentation.title, parts)


def _links(videos: Sequence[str]) -> str:
    """To the videos beside the page."""
    links = (f'<a href="{escape(name)}">{escape(name)}</a>' for name in videos)
    return f'<p>Videos, in the folder of this page: {", ".join(links)}</p>' if videos else ''


def _figure(sheet: NDArray[np.uint8]) -> Figure:
    height, width = sheet.shape[:2]
    scale = min(1.0, _SHOWN_WIDTH_PX / width)
    size = (round(width * scale), round(height * scale))
    figure = Figure(figsize=(size[0] / DPI, size[1] / DPI))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.imshow(cv2.resize(sheet, size, interpolation=cv2.INTER_AREA))
    axes.set_axis_off()
    return figure


def _write_png(path: Path, image: NDArray[np.uint8]) -> None:
    _, data = cv2.imencode('.png', cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    temporary = path.with_name(f'.{path.name}.part')
    temporary.write_bytes(np.asarray(data).tobytes())
    temporary.replace(path)


def _spreads(jitter: Jitter) -> dict[str, Spread]:
    """Those that could be measured, by name."""
    spreads = {name: getattr(jitter, name) for name in _MEASURES}
    return {name: spread for name, spread in spreads.items() if spread is not None}


def _frames(jitter: Jitter) -> str:
    return f'{jitter.frames_with_pose} of {jitter.frames}'


def _cells(spread: Spread) -> list[str]:
    sizes = (spread.rms, spread.median, spread.percentile_95, spread.largest)
    return [str(spread.count), *(f'{size:.2f}' for size in sizes)]
