# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from gam_relocalizer.demo.renderer import Appearance, Light, Renderer
from gam_relocalizer.demo.trajectories import mapping_views
from gam_relocalizer.demo.world import Quad, World
from gam_relocalizer.errors import CameraError
from gam_relocalizer.geometry import rigid3d_from_rotation

BRIGHT = Appearance(lights=(), ambient=(0.5, 0.5, 0.5), vignetting=0.0)
SQUARES = 8
CAMERA = pycolmap.Camera(
    camera_id=1, model='PINHOLE', width=320, height=240, params=[240.0, 244.0, 161.3, 118.6]
)


def _quad(
    top_left: tuple[float, ...],
    across: tuple[float, ...],
    down: tuple[float, ...],
    texture: int = 0,
) -> Quad:
    origin, right, below = (np.array(vector, float) for vector in (top_left, across, down))
    return Quad(np.stack([origin, origin + right, origin + right + below, origin + below]), texture)


def _world(quads: list[Quad], textures: list[np.ndarray]) -> World:
    nowhere = np.zeros((1, 3))
    return World(tuple(quads), tuple(textures), nowhere, nowhere[:, :2], nowhere[:, :2])


def _checker(square: int = 40) -> np.ndarray:
    parity = np.add.outer(np.arange(SQUARES), np.arange(SQUARES)) % 2
    grey = np.where(np.kron(parity, np.ones((square, square))) > 0, 220, 40).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def _checker_world(square: int = 40, side: float = 1.0) -> World:
    """A checkerboard in the plane z = 0, its middle at the origin, facing -z."""
    half = side / 2
    quad = _quad((-half, -half, 0.0), (side, 0.0, 0.0), (0.0, side, 0.0))
    return _world([quad], [_checker(square)])


def _viewpoint(seed: int) -> pycolmap.Rigid3d:
    """A camera about 1.3 m in front of the origin, tilted at random."""
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(rng.uniform(-0.6, 0.6, 3))
    return rigid3d_from_rotation(turn, (*rng.uniform(-0.05, 0.05, 2), rng.uniform(1.2, 1.5)))


def _inner_corners() -> np.ndarray:
    steps = np.arange(1, SQUARES) / SQUARES - 0.5
    x, y = np.meshgrid(steps, steps)
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)


def _found_near(image: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Sub-pixel corners around the expected places, in COLMAP's pixel convention."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    start = (expected - 0.5).astype(np.float32).reshape(-1, 1, 2)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-4)
    return cv2.cornerSubPix(grey, start, (4, 4), (-1, -1), stop).reshape(-1, 2) + 0.5


@pytest.mark.parametrize('seed', range(6))
def test_corners_lie_where_the_camera_projects_them(seed: int) -> None:
    camera_from_map = _viewpoint(seed)
    image = Renderer(_checker_world(), BRIGHT).render(CAMERA, [camera_from_map])
    expected = CAMERA.img_from_cam(camera_from_map * _inner_corners())
    inside = np.all((expected > 8) & (expected < (312, 232)), axis=1)
    assert inside.sum() > 20
    difference = _found_near(image, expected[inside]) - expected[inside]
    distance = np.linalg.norm(difference, axis=1)
    assert np.median(distance) < 0.08
    assert distance.max() < 0.2
    assert np.abs(difference.mean(axis=0)).max() < 0.02


@pytest.mark.parametrize('seed', range(4))
def test_depth_is_that_of_the_plane(seed: int) -> None:
    camera_from_map = _viewpoint(seed)
    depth = Renderer(_checker_world(), BRIGHT).depth(CAMERA, camera_from_map)
    seen = np.isfinite(depth)
    assert 0.2 < seen.mean() < 1.0
    rows, columns = np.nonzero(seen)
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=1)
    rays = np.hstack([CAMERA.cam_from_img(pixels), np.ones((len(pixels), 1))])
    on_plane = camera_from_map.inverse() * (rays * depth[seen][:, None].astype(float))
    np.testing.assert_allclose(on_plane[:, 2], 0.0, atol=1e-5)
    assert np.abs(on_plane[:, :2]).max() < 0.5 + 1e-5


