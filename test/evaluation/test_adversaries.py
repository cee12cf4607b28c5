# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What adversaries do to views and maps, and what they say is still true."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st
from map_content import all_global_descriptors, with_points
from scipy.spatial.transform import Rotation
from synthetic_place import Place, save_place

from gam_relocalizer.evaluation.adversaries import (
    ADVERSARIES,
    WINDOW_SHARE,
    View,
    another_building,
    is_false_accept,
    metre_of,
    with_mixed_up_descriptors,
)
from gam_relocalizer.geometry import rigid3d_from_rotation

if TYPE_CHECKING:
    from gam_relocalizer.scene_map import SceneMap

POSE = rigid3d_from_rotation(Rotation.from_rotvec([0.2, -0.1, 0.3]), (0.5, -0.2, 1.5))
NO_POSE_IS_RIGHT = ('black', 'white', 'noise', 'mirrored', 'scrambled', 'photograph', 'poster')
PINHOLE = ('PINHOLE', [430.0, 428.0, 168.0, 121.0])
DISTORTED = ('FULL_OPENCV', [430.0, 428.0, 168.0, 121.0, 0.1, -0.05, 0.01, -0.02, 0.01, 0, 0, 0])


def make_view(camera: tuple[str, list[float]] = PINHOLE, channels: int = 3) -> View:
    rng = np.random.default_rng(7)
    image = rng.integers(0, 256, (240, 320, 3), dtype=np.uint8)
    model, params = camera
    made = pycolmap.Camera(camera_id=1, model=model, width=320, height=240, params=params)
    return View(image if channels == 3 else np.ascontiguousarray(image[..., 0]), made, POSE)


def spoilt(name: str, view: View, seed: int = 0) -> View:
    return ADVERSARIES[name](view, np.random.default_rng(seed))


def moved(position: float, degrees: float) -> pycolmap.Rigid3d:
    """POSE with the camera elsewhere in the map."""
    turn = Rotation.from_euler('z', degrees, degrees=True)
    map_from_camera = POSE.inverse()
    there = rigid3d_from_rotation(
        turn * Rotation.from_matrix(map_from_camera.rotation.matrix()),
        map_from_camera.translation + np.array([position, 0.0, 0.0]),
    )
    return there.inverse()


@pytest.mark.parametrize('name', ADVERSARIES)
@pytest.mark.parametrize('channels', [1, 3])
def test_images_keep_their_shape(name: str, channels: int) -> None:
    view = make_view(channels=channels)
    found = spoilt(name, view)
    assert found.image.shape == view.image.shape
    assert found.image.dtype == np.uint8
    assert found.image.flags.c_contiguous


@pytest.mark.parametrize('name', ADVERSARIES)
def test_same_seed_does_the_same(name: str) -> None:
    first, second = (spoilt(name, make_view(), seed=5) for _ in range(2))
    np.testing.assert_array_equal(first.image, second.image)
    np.testing.assert_array_equal(first.camera.params, second.camera.params)


@pytest.mark.parametrize('name', ADVERSARIES)
def test_a_view_is_left_as_it_is(name: str) -> None:
    view, before = make_view(), make_view()
    spoilt(name, view)
    np.testing.assert_array_equal(view.image, before.image)
    np.testing.assert_array_equal(view.camera.params, before.camera.params)


@pytest.mark.parametrize('name', ADVERSARIES)
def test_a_pose_is_right_only_where_the_place_can_be_seen_as_it_is(name: str) -> None:
    assert (spoilt(name, make_view()).camera_from_map is None) == (name in NO_POSE_IS_RIGHT)


def test_black_and_white_show_nothing() -> None:
    assert not spoilt('black', make_view()).image.any()
    assert (spoilt('white', make_view()).image == 255).all()


def test_mirroring_twice_changes_nothing() -> None:
    view = make_view()
    once = spoilt('mirrored', view)
    assert (once.image != view.image).any()
    np.testing.assert_array_equal(spoilt('mirrored', once).image, view.image)


@pytest.mark.parametrize('camera', [PINHOLE, DISTORTED])
def test_an_upside_down_camera_sees_every_point_at_the_opposite_pixel(
    camera: tuple[str, list[float]],
) -> None:
    view = make_view(camera)
    found = spoilt('upside-down', view)
    rng = np.random.default_rng(2)
    in_camera = np.column_stack([rng.uniform(-0.3, 0.3, (20, 2)), np.ones(20)]) * 3.0
    points = POSE.inverse() * in_camera
    pixels = view.camera.img_from_cam(POSE * points)
    turned = found.camera.img_from_cam(found.camera_from_map * points)
    np.testing.assert_allclose(turned, np.array([320.0, 240.0]) - pixels, atol=1e-9)
    np.testing.assert_array_equal(found.image[0, 0], view.image[-1, -1])


