# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gam_relocalizer.augmentation.arrows import Arrow
from gam_relocalizer.augmentation.drawing import HEAD_RADIUS, arrow_ends, draw_arrows
from gam_relocalizer.augmentation.projection import Field, clipped, in_image, project
from gam_relocalizer.cameras import parse_camera
from gam_relocalizer.geometry import rigid3d_from_rotation

if TYPE_CHECKING:
    from numpy.typing import NDArray

CAMERAS = {
    'pinhole': 'PINHOLE 160 120 110 112 81.5 59',
    'simple radial': 'SIMPLE_RADIAL 160 120 110 80 60 -0.12',
    'opencv': 'OPENCV 160 120 110 110 80 60 -0.3 0.08 0.001 -0.002',
    'full opencv': 'FULL_OPENCV 160 120 110 110 80 60 -0.2 0.05 0.001 0.001 0.01 0.02 0.01 0',
    'fisheye': 'OPENCV_FISHEYE 160 120 60 60 80 60 0.02 -0.005 0.001 0',
}
HERE = pycolmap.Rigid3d()
UP = np.array([0.0, -1.0, 0.0])
COORDINATE = st.floats(-4.0, 4.0)
PLACES = st.tuples(COORDINATE, COORDINATE, COORDINATE)
BACKGROUND = 90


def grey(camera: pycolmap.Camera) -> NDArray[np.uint8]:
    return np.full((camera.height, camera.width, 3), BACKGROUND, np.uint8)


