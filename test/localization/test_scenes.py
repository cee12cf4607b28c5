# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Retrieval of images and their expansion to scenes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from map_content import with_points

from gam_relocalizer.geometry import rigid3d_from
from gam_relocalizer.localization.prior import PositionHint
from gam_relocalizer.localization.retrieval import images_near, retrieve
from gam_relocalizer.localization.scenes import (
    Coarse,
    Scene,
    covisible_clusters,
    expanded_scenes,
    most_covisible,
    orientation_kept,
    scenes_of,
)
from gam_relocalizer.scene_map import (
    ExtractorIdentity,
    Manifest,
    MapContent,
    MapFrame,
    SceneMap,
    map_in_memory,
)


def make_map(seen: list[list[int]], num_points: int, global_descriptors=None) -> SceneMap:  # noqa: ANN001
    """A map of images that see the given points; all else is empty."""
    count = len(seen)
    described = np.zeros((count, 4)) if global_descriptors is None else global_descriptors
    return map_in_memory(
        Path('unused'),
        MapContent(
            image_names=tuple(f'{index}.png' for index in range(count)),
            camera_from_sfm=(rigid3d_from([1, 0, 0, 0], [0, 0, 0]),) * count,
            points=np.zeros((num_points, 3)),
            descriptors=np.zeros((num_points, 2), np.float16),
            observation_offsets=np.cumsum([0, *map(len, seen)], dtype=np.int64),
            observation_points=np.array([point for points in seen for point in points], np.int32),
            global_descriptors=np.asarray(described, np.float32),
            codebook=np.zeros((2, 2), np.float32),
        ),
        Manifest(ExtractorIdentity('none', 2, ''), 'vlad', MapFrame(), {}),
    )


# 0 - 1 - 2 share points in a chain, 3 stands alone
CHAIN = make_map([[0, 1, 2], [1, 2, 3, 4], [4, 5], [6, 7]], num_points=8)


def test_retrieves_by_descending_similarity() -> None:
    described = [[0.0, 1.0], [1.0, 0.0], [0.6, 0.8], [1.0, 0.0]]
    scene_map = make_map([[0]] * 4, 1, described)
    retrieved = retrieve(np.array([1.0, 0.0], np.float32), scene_map, 3)
    assert retrieved.images.tolist() == [1, 3, 2]
    np.testing.assert_allclose(retrieved.scores, [1.0, 1.0, 0.6], atol=0.02)


def test_small_maps_and_empty_descriptors_retrieve_what_they_can() -> None:
    scene_map = make_map([[0]], 1, [[1.0, 0.0]])
    assert len(retrieve(np.array([1.0, 0.0], np.float32), scene_map, 10)) == 1
    assert len(retrieve(np.zeros(2, np.float32), scene_map, 10)) == 0
    assert len(retrieve(np.ones(4, np.float32), make_map([], 0), 10)) == 0


def test_retrieves_only_among_the_images_it_may_choose_from() -> None:
    described = [[0.0, 1.0], [1.0, 0.0], [0.6, 0.8], [1.0, 0.0]]
    scene_map = make_map([[0]] * 4, 1, described)
    query = np.array([1.0, 0.0], np.float32)
    among = np.array([True, False, True, True])
    assert retrieve(query, scene_map, 2, among).images.tolist() == [3, 2]
    assert list(retrieve(query, scene_map, 10, among).by_image()) == [3, 2, 0]
    assert len(retrieve(query, scene_map, 10, np.zeros(4, bool))) == 0


@pytest.mark.parametrize(
    ('position', 'radius', 'near'),
    [
        ([2.1, 0.0, 0.0], 0.0, [2]),
        ([2.1, 0.0, 0.0], 1.0, [1, 2, 3]),
        ([2.0, 0.5, 0.0], 0.2, [2]),  # no camera within the radius itself
        ([50.0, 0.0, 0.0], 1.5, [2, 3]),  # outside the map
        ([0.0, 0.0, 0.0], np.inf, [0, 1, 2, 3]),
    ],
)
def test_radius_is_counted_from_the_nearest_camera(
    position: list[float], radius: float, near: list[int]
) -> None:
    turned = [0.5, 0.5, -0.5, 0.5]
    in_a_row = tuple(rigid3d_from(turned, [x, 0, 0]).inverse() for x in range(4))
    scene_map = replace(make_map([[0]] * 4, 1), camera_from_map=in_a_row)
    hint = PositionHint(np.array(position), radius)
    assert np.flatnonzero(images_near(hint, scene_map)).tolist() == near


def test_nothing_is_near_in_an_empty_map() -> None:
    assert len(images_near(PositionHint(np.zeros(3), 1.0), make_map([], 0))) == 0


def test_expansion_is_not_transitive() -> None:
    (scene,) = expanded_scenes([0], CHAIN, size=20)
    assert scene.images.tolist() == [0, 1]
    assert scene.points.tolist() == [0, 1, 2, 3, 4]


def test_most_covisible_come_first_and_size_counts_the_image_itself() -> None:
    assert most_covisible(1, CHAIN, size=3).tolist() == [1, 0, 2]
    assert most_covisible(1, CHAIN, size=2).tolist() == [1, 0]
    assert most_covisible(1, CHAIN, size=1).tolist() == [1]


def test_image_that_shares_nothing_is_a_scene_of_its_own() -> None:
    (scene,) = expanded_scenes([3], CHAIN, size=20)
    assert scene.images.tolist() == [3]
    assert scene.points.tolist() == [6, 7]


def test_skips_images_of_earlier_scenes() -> None:
    scenes = list(expanded_scenes([0, 1, 3, 2, 0], CHAIN, size=20))
    assert [scene.image for scene in scenes] == [0, 3, 2]


