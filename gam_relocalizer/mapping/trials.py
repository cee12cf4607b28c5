# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Localizes each reference image in the map without it.

What a query gives at a place nobody photographed cannot be known. The nearest to it is a reference
image in the map that it is taken out of (`leave_one_out.py`): the whole pipeline runs, verdict
included, and the pose in the map is the one to be found.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from gam_relocalizer.features.registry import (
    DEFAULT_MAX_KEYPOINTS,
    create_extractor,
    global_descriptor_of,
)
from gam_relocalizer.geometry import pose_error
from gam_relocalizer.images import read_image
from gam_relocalizer.localization.localizer import Localizer, LocalizerOptions
from gam_relocalizer.mapping.coverage import (
    Coverage,
    LeftOut,
    Surroundings,
    standing_of,
    tolerance_of,
    weak_spots,
)
from gam_relocalizer.mapping.leave_one_out import map_without, read_reference_images
from gam_relocalizer.mapping.progress import ignore_progress
from gam_relocalizer.matching.registry import DEFAULT_MATCHER, create_matcher
from gam_relocalizer.plots import unit_of

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from gam_relocalizer.localization.result import LocalizationResult
    from gam_relocalizer.mapping.coverage import Tolerance
    from gam_relocalizer.mapping.progress import Progress
    from gam_relocalizer.scene_map import SceneMap


def measure_coverage(
    scene_map: SceneMap,
    folder: Path,
    *,
    every: int = 1,
    global_weights: Path | None = None,
    progress: Progress = ignore_progress,
) -> Coverage:
    """Localizes reference images in the map without them.

    Args:
        scene_map: A map with its COLMAP model.
        folder: The images that it was built from.
        every: Every so many-th image is left out; all are described, for they make the points.
        global_weights: Of the map's global descriptor, when it has any.
        progress: Told of the steps extract and localize.

    Raises:
        MapError: The map has no COLMAP model, or was made with descriptors that are not here.
        UsageError: There is no such folder, or weights are given to what has none.
        ImageError: An image is missing, unreadable, or not the one the map was built from.
        WeightsError: Weights are missing or damaged.
    """
    references = read_reference_images(scene_map, folder, progress)
    localizer_in = localizers_in(scene_map, global_weights)
    begin = time.monotonic()
    chosen = range(0, scene_map.num_images, every)
    tolerance = tolerance_of(scene_map)
    surroundings = Surroundings.of(scene_map)
    left_out = []
    for done, image in enumerate(chosen, start=1):
        localizer = localizer_in(map_without(references, image))
        pixels = read_image(folder / scene_map.image_names[image])
        result = localizer.localize(pixels, references.images[image].camera)
        left_out.append(_left_out(image, result, scene_map, tolerance, surroundings))
        progress('localize', done, len(chosen))
    return Coverage(
        images=tuple(left_out),
        tolerance=tolerance,
        unit=unit_of(scene_map),
        weak_spots=weak_spots(left_out, list(chosen), surroundings),
        seconds=time.monotonic() - begin,
    )


def localizers_in(
    scene_map: SceneMap, global_weights: Path | None
) -> Callable[[SceneMap], Localizer]:
    """What makes a localizer for a map that is much like this one; networks are loaded once."""
    options = LocalizerOptions()
    name = scene_map.manifest.extractor.name
    extractor = create_extractor(name, DEFAULT_MAX_KEYPOINTS)
    matcher = create_matcher(DEFAULT_MATCHER, extractor=name)
    describer = global_descriptor_of(scene_map, global_weights)
    return lambda changed: Localizer(changed, extractor, matcher, options, describer)


def _left_out(
    image: int,
    result: LocalizationResult,
    scene_map: SceneMap,
    tolerance: Tolerance,
    surroundings: Surroundings,
) -> LeftOut:
    estimate = result.estimate
    error = (
        None
        if estimate is None
        else pose_error(estimate.camera_from_map, scene_map.camera_from_map[image])
    )
    neighbours = int(surroundings.neighbours[image])
    x, y, z = surroundings.positions[image].tolist()
    dx, dy, dz = surroundings.directions[image].tolist()
    return LeftOut(
        name=scene_map.image_names[image],
        standing=standing_of(result, error, tolerance, neighbours),
        status=result.status.name,
        reason=result.reason,
        position=(x, y, z),
        direction=(dx, dy, dz),
        position_error=None if error is None else error.position,
        rotation_error_deg=None if error is None else error.rotation_deg,
        inliers=result.inliers,
        confidence=result.confidence,
        neighbours=neighbours,
        nearest=surroundings.nearest(image),
    )