def test_outline_covers_exactly_the_pixels_whose_centres_lie_inside() -> None:
    camera_from_map = _viewpoint(1)
    depth = Renderer(_checker_world(), BRIGHT).depth(CAMERA, camera_from_map)
    corners = _checker_world().quads[0].corners
    outline = CAMERA.img_from_cam(camera_from_map * corners).astype(np.float32)
    for row in range(3, 240, 17):
        for column in range(3, 320, 13):
            centre = (column + 0.5, row + 0.5)
            distance = cv2.pointPolygonTest(outline.reshape(-1, 1, 2), centre, measureDist=True)
            if abs(distance) > 1e-3:
                assert np.isfinite(depth[row, column]) == (distance > 0)


def test_nearer_surface_hides_the_farther_one() -> None:
    grey = [np.full((16, 16, 3), value, np.uint8) for value in (60, 200)]
    far = _quad((-2, -2, 1), (4, 0, 0), (0, 4, 0), 0)
    near = _quad((-0.2, -0.2, 0), (0.4, 0, 0), (0, 0.4, 0), 1)
    camera_from_map = rigid3d_from_rotation(Rotation.identity(), (0.0, 0.0, 1.0))
    for quads in ([far, near], [near, far]):
        renderer = Renderer(_world(quads, grey), BRIGHT)
        depth = renderer.depth(CAMERA, camera_from_map)
        image = renderer.render(CAMERA, [camera_from_map])
        assert depth[120, 160] == pytest.approx(1.0)
        assert depth[20, 20] == pytest.approx(2.0)
        assert image[120, 160].min() > image[20, 20].max()


def test_intersecting_surfaces_meet_on_their_line() -> None:
    grey = [np.full((16, 16, 3), value, np.uint8) for value in (60, 200)]
    left = _quad((-2, -2, 0), (4, 0, 2), (0, 4, 0), 0)
    right = _quad((-2, -2, 2), (4, 0, -2), (0, 4, 0), 1)
    camera_from_map = rigid3d_from_rotation(Rotation.identity(), (0.0, 0.0, 2.0))
    image = Renderer(_world([left, right], grey), BRIGHT).render(CAMERA, [camera_from_map])
    middle = CAMERA.img_from_cam(camera_from_map * np.array([[0.0, 0.0, 1.0]]))[0, 0]
    row = image[120, :, 0].astype(int)
    assert np.abs(np.diff(row)).argmax() + 1 == pytest.approx(middle, abs=1.0)


def test_back_faces_are_invisible() -> None:
    half_turn = rigid3d_from_rotation(Rotation.from_euler('y', 180, degrees=True), (0.0, 0.0, 1.3))
    renderer = Renderer(_checker_world(), BRIGHT)
    assert not np.isfinite(renderer.depth(CAMERA, half_turn)).any()
    assert not renderer.render(CAMERA, [half_turn]).any()


def test_floor_that_runs_under_and_behind_the_camera_is_exact() -> None:
    floor = _quad((-5, 5, 0), (10, 0, 0), (0, -10, 0))
    renderer = Renderer(_world([floor], [_checker()]), BRIGHT)
    # Looks along +x, half a metre above the floor, optical axes.
    map_from_camera = rigid3d_from_rotation(
        Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]), (0.0, 0.0, 0.5)
    )
    depth = renderer.depth(CAMERA, map_from_camera.inverse())
    y = (np.arange(240) + 0.5 - CAMERA.principal_point_y) / CAMERA.focal_length_y
    with np.errstate(divide='ignore'):
        expected = np.where(y > 0, 0.5 / y, np.inf)
    expected[expected > 5.0] = np.inf
    np.testing.assert_allclose(depth[:, 160], expected, rtol=1e-5)


def test_distant_fine_pattern_is_averaged_not_aliased() -> None:
    quad = _quad((-20, -20, 0), (40, 0, 0), (0, 40, 0))
    texture = np.indices((512, 512)).sum(axis=0) % 2 * 255
    world = _world([quad], [np.repeat(texture[..., None], 3, axis=2).astype(np.uint8)])
    camera_from_map = rigid3d_from_rotation(Rotation.identity(), (0.0, 0.0, 60.0))
    image = Renderer(world, BRIGHT).render(CAMERA, [camera_from_map])
    assert image[60:180, 100:220].std() < 12.0


