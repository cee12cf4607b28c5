# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The whole application: from a recording and a map to videos with arrows, and their jitter."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from gam_relocalizer.augmentation.arrows import write_arrows
from gam_relocalizer.augmentation.drawing import arrow_ends
from gam_relocalizer.augmentation.jitter import jitter_of
from gam_relocalizer.augmentation.placing import up_of
from gam_relocalizer.augmentation.report import ARROWS, Augmentation, write_augmentation
from gam_relocalizer.augmentation.showing import show_track

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from gam_relocalizer.augmentation.arrows import Arrow
    from gam_relocalizer.augmentation.tracking import Track, TrackedFrame
    from gam_relocalizer.scene_map import SceneMap


def augment(
    folder: Path,
    track: Track,
    frames: Iterable[tuple[TrackedFrame, NDArray[np.uint8]]],
    arrows: Sequence[Arrow],
    scene_map: SceneMap,
    *,
    title: str,
    facts: Mapping[str, Any],
) -> Augmentation:
    """Draws, measures and writes everything.

    Args:
        folder: An existing one.
        track: Poses for all frames.
        frames: The frames that have an image, with it.
        arrows: What to draw.
        scene_map: The map that the poses are in.
        title: Of the page.
        facts: What was run; values that JSON knows.

    Raises:
        VideoError: A video cannot be written.
    """
    write_arrows(folder / ARROWS, arrows)
    ends = arrow_ends(arrows)
    jitters = {way: jitter_of(track, way, ends) for way in track.ways}
    shown = show_track(folder, track, frames, arrows, up_of(scene_map))
    augmentation = Augmentation(title, track, jitters, shown, facts)
    write_augmentation(folder, augmentation)
    return augmentation
