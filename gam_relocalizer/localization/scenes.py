# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Scene retrieval: from retrieved images to sets of 3D points (section 'Scene Retrieval')."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import Delaunay, QhullError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.scene_map import SceneMap


@dataclass(frozen=True)
class Scene:
    """An expanded scene of the paper.

    Attributes:
        image: The retrieved reference image it was expanded from.
        images: [m] int64 reference images in it, most covisible first; `image` leads.
        points: [N] int64 indices of the points these images see, ascending and unique.
    """

    image: int
    images: NDArray[np.int64]
    points: NDArray[np.int64]


def expanded_scenes(
    retrieved_images: Iterable[int], scene_map: SceneMap, size: int
) -> Iterator[Scene]:
    """Expands retrieved images one by one, on demand.

    An image that appeared in an earlier scene is skipped. Covisibility is not transitive: a scene
    holds neighbours of its image only, so it stays compact.

    Args:
        retrieved_images: Indices of reference images by descending score.
        scene_map: The map.
        size: Most images in one scene (m in the paper), the retrieved one included.
    """
    appeared: set[int] = set()
    for image in retrieved_images:
        if image in appeared:
            continue
        images = most_covisible(int(image), scene_map, size)
        appeared.update(images.tolist())
        seen = [scene_map.points_seen_by(index) for index in images]
        yield Scene(int(image), images, np.unique(np.concatenate(seen)).astype(np.int64))


def most_covisible(image: int, scene_map: SceneMap, size: int) -> NDArray[np.int64]:
    """The image itself and the images that share most points with it; ties go by lower index.

    Returns:
        [m] int64, 1 <= m <= size.
    """
    row = scene_map.covisibility[[image]]
    others = row.indices != image
    neighbours, shared = row.indices[others], row.data[others]
    order = np.lexsort((neighbours, -shared))[: size - 1]
    return np.concatenate([[image], neighbours[order]]).astype(np.int64)


def orientation_kept(
    camera_from_map: pycolmap.Rigid3d, points: NDArray[np.int64], scene: Scene, scene_map: SceneMap
) -> float:
    """How far a query and a reference image agree which way round they see the same points.

    Neighbouring points form triangles in the reference image. A camera that looks at the same side
    of the same surfaces sees them with the same orientation; one behind the wall sees mirror images
    and one at a random place sees both.

    Args:
        camera_from_map: Pose of the query.
        points: [K] indices of points that the query matched.
        scene: Where they were matched.
        scene_map: The map.

    Returns:
        Share of the triangles with the same orientation in both, 0 to 1; 0 where there are none.
    """
    seen = [np.isin(points, scene_map.points_seen_by(image)).sum() for image in scene.images]
    reference_from_map = scene_map.camera_from_map[scene.images[int(np.argmax(seen))]]
    in_reference = reference_from_map * scene_map.points[points]
    in_query = camera_from_map * scene_map.points[points]
    in_front = (in_reference[:, 2] > 0) & (in_query[:, 2] > 0)
    on_reference = in_reference[in_front, :2] / in_reference[in_front, 2:]
    on_query = in_query[in_front, :2] / in_query[in_front, 2:]
    try:
        triangles = Delaunay(on_reference).simplices
    except (QhullError, ValueError):  # fewer than three points, or all on a line
        return 0.0
    same = _signed_areas(on_reference[triangles]) * _signed_areas(on_query[triangles]) > 0
    return float(np.mean(same))


def _signed_areas(triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Twice the areas [T] of triangles [T,3,2], positive when anticlockwise."""
    first, second = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    areas: NDArray[np.float64] = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    return areas
