# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import fields, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import poselib
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from map_content import changed_map, of_first_images, with_points

from gam_relocalizer.cameras import have_known_rays
from gam_relocalizer.mapping.colmap_model import NO_POINT
from gam_relocalizer.matching.bmnet import normalise_keypoints
from gam_relocalizer.training.labelled import TRUE_ERROR
from gam_relocalizer.training.map_views import FEWEST_KEYPOINTS, MapView, map_view

if TYPE_CHECKING:
    from gam_relocalizer.mapping.leave_one_out import ReferenceImage, ReferenceImages

ALL = (10_000, 10_000)
draws = settings(max_examples=40, deadline=None)
images = st.integers(0, 22)
seeds = st.integers(0, 10_000)


def drawn(
    references: ReferenceImages,
    image: int,
    seed: int,
    keypoints: tuple[int, int] = ALL,
    points: tuple[int, int] = ALL,
) -> MapView:
    """The first view from a seed on that is large enough."""
    for later in range(100):
        rng = np.random.default_rng([seed, later])
        view = map_view(references, image, rng, keypoints, points)
        if view is not None:
            return view
    raise AssertionError


def reference_of(references: ReferenceImages, view: MapView) -> tuple[int, np.ndarray]:
    """The image in whose frame the points of a view are, and their indices in the map."""
    scene_map = references.scene_map
    for image, camera_from_map in enumerate(scene_map.camera_from_map):
        in_camera = (camera_from_map * scene_map.points).astype(np.float32)
        apart = np.linalg.norm(in_camera[:, None] - view.points[None], axis=2)
        if apart.min(axis=0).max() < 1e-4:
            return image, np.asarray(apart.argmin(axis=0))
    raise AssertionError


def test_keypoints_without_a_known_ray_teach_nothing(references: ReferenceImages) -> None:
    camera = references.images[0].camera
    focal = camera.width / 4
    fisheye = pycolmap.Camera(
        camera_id=1,
        model='SIMPLE_FISHEYE',
        width=camera.width,
        height=camera.height,
        params=[focal, camera.width / 2, camera.height / 2],
    )
    by_fisheye = replace(
        references, images=tuple(replace(image, camera=fisheye) for image in references.images)
    )
    known = have_known_rays(references.images[0].keypoints, fisheye)
    sizes = set()
    for seed in range(20):
        view = drawn(by_fisheye, 0, seed)
        assert np.isfinite(view.keypoints).all()
        sizes.add(len(view.keypoints))
    assert max(sizes) == np.count_nonzero(known) < len(known)


@draws
@given(image=images, seed=seeds)
def test_true_edges_are_those_of_the_tracks(
    references: ReferenceImages, image: int, seed: int
) -> None:
    view = drawn(references, image, seed)
    query = references.images[image]
    reference, points = reference_of(references, view)

    of_view = np.append(points, NO_POINT)[view.rows]

    assert reference != image
    assert references.scene_map.covisibility[image, reference] > 0
    assert set(of_view[of_view != NO_POINT]) <= set(query.point_of_keypoint)
    edges = np.stack([np.arange(len(view.rows)), view.rows], axis=1)[view.rows != NO_POINT]
    assert view.labels(edges).all()
    # the place says the same as the track
    offsets = view.keypoints[edges[:, 0]] - view.projections[edges[:, 1]]
    assert np.linalg.norm(offsets, axis=1).max() < 0.5 * np.sqrt(2) / (1.2 * 640)


def test_an_edge_of_a_track_is_true_however_badly_its_point_was_triangulated(
    references: ReferenceImages,
) -> None:
    scene_map = references.scene_map
    aside = with_points(scene_map, scene_map.points + np.array([1.0, 0.0, 0.0]))

    view = drawn(replace(references, scene_map=aside), 0, 0)

    edges = np.stack([np.arange(len(view.rows)), view.rows], axis=1)[view.rows != NO_POINT]
    offsets = view.keypoints[edges[:, 0]] - view.projections[edges[:, 1]]
    assert np.linalg.norm(offsets, axis=1).min() > TRUE_ERROR
    assert view.labels(edges).all()