def changed(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> NDArray[np.bool_]:
    return (before != after).any(axis=2)


def rays_in_the_image(camera: pycolmap.Camera) -> NDArray[np.float64]:
    xs, ys = np.meshgrid(np.linspace(12, 148, 9), np.linspace(12, 108, 7))
    return np.asarray(camera.cam_from_img(np.column_stack([xs.ravel(), ys.ravel()])))


@pytest.mark.parametrize('name', CAMERAS)
def test_points_in_view_are_projected_as_colmap_does(name: str) -> None:
    camera = parse_camera(CAMERAS[name])
    depths = np.linspace(0.5, 20.0, 63)[:, None]
    points = np.column_stack([rays_in_the_image(camera), np.ones(63)]) * depths
    pixels = project(camera, points)
    np.testing.assert_allclose(pixels, camera.img_from_cam(points), atol=1e-9)
    assert in_image(camera, pixels).all()


@pytest.mark.parametrize('name', CAMERAS)
def test_field_holds_all_that_the_image_shows(name: str) -> None:
    camera = parse_camera(CAMERAS[name])
    planes = Field.of(camera).planes(0.01)
    points = np.column_stack([rays_in_the_image(camera), np.ones(63)])
    assert (points @ planes[:, :3].T + planes[:, 3] > 0.0).all()


def test_nothing_behind_the_camera_is_projected() -> None:
    camera = parse_camera(CAMERAS['pinhole'])
    points = np.array([[0.0, 0.0, -1.0], [0.1, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert np.isfinite(project(camera, points)).all(axis=1).tolist() == [False, False, False, True]


def test_rays_beyond_the_distortion_model_are_not_folded_back_into_the_image() -> None:
    # at x/z = 1.8 the radius has long turned back: 1.8 (1 - 0.3 * 1.8^2) is a small one
    camera = parse_camera('SIMPLE_RADIAL 640 480 400 320 240 -0.3')
    ray = np.array([[1.8, 0.0, 1.0]])
    folded = np.asarray(camera.img_from_cam(ray))
    assert in_image(camera, folded).all()
    assert np.isnan(project(camera, ray)).all()


@settings(deadline=None)
@given(st.lists(PLACES, min_size=3, max_size=3))
def test_clipping_keeps_exactly_the_part_inside(corners: list[tuple[float, float, float]]) -> None:
    planes = Field.of(parse_camera(CAMERAS['pinhole'])).planes(0.1)
    triangle = np.array(corners)
    part = clipped(triangle, planes)
    assert (part @ planes[:, :3].T + planes[:, 3] >= -1e-9).all()
    for share in np.random.default_rng(0).dirichlet([1.0, 1.0, 1.0], 20):
        point = share @ triangle
        if (point @ planes[:, :3].T + planes[:, 3] > 1e-6).all():
            assert len(part) >= 3


@settings(deadline=None, max_examples=60)
@given(PLACES, PLACES, st.floats(0.01, 8.0), st.sampled_from(list(CAMERAS)))
def test_any_arrow_can_be_drawn_and_one_behind_the_camera_draws_nothing(
    position: tuple[float, float, float],
    direction: tuple[float, float, float],
    length: float,
    name: str,
) -> None:
    if np.linalg.norm(direction) < 1e-3:
        direction = (0.0, 0.0, 1.0)
    camera = parse_camera(CAMERAS[name])
    arrow = Arrow(position, direction, length, '#f26a1b')
    drawn = draw_arrows(grey(camera), camera, HERE, [arrow], UP)
    assert drawn.shape == (camera.height, camera.width, 3)
    furthest = max(arrow.tail[2], arrow.tip[2]) + HEAD_RADIUS * length
    if furthest <= 0.0:
        assert not changed(grey(camera), drawn).any()


@pytest.mark.parametrize('name', CAMERAS)
def test_arrow_covers_the_pixels_of_its_axis_and_none_far_from_it(name: str) -> None:
    camera = parse_camera(CAMERAS[name])
    camera_from_map = rigid3d_from_rotation(Rotation.from_euler('y', 0.4), [0.3, 0.2, 1.0])
    tail, along = np.array([-0.5, 0.2, 1.6]), np.array([1.0, -0.3, 0.5])
    arrow = Arrow(tuple(tail), tuple(along), 1.0, '#f26a1b')
    before = grey(camera)
    after = draw_arrows(before, camera, camera_from_map, [arrow], UP)
    axis = arrow.tail + np.linspace(0.02, 0.97, 60)[:, None] * (arrow.tip - arrow.tail)
    pixels = project(camera, np.asarray(camera_from_map * axis))
    inside = pixels[in_image(camera, pixels)]
    assert len(inside) > 20
    mask = changed(before, after)
    # COLMAP's pixel centres lie at halves, so a place is in the pixel of its whole part
    columns, rows = np.floor(inside).astype(int).T
    assert mask[np.minimum(rows, 119), np.minimum(columns, 159)].all()
    drawn_rows, drawn_columns = np.nonzero(mask)
    places = np.column_stack([drawn_columns, drawn_rows]) + 0.5
    off = np.linalg.norm(places[:, None] - pixels[None], axis=2).min(axis=1)
    nearest = float((camera_from_map * axis)[:, 2].min())
    assert off.max() < 1.3 * HEAD_RADIUS * camera.mean_focal_length() / nearest + 4.0


def test_nearer_arrow_hides_the_one_behind_it() -> None:
    camera = parse_camera(CAMERAS['pinhole'])
    near = Arrow((-0.5, 0.0, 2.0), (1.0, 0.0, 0.0), 1.0, '#00ff00')
    far = Arrow((-2.0, 0.0, 4.0), (1.0, 0.0, 0.0), 4.0, '#ff0000')
    middle = np.floor(project(camera, np.array([[-0.2, 0.0, 2.0]]))[0]).astype(int)
    for arrows in ([near, far], [far, near]):
        red, green, _ = draw_arrows(grey(camera), camera, HERE, arrows, UP)[middle[1], middle[0]]
        assert green > red


def test_upper_side_is_lighter_than_the_lower_one() -> None:
    camera = parse_camera(CAMERAS['pinhole'])
    arrow = Arrow((-0.6, 0.0, 2.0), (1.0, 0.0, 0.0), 1.2, '#f26a1b')
    drawn = draw_arrows(grey(camera), camera, HERE, [arrow], UP)
    column = drawn[:, round(float(project(camera, arrow.tail[None])[0, 0])) + 8, 0].astype(int)
    rows = np.flatnonzero(column != BACKGROUND)[3:-3]
    assert column[rows[0]] > column[rows[-1]] + 20


def test_image_is_left_as_it_was_and_ends_come_in_pairs() -> None:
    camera = parse_camera(CAMERAS['pinhole'])
    image, arrow = grey(camera), Arrow((0.0, 0.0, 2.0), (0.0, 1.0, 0.0), 0.5, '#f26a1b')
    draw_arrows(image, camera, HERE, [arrow], UP)
    assert (image == BACKGROUND).all()
    np.testing.assert_allclose(arrow_ends([arrow]), [[0.0, 0.0, 2.0], [0.0, 0.5, 2.0]])