@given(seed=st.integers(0, 1000))
def test_no_tile_of_a_scrambled_view_is_at_its_place(seed: int) -> None:
    view = make_view()
    found = spoilt('scrambled', view, seed)
    is_same = (found.image == view.image).all(axis=2)
    # Of random pixels that moved, hardly one has the colour of the one that was there.
    assert is_same.mean() < 0.001


@given(seed=st.integers(0, 1000))
def test_an_occluded_view_shows_a_tenth_of_itself(seed: int) -> None:
    view = make_view()
    is_shown = (spoilt('occluded', view, seed).image == view.image).all(axis=2)
    assert is_shown.mean() == pytest.approx(WINDOW_SHARE, abs=0.01)
    rows, columns = (
        np.flatnonzero(is_shown.mean(axis=1) > 0.1),
        np.flatnonzero(is_shown.mean(axis=0) > 0.1),
    )
    assert is_shown[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].all()


@given(seed=st.integers(0, 1000))
def test_a_photograph_fills_the_view(seed: int) -> None:
    view = make_view()
    white = replace(view, image=np.full_like(view.image, 255))
    # Beyond the print would be a wall of the mean colour: paint all but the middle of it black.
    white.image[1:-1, 1:-1] = 200
    found = spoilt('photograph', white, seed)
    assert (found.image >= 200).all()
    assert (spoilt('photograph', view, seed).image != view.image).any()


@given(seed=st.integers(0, 1000))
def test_a_poster_hangs_on_a_bare_wall(seed: int) -> None:
    view = make_view()
    image = spoilt('poster', view, seed).image
    wall = image[0, 0]
    is_wall = (image == wall).all(axis=2)
    assert 0.3 < is_wall.mean() < 0.95
    assert is_wall[[0, 0, -1, -1], [0, -1, 0, -1]].all()


@pytest.mark.parametrize('camera', [PINHOLE, DISTORTED])
def test_wrong_focal_lengths_change_the_focal_length_only(
    camera: tuple[str, list[float]],
) -> None:
    view = make_view(camera)
    for name, factor in (('focal-length-too-long', 1.2), ('focal-length-too-short', 1 / 1.2)):
        found = spoilt(name, view)
        np.testing.assert_array_equal(found.image, view.image)
        np.testing.assert_allclose(found.camera.params[:2], factor * view.camera.params[:2])
        np.testing.assert_array_equal(found.camera.params[2:], view.camera.params[2:])


def test_another_building_has_no_right_pose() -> None:
    assert another_building(make_view()).camera_from_map is None


@pytest.fixture(scope='module')
def scene_map(tmp_path_factory: pytest.TempPathFactory) -> SceneMap:
    return save_place(tmp_path_factory.mktemp('place') / 'map', Place())


def test_mixing_up_descriptors_moves_every_descriptor_and_nothing_else(
    scene_map: SceneMap,
) -> None:
    before = scene_map
    after = with_mixed_up_descriptors(before, np.random.default_rng(0))
    np.testing.assert_array_equal(after.points, before.points)
    np.testing.assert_array_equal(all_global_descriptors(after), all_global_descriptors(before))
    everything = np.arange(before.num_points)
    descriptors = before.descriptors_of(everything), after.descriptors_of(everything)
    assert sorted(map(bytes, descriptors[0])) == sorted(map(bytes, descriptors[1]))
    assert (descriptors[0] == descriptors[1]).all(axis=1).mean() < 0.05


def test_an_accepted_pose_is_false_where_none_is_right() -> None:
    assert is_false_accept(POSE, None, 1.0)


@pytest.mark.parametrize(
    ('position', 'degrees', 'metre', 'is_false'),
    [
        (0.9, 9.0, 1.0, False),
        (1.1, 0.0, 1.0, True),
        (0.0, 11.0, 1.0, True),
        (1.1, 0.0, 1.2, False),
        (0.9, 0.0, 0.8, True),
    ],
)
def test_an_accepted_pose_is_false_beyond_a_metre_or_ten_degrees(
    position: float, degrees: float, metre: float, *, is_false: bool
) -> None:
    assert is_false_accept(moved(position, degrees), POSE, metre) is is_false


def test_a_metre_of_a_map_without_scale_grows_with_the_map(scene_map: SceneMap) -> None:
    assert metre_of(scene_map, metric=True) == 1.0
    poses = tuple(
        pycolmap.Rigid3d(rotation=pose.rotation, translation=3.0 * pose.translation)
        for pose in scene_map.camera_from_map
    )
    larger = replace(with_points(scene_map, 3.0 * scene_map.points), camera_from_map=poses)
    assert metre_of(larger, metric=False) == pytest.approx(3.0 * metre_of(scene_map, metric=False))
