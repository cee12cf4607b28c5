# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import csr_matrix

from gam_relocalizer.mapping.selection import MIN_OBSERVERS, order_images, order_points
from gam_relocalizer.scene_map import load_map

if TYPE_CHECKING:
    from conftest import BuiltMap

# Three images of one wall and two of another, which share next to nothing; 3 and 4 are the same.
TWO_WALLS = np.array(
    [
        [50, 40, 20, 0, 0],
        [40, 60, 40, 1, 1],
        [20, 40, 50, 0, 0],
        [0, 1, 0, 30, 30],
        [0, 1, 0, 30, 30],
    ]
)


def stood_for(covisibility: np.ndarray, images: np.ndarray) -> float:
    """Mean share of an image's points that the best of some images sees."""
    shares = covisibility[:, images] / np.maximum(np.diag(covisibility), 1)[:, None]
    return float(shares.max(axis=1).mean())


def test_each_wall_is_stood_for_before_any_is_seen_twice() -> None:
    order = order_images(csr_matrix(TWO_WALLS))

    assert order[0] == 1
    assert order[1] == 3
    assert order[-1] == 4


@given(st.lists(st.lists(st.integers(0, 30), min_size=1, max_size=20), min_size=2, max_size=8))
def test_every_beginning_of_the_images_is_nearly_the_best_choice(seen: list[list[int]]) -> None:
    observed = np.zeros((len(seen), 31), np.int32)
    for image, points in enumerate(seen):
        observed[image, points] = 1
    covisibility = observed @ observed.T

    order = order_images(csr_matrix(covisibility))

    assert sorted(order.tolist()) == list(range(len(seen)))
    best = max(stood_for(covisibility, np.array([image])) for image in range(len(seen)))
    assert stood_for(covisibility, order[:1]) >= best - 1e-9


def test_every_image_keeps_points_and_long_tracks_come_first(posed_map: BuiltMap) -> None:
    scene_map = load_map(posed_map.path)
    images = np.arange(scene_map.num_images)
    tracks = np.bincount(
        np.concatenate([scene_map.points_seen_by(image) for image in images]),
        minlength=scene_map.num_points,
    )

    order = order_points(scene_map, images)

    first = order[: len(order) // 5]
    kept = [np.isin(scene_map.points_seen_by(image), first).sum() for image in images]
    evenly = np.random.default_rng(0).permutation(order)[: len(first)]
    by_chance = [np.isin(scene_map.points_seen_by(image), evenly).sum() for image in images]
    assert len(np.unique(order)) == len(order)
    assert tracks[first].mean() > tracks.mean()
    assert min(kept) > 1.3 * max(by_chance)


def test_points_that_too_few_of_the_images_see_are_left_out(posed_map: BuiltMap) -> None:
    scene_map = load_map(posed_map.path)
    images = np.array([0, 3, 6])
    seen = np.concatenate([scene_map.points_seen_by(image) for image in images])

    order = order_points(scene_map, images)

    tracks = np.bincount(seen, minlength=scene_map.num_points)
    assert set(order.tolist()) == set(np.flatnonzero(tracks >= MIN_OBSERVERS).tolist())
