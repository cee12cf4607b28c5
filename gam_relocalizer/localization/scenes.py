# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Scene retrieval: from retrieved images to sets of 3D points (section 'Scene Retrieval')."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, unique
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay, QhullError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.scene_map import SceneMap


@unique
class Coarse(Enum):
    """From retrieved images to scenes: the ways that Table II of the paper compares.

    `EXPANDED` (SR) expands each retrieved image by its most covisible ones. `TOGETHER` (IR) makes
    one scene of all retrieved images. `CLUSTERS` (CC; Sarlin et al., CVPR 2019) joins retrieved
    images that see common points, transitively, and takes the largest cluster first.
    """

    EXPANDED = 'expanded'
    TOGETHER = 'together'
    CLUSTERS = 'clusters'


@dataclass(frozen=True)
class Scene:
    """Reference images, and the points that a query is matched with.

    Attributes:
        image: The retrieved image that looks most like the query. The matcher gets the points in
            the frame of its camera, the best guess where the query was taken.
        images: [m] int64 reference images in it, `image` first: then the most covisible ones, or
            the retrieved ones by descending score.
        points: [N] int64 indices of the points these images see, ascending and unique.
    """

    image: int
    images: NDArray[np.int64]
    points: NDArray[np.int64]


def scenes_of(
    retrieved_images: Iterable[int], scene_map: SceneMap, coarse: Coarse, size: int
) -> Iterator[Scene]:
    """Makes scenes of retrieved images, on demand and in the order in which they are to be tried.

    Args:
        retrieved_images: Indices of reference images by descending score.
        scene_map: The map.
        coarse: The way.
        size: Most images in an expanded scene; the other ways take all images they are given.
    """
    if coarse is Coarse.EXPANDED:
        return expanded_scenes(retrieved_images, scene_map, size)
    images = np.array(list(dict.fromkeys(retrieved_images)), np.int64)
    if coarse is Coarse.TOGETHER:
        return iter([_scene_of(images, scene_map)] if len(images) else [])
    return (_scene_of(cluster, scene_map) for cluster in covisible_clusters(images, scene_map))


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
        yield _scene_of(images, scene_map)


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


def distinct(indices: NDArray[Any]) -> NDArray[Any]:
    """Some indices, from 0 on, without repetition, rising: `np.unique` at a tenth of its time."""
    rising = np.sort(indices)
    return rising[np.diff(rising, prepend=-1) > 0]


def covisible_clusters(images: NDArray[np.int64], scene_map: SceneMap) -> list[NDArray[np.int64]]:
    """Joins images that share a point, transitively (Sarlin et al., CVPR 2019).

    Args:
        images: [R] int64, unique, by descending score.
        scene_map: The map.

    Returns:
        Clusters, each by descending score; the largest first, ties by the better first image.
    """
    shared = scene_map.covisibility[images][:, images]
    count, cluster_of = connected_components(shared, directed=False)
    clusters = [images[cluster_of == cluster] for cluster in range(count)]
    rank = {int(image): position for position, image in enumerate(images)}
    return sorted(clusters, key=lambda cluster: (-len(cluster), rank[int(cluster[0])]))


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
    positions = scene_map.positions_of(points)
    in_reference, in_query = reference_from_map * positions, camera_from_map * positions
    in_front = (in_reference[:, 2] > 0) & (in_query[:, 2] > 0)
    on_reference = in_reference[in_front, :2] / in_reference[in_front, 2:]
    on_query = in_query[in_front, :2] / in_query[in_front, 2:]
    try:
        triangles = Delaunay(on_reference).simplices
    except (QhullError, ValueError):  # fewer than three points, or all on a line
        return 0.0
    same = _signed_areas(on_reference[triangles]) * _signed_areas(on_query[triangles]) > 0
    return float(np.mean(same))


def _scene_of(images: NDArray[np.int64], scene_map: SceneMap) -> Scene:
    """The scene of some images, the best retrieved one first."""
    seen = [scene_map.points_seen_by(image) for image in images]
    return Scene(int(images[0]), images, distinct(np.concatenate(seen)).astype(np.int64))


def _signed_areas(triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Twice the areas [T] of triangles [T,3,2], positive when anticlockwise."""
    first, second = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    areas: NDArray[np.float64] = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    return areas