@draws
@given(image=images, seed=seeds)
def test_keypoints_and_points_keep_their_descriptors(
    references: ReferenceImages, image: int, seed: int
) -> None:
    view = drawn(references, image, seed, points=(100, 400))
    observing = np.flatnonzero(view.rows != NO_POINT)

    alike = view.descriptors @ view.point_descriptors.T

    of_track = alike[observing, view.rows[observing]]
    assert of_track.min() > 0.3
    assert of_track.mean() > alike[observing].mean() + 0.5


@draws
@given(image=images, seed=seeds)
def test_an_edge_without_track_is_true_where_the_point_projects_to_the_keypoint(
    references: ReferenceImages, image: int, seed: int
) -> None:
    view = drawn(references, image, seed)
    edges = np.argwhere(np.ones((len(view.keypoints), len(view.points)), bool))
    offsets = view.keypoints[edges[:, 0]] - view.projections[edges[:, 1]]
    in_track = view.rows[edges[:, 0]] == edges[:, 1]

    labels = view.labels(edges)

    np.testing.assert_array_equal(labels, in_track | (np.linalg.norm(offsets, axis=1) < TRUE_ERROR))


@draws
@given(image=images, seed=seeds)
def test_descriptors_of_points_are_means_that_leave_the_query_out(
    references: ReferenceImages, image: int, seed: int
) -> None:
    query = references.images[image]
    # a query that looks like nothing else would give itself away
    strange = np.zeros_like(query.descriptors)
    strange[:, 0] = 1e3
    changed = list(references.images)
    changed[image] = replace(query, descriptors=strange)
    sums = references.descriptor_sums.copy()
    observes = query.point_of_keypoint != NO_POINT
    sums[query.point_of_keypoint[observes]] += 1e3
    other = replace(references, images=tuple(changed), descriptor_sums=sums)

    view, again = drawn(references, image, seed), drawn(other, image, seed)

    np.testing.assert_array_equal(view.point_descriptors, again.point_descriptors)
    np.testing.assert_allclose(np.linalg.norm(view.point_descriptors, axis=1), 1, rtol=1e-5)


def test_descriptors_of_points_are_the_means_over_the_chosen_images(
    references: ReferenceImages,
) -> None:
    few = replace(
        references,
        scene_map=changed_map(references.scene_map, partial(of_first_images, count=3)),
        images=references.images[:3],
    )
    found = {'both': 0, 'one': 0}
    for seed in range(20):
        view = drawn(few, 0, seed)
        _, points = reference_of(few, view)
        others = [few.images[1], few.images[2]]
        by_hand = [_mean(part, points) for part in (others, others[:1], others[1:])]
        right = [
            np.allclose(mean, view.point_descriptors, atol=1e-5)
            for mean in by_hand
            if mean is not None
        ]
        assert any(right)
        found['both' if right[0] else 'one'] += 1

    assert min(found.values()) > 0


def _mean(images: list[ReferenceImage], points: np.ndarray) -> np.ndarray | None:
    """Unit means over images; None if some point is in none of them."""
    means = []
    for point in points:
        rows = [image.descriptors[image.point_of_keypoint == point] for image in images]
        together = np.concatenate(rows)
        if not len(together):
            return None
        mean = together.mean(axis=0)
        means.append(mean / np.linalg.norm(mean))
    return np.array(means)


@pytest.mark.parametrize('seed', range(12))
def test_after_roll_and_crop_one_camera_still_sees_the_true_edges(
    references: ReferenceImages, seed: int
) -> None:
    view = drawn(references, seed, seed)
    edges = np.stack([np.arange(len(view.rows)), view.rows], axis=1)[view.rows != NO_POINT]
    camera = {
        'model': 'SIMPLE_PINHOLE',
        'width': 2,
        'height': 2,
        'params': [view.focal_length, 0, 0],
    }

    _, info = poselib.estimate_absolute_pose(
        view.keypoints[edges[:, 0]].astype(float),
        view.points[edges[:, 1]].astype(float),
        camera,
        {'max_reproj_error': TRUE_ERROR / 4},
        {},
    )

    assert info['inlier_ratio'] > 0.99