def test_motion_blur_is_centred_on_the_middle_of_the_exposure() -> None:
    middle = _viewpoint(2)
    renderer = Renderer(_checker_world(), BRIGHT)
    axis = np.array([0.1, 1.0, 0.3]) * 0.012
    moments = (np.arange(8) + 0.5) / 8 - 0.5
    swing = [
        rigid3d_from_rotation(Rotation.from_rotvec(axis * moment), np.zeros(3)) * middle
        for moment in moments
    ]
    still, blurred = renderer.render(CAMERA, [middle]), renderer.render(CAMERA, swing)
    expected = CAMERA.img_from_cam(middle * _inner_corners())
    expected = expected[np.all((expected > 12) & (expected < (308, 228)), axis=1)]
    difference = _found_near(blurred, expected) - expected
    assert np.abs(difference.mean(axis=0)).max() < 0.05
    still_edge, blurred_edge = (
        np.abs(np.diff(image[..., 0].astype(float), axis=1)).max() for image in (still, blurred)
    )
    assert blurred_edge < 0.75 * still_edge


def test_light_falls_off_and_fades_with_the_angle() -> None:
    white = [np.full((16, 16, 3), 255, np.uint8)]
    wall = _quad((-2, -2, 0), (4, 0, 0), (0, 4, 0))
    lamp = Appearance((Light((-0.5, 0.0, -0.5), intensity=0.4),), (0.0, 0.0, 0.0), vignetting=0.0)
    camera_from_map = rigid3d_from_rotation(Rotation.identity(), (0.0, 0.0, 2.0))
    image = Renderer(_world([wall], white), lamp).render(CAMERA, [camera_from_map]).astype(int)
    lit = CAMERA.img_from_cam(camera_from_map * np.array([[-0.5, 0.0, 0.0]]))[0].astype(int)
    row = image[lit[1], :, 0]
    assert row.argmax() == pytest.approx(lit[0], abs=12)
    assert row[310] < 0.6 * row.max()


def test_exposure_and_white_balance_change_the_image(tiny: World) -> None:
    camera_from_map = mapping_views(tiny.mapping_route)[0]

    def mean_colour(**look: object) -> np.ndarray:
        appearance = Appearance((), (0.3, 0.3, 0.3), **look)
        return Renderer(tiny, appearance).render(CAMERA, [camera_from_map]).mean(axis=(0, 1))

    plain = mean_colour()
    assert np.all(mean_colour(exposure=1.5) > plain + 5)
    warm = mean_colour(white_balance=(1.2, 1.0, 0.8))
    assert warm[0] > plain[0] + 3
    assert warm[2] < plain[2] - 3


def test_same_input_gives_the_same_bytes_and_noise_follows_its_seed(tiny: World) -> None:
    appearance = Appearance((), (0.4, 0.4, 0.4), noise=0.02)
    camera_from_map = mapping_views(tiny.mapping_route)[1]
    first, second = Renderer(tiny, appearance), Renderer(tiny, appearance)
    image = first.render(CAMERA, [camera_from_map], noise_seed=3)
    np.testing.assert_array_equal(image, second.render(CAMERA, [camera_from_map], noise_seed=3))
    other = first.render(CAMERA, [camera_from_map], noise_seed=4)
    difference = image.astype(int) - other
    assert 0.5 < difference.std() < 15
    assert abs(difference.mean()) < 0.1


def test_room_has_no_holes(tiny: World) -> None:
    renderer = Renderer(tiny, BRIGHT)
    for camera_from_map in mapping_views(tiny.mapping_route, spacing=2.0):
        assert np.isfinite(renderer.depth(CAMERA, camera_from_map)).all()


def test_refuses_a_camera_with_distortion(tiny: World) -> None:
    camera = pycolmap.Camera(
        camera_id=1, model='SIMPLE_RADIAL', width=64, height=48, params=[50.0, 32.0, 24.0, 0.1]
    )
    with pytest.raises(CameraError):
        Renderer(tiny, BRIGHT).render(camera, [pycolmap.Rigid3d()])