def test_expands_on_demand() -> None:
    def retrieved():  # noqa: ANN202
        yield 0
        pytest.fail('the second image was not asked for')

    assert next(expanded_scenes(retrieved(), CHAIN, size=20)).image == 0


def test_image_without_points_gives_an_empty_scene() -> None:
    scene_map = make_map([[], [0]], 1)
    (scene,) = expanded_scenes([0], scene_map, size=5)
    assert scene.images.tolist() == [0]
    assert len(scene.points) == 0


def test_expanded_scenes_are_those_of_the_paper() -> None:
    scenes = list(scenes_of([3, 1], CHAIN, Coarse.EXPANDED, size=2))
    assert [scene.images.tolist() for scene in scenes] == [[3], [1, 0]]


def test_together_is_one_scene_led_by_the_best_image() -> None:
    (scene,) = scenes_of([2, 0, 3, 2], CHAIN, Coarse.TOGETHER, size=1)
    assert scene.image == 2
    assert scene.images.tolist() == [2, 0, 3]
    assert scene.points.tolist() == [0, 1, 2, 4, 5, 6, 7]


def test_clusters_are_transitive_and_the_largest_comes_first() -> None:
    scenes = list(scenes_of([3, 2, 0, 1], CHAIN, Coarse.CLUSTERS, size=1))
    assert [scene.image for scene in scenes] == [2, 3]
    assert [scene.images.tolist() for scene in scenes] == [[2, 0, 1], [3]]
    assert scenes[0].points.tolist() == [0, 1, 2, 3, 4, 5]


def test_clusters_join_by_retrieved_images_only() -> None:
    # 0 and 2 share points with 1 only, which was not retrieved
    scenes = list(scenes_of([2, 3, 0], CHAIN, Coarse.CLUSTERS, size=20))
    assert [scene.images.tolist() for scene in scenes] == [[2], [3], [0]]


@pytest.mark.parametrize('coarse', list(Coarse))
def test_nothing_retrieved_gives_no_scene(coarse: Coarse) -> None:
    assert not list(scenes_of([], CHAIN, coarse, size=20))


def test_orientation_is_kept_in_front_of_a_wall_and_lost_behind_it() -> None:
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(-2.0, 2.0, (50, 2)), np.full(50, 5.0)])
    scene_map = with_points(make_map([list(range(50)), [0]], num_points=50), wall)
    scene = Scene(0, np.array([1, 0]), np.arange(50))
    in_front = rigid3d_from([0.98, 0.1, -0.1, 0.1], [0.5, -0.5, 1.0])
    behind = rigid3d_from([0, 0, 1, 0], [0, 0, 10])
    assert orientation_kept(in_front, np.arange(50), scene, scene_map) == 1.0
    assert orientation_kept(behind, np.arange(50), scene, scene_map) == 0.0


@pytest.mark.parametrize('points', [[], [0], [0, 1], [0, 1, 2]])
def test_too_few_points_or_a_line_keep_no_orientation(points: list[int]) -> None:
    line = np.array([[0.0, 0.0, 5.0], [1.0, 0.0, 5.0], [2.0, 0.0, 5.0]])
    scene_map = with_points(make_map([[0, 1, 2]], num_points=3), line)
    scene = Scene(0, np.array([0]), np.arange(3))
    camera_from_map = scene_map.camera_from_map[0]
    assert orientation_kept(camera_from_map, np.array(points, int), scene, scene_map) == 0.0


@given(
    seen=st.lists(st.sets(st.integers(0, 15)), min_size=1, max_size=8),
    size=st.integers(1, 6),
    seed=st.integers(0, 100),
)
def test_laws_of_expansion(seen: list[set[int]], size: int, seed: int) -> None:
    scene_map = make_map([sorted(points) for points in seen], 16)
    order = np.random.default_rng(seed).permutation(len(seen)).tolist()
    appeared: set[int] = set()
    for scene in expanded_scenes(order, scene_map, size):
        assert scene.image not in appeared
        assert scene.images[0] == scene.image
        assert len(set(scene.images)) == len(scene.images) <= size
        shared = [len(seen[scene.image] & seen[other]) for other in scene.images[1:]]
        assert all(shared)
        assert shared == sorted(shared, reverse=True)
        left_out = set(range(len(seen))) - set(scene.images)
        if shared and len(scene.images) == size:
            assert (
                max((len(seen[scene.image] & seen[i]) for i in left_out), default=0) <= shared[-1]
            )
        assert scene.points.tolist() == sorted(set().union(*(seen[i] for i in scene.images)))
        appeared |= set(scene.images.tolist())
    assert appeared == set(range(len(seen)))


@given(
    seen=st.lists(st.sets(st.integers(0, 15)), min_size=1, max_size=8),
    seed=st.integers(0, 100),
)
def test_laws_of_clusters(seen: list[set[int]], seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene_map = make_map([sorted(points) for points in seen], 16)
    images = rng.permutation(len(seen))[: rng.integers(1, len(seen) + 1)]
    clusters = covisible_clusters(images, scene_map)
    rank = {image: position for position, image in enumerate(images)}
    assert sorted(np.concatenate(clusters)) == sorted(images)
    points = [set().union(*(seen[image] for image in cluster)) for cluster in clusters]
    for one, cluster in enumerate(clusters):
        assert [rank[image] for image in cluster] == sorted(rank[image] for image in cluster)
        assert all(not points[one] & points[other] for other in range(one))
        reached, todo = set(), {cluster[0]}
        while todo:
            reached |= todo
            todo = {i for i in set(cluster) - reached if any(seen[i] & seen[j] for j in reached)}
        assert reached == set(cluster)
    order = [(-len(cluster), rank[cluster[0]]) for cluster in clusters]
    assert order == sorted(order)
