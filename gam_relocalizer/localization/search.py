# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""In which order the scenes of a map are tried, and when it is enough."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING

from gam_relocalizer.localization.retrieval import images_near, retrieve
from gam_relocalizer.localization.scenes import scenes_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    import numpy as np
    from numpy.typing import NDArray

    from gam_relocalizer.localization.localizer import LocalizerOptions
    from gam_relocalizer.localization.prior import PositionHint
    from gam_relocalizer.localization.result import LocalizationResult
    from gam_relocalizer.localization.scenes import Scene
    from gam_relocalizer.scene_map import SceneMap

# A pose that was found ends the search but for scenes whose image looks this much as alike as that
# of the scene where it was found, or more: they may be the same thing in another place.
COMPETING_SCORE = 0.95


@dataclass(frozen=True)
class Candidate:
    """A scene to try.

    Attributes:
        scene: The scene.
        score: Similarity of its image and the query.
    """

    scene: Scene
    score: float


def candidates(
    global_descriptor: NDArray[np.float32],
    scene_map: SceneMap,
    options: LocalizerOptions,
    hint: PositionHint | None = None,
) -> Iterator[Candidate]:
    """Scenes in the order in which they are to be tried, made on demand.

    With a hint these are the scenes of the images most alike near it, and then all scenes that come
    without the hint, in their order; some come twice.

    Args:
        global_descriptor: [G] of the query.
        scene_map: The map.
        options: How many images and scenes, and how these are made of those.
        hint: Where to look first.
    """
    count = options.retrieved_images
    everywhere = retrieve(global_descriptor, scene_map, count).by_image()
    if hint is not None:
        within = images_near(hint, scene_map)
        near = retrieve(global_descriptor, scene_map, count, within).by_image()
        # The others follow, so that a cluster near the hint is no smaller than it is without one:
        # what else in it looks alike stays in view.
        scenes = _scenes({**near, **everywhere}, scene_map, options)
        yield from islice((each for each in scenes if each.scene.image in near), options.max_scenes)
    yield from islice(_scenes(everywhere, scene_map, options), options.max_scenes)


def search(
    ordered: Iterable[Candidate],
    localize_in: Callable[[Scene], LocalizationResult],
    enough_inliers: int,
) -> list[LocalizationResult]:
    """Tries scenes until a pose is found, each once, and those that may contest it.

    What is left out looks clearly less like the query than a scene that has its pose. So whoever
    orders the scenes decides when a place is tried, not whether a rival of the pose is.

    Args:
        ordered: The scenes.
        localize_in: Localizes the query in a scene.
        enough_inliers: An accepted pose with so many inliers is found.

    Returns:
        One result for each scene tried.
    """
    tried: dict[tuple[int, frozenset[int]], LocalizationResult] = {}
    least_score = -math.inf
    for candidate in ordered:
        scene = (candidate.scene.image, frozenset(candidate.scene.images.tolist()))
        if scene in tried or candidate.score < least_score:
            continue
        result = localize_in(candidate.scene)
        tried[scene] = result
        if result.accepted and result.inliers >= enough_inliers:
            competing = min(COMPETING_SCORE * candidate.score, candidate.score)  # may be negative
            least_score = max(least_score, competing)
    return list(tried.values())


def _scenes(
    scores: Mapping[int, float], scene_map: SceneMap, options: LocalizerOptions
) -> Iterator[Candidate]:
    """Scenes of retrieved images, which come with their scores."""
    for scene in scenes_of(scores, scene_map, options.coarse, options.scene_images):
        yield Candidate(scene, scores[scene.image])