def test_some_views_are_rolled_and_some_are_cropped(references: ReferenceImages) -> None:
    query = references.images[0]
    radii = np.sort(np.linalg.norm(normalise_keypoints(query.keypoints, query.camera), axis=1))
    turned, whole = [], []
    for seed in range(40):
        view = drawn(references, 0, seed)
        mine = np.linalg.norm(view.keypoints, axis=1)
        # a turn about the optical axis keeps the distance from it
        nearest = np.abs(radii[None] - mine[:, None]).min(axis=1)
        assert nearest.max() < 1e-6
        whole.append(len(view.keypoints) == len(query.keypoints))
        extent = np.ptp(view.keypoints, axis=0)
        turned.append(extent[1] > extent[0])

    assert 0.4 < np.mean(whole) < 0.8
    assert 0.02 < np.mean(turned) < 0.5


def test_sizes_are_within_their_limits(references: ReferenceImages) -> None:
    for seed in range(20):
        view = drawn(references, 1, seed, (40, 60), (100, 150))

        assert FEWEST_KEYPOINTS <= len(view.keypoints) <= 60
        assert len(view.points) <= 150
        assert len(view.keypoints) == len(view.descriptors) == len(view.rows)
        assert len(view.points) == len(view.point_descriptors) == len(view.projections)


def test_views_too_small_to_learn_from_are_none(references: ReferenceImages) -> None:
    rng = np.random.default_rng(0)
    sees_nothing = len(references.images) - 1

    assert map_view(references, sees_nothing, rng, ALL, ALL) is None
    assert map_view(references, 0, rng, (8, 8), ALL) is None
    assert map_view(references, 0, rng, ALL, (8, 8)) is None


def test_points_behind_the_camera_project_nowhere(references: ReferenceImages) -> None:
    scene_map = references.scene_map
    behind = scene_map.camera_from_map[0].inverse() * np.array([[0.0, 0.0, -5.0]])
    positions = scene_map.points.copy()
    positions[::2] = behind
    view = drawn(replace(references, scene_map=with_points(scene_map, positions)), 0, 0)

    hidden = np.isnan(view.projections).any(axis=1)

    assert 0.3 < hidden.mean() < 0.7
    strays = np.flatnonzero(hidden)
    others = np.flatnonzero(view.rows == NO_POINT)[:1]
    assert not view.labels(np.stack([np.repeat(others, len(strays)), strays], axis=1)).any()


def test_half_of_the_views_look_as_the_image_does(references: ReferenceImages) -> None:
    own = references.images[3].descriptors
    alike = []
    for seed in range(40):
        view = drawn(references, 3, seed)
        np.testing.assert_allclose(np.linalg.norm(view.descriptors, axis=1), 1, rtol=1e-5)
        alike.append((view.descriptors @ own.T).max(axis=1).min())

    assert 0.3 < np.mean(np.array(alike) > 1 - 1e-5) < 0.7
    assert min(alike) > 0.75


def test_same_generator_same_view(references: ReferenceImages) -> None:
    first, same, other = (drawn(references, 2, seed) for seed in (5, 5, 6))

    for field in fields(MapView):
        np.testing.assert_array_equal(getattr(first, field.name), getattr(same, field.name))
    assert not np.array_equal(first.keypoints, other.keypoints)


def test_drawing_changes_nothing_in_the_map(references: ReferenceImages) -> None:
    images_before = [image.descriptors.copy() for image in references.images]
    sums_before = references.descriptor_sums.copy()

    for seed in range(5):
        drawn(references, 4, seed)

    np.testing.assert_array_equal(references.descriptor_sums, sums_before)
    for image, before in zip(references.images, images_before, strict=True):
        np.testing.assert_array_equal(image.descriptors, before)
