# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Maps with something changed: taken apart, changed, and made again."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.scene_map import MapContent, SceneMap, map_in_memory

if TYPE_CHECKING:
    from collections.abc import Callable


def changed_map(scene_map: SceneMap, change: Callable[[MapContent], MapContent]) -> SceneMap:
    """A map in the frame of its SfM with a change to what it is made of."""
    offsets, points = scene_map.observations()
    content = MapContent(
        image_names=scene_map.image_names,
        camera_from_sfm=scene_map.camera_from_map,
        points=scene_map.points,
        descriptors=scene_map.descriptors_of(np.arange(scene_map.num_points)),
        observation_offsets=offsets,
        observation_points=points,
        global_descriptors=all_global_descriptors(scene_map),
        codebook=scene_map.codebook,
    )
    return map_in_memory(scene_map.path, change(content), scene_map.manifest)


def of_first_images(content: MapContent, count: int) -> MapContent:
    """What is left when only the first images were taken."""
    offsets = content.observation_offsets[: count + 1]
    return replace(
        content,
        image_names=content.image_names[:count],
        camera_from_sfm=content.camera_from_sfm[:count],
        observation_offsets=offsets,
        observation_points=content.observation_points[: offsets[-1]],
        global_descriptors=content.global_descriptors[:count],
    )


def all_global_descriptors(scene_map: SceneMap) -> np.ndarray:
    """[I,G]."""
    dimension = scene_map.manifest.global_dimension
    rows = [scene_map.global_descriptor_of(image) for image in range(scene_map.num_images)]
    return np.array(rows, np.float32).reshape(-1, dimension)


def with_points(scene_map: SceneMap, points: np.ndarray) -> SceneMap:
    """The map with other places for its points [N,3]."""
    return changed_map(scene_map, lambda content: replace(content, points=points))
