# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What should be in view of a pose, and how much of it is where something matches."""

from __future__ import annotations

import numpy as np
import pycolmap
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from synthetic_place import bare_map

from gam_relocalizer.geometry import rigid3d_from, rigid3d_from_rotation
from gam_relocalizer.localization.result import Support
from gam_relocalizer.localization.scenes import Scene
from gam_relocalizer.localization.support import support_of

CAMERA = pycolmap.Camera(model='PINHOLE', width=640, height=480, params=[500, 500, 320, 240])
# one pixel in each cell of the image, the left half first
COLUMNS, ROWS = np.meshgrid(np.arange(8) * 80.0 + 40.0, np.arange(8) * 60.0 + 30.0, indexing='ij')
PIXELS = np.column_stack([COLUMNS.ravel(), ROWS.ravel()])
HERE = rigid3d_from([1, 0, 0, 0], [0, 0, 0])
ALL = np.arange(64)


def wall(camera: pycolmap.Camera = CAMERA, distance: float = 5.0) -> np.ndarray:
    """[64,3] what a camera at the origin sees in its cells, on a wall."""
    return distance * np.column_stack([camera.cam_from_img(PIXELS), np.ones(64)])


def scene_of_all(images: int, points: int) -> Scene:
    return Scene(0, np.arange(images), np.arange(points))


def support(camera_from_map: pycolmap.Rigid3d, inliers: np.ndarray) -> Support:
    """Of a pose in a room of one wall that one image, at the origin, sees."""
    one_wall = bare_map(wall(), [HERE], [ALL])
    return support_of(
        camera_from_map, CAMERA, PIXELS[inliers], inliers, scene_of_all(1, 64), one_wall
    )


def test_all_that_is_in_view_and_matched_supports_a_pose() -> None:
    assert support(HERE, ALL) == Support(in_view=64, unmatched=0.0)


def test_half_of_the_image_without_a_match_speaks_against_a_pose() -> None:
    assert support(HERE, ALL[:32]) == Support(in_view=64, unmatched=0.5)


@given(st.sets(st.integers(0, 63), min_size=1), st.sets(st.integers(0, 63)))
def test_more_matches_never_support_a_pose_less(few: set[int], others: set[int]) -> None:
    with_few, with_more = (
        support(HERE, np.array(sorted(matched))) for matched in (few, few | others)
    )
    assert 0.0 <= with_more.unmatched <= with_few.unmatched <= 1.0
    assert with_more.in_view == with_few.in_view


def test_pose_that_looks_away_has_no_support() -> None:
    away = rigid3d_from_rotation(Rotation.from_euler('y', 180, degrees=True), [0, 0, 0])
    assert support(away, ALL) == Support(in_view=0, unmatched=1.0)


def test_only_what_is_inside_of_the_image_is_in_view() -> None:
    aside = rigid3d_from_rotation(Rotation.from_euler('y', 20, degrees=True), [0, 0, 0])
    in_view = support(aside, ALL).in_view
    pixels = CAMERA.img_from_cam(aside * wall())
    assert 0 < in_view < 64
    assert in_view == ((pixels >= 0) & (pixels < [640, 480])).all(axis=1).sum()


def test_points_are_not_expected_from_much_nearer_or_another_side() -> None:
    nearer = rigid3d_from([1, 0, 0, 0], [0, 0, -4])
    assert support(nearer, ALL).in_view == 0
    # round the wall by 60 degrees, looking at its middle
    turn = Rotation.from_euler('y', 60, degrees=True)
    middle = np.array([0.0, 0.0, 5.0])
    round_it = rigid3d_from_rotation(turn, middle - turn.apply(middle))
    assert 0 < support(round_it, ALL).in_view < 32


def test_only_images_that_share_the_inliers_tell_what_is_expected() -> None:
    points = np.vstack([wall(), wall(distance=4.0)])
    two_walls = bare_map(points, [HERE, HERE], [ALL, ALL + 64])
    scene = scene_of_all(2, 128)
    assert support_of(HERE, CAMERA, PIXELS, ALL, scene, two_walls).in_view == 64
    both = np.r_[ALL, ALL + 64]
    keypoints = np.vstack([PIXELS, PIXELS])
    assert support_of(HERE, CAMERA, keypoints, both, scene, two_walls).in_view == 128


def test_what_a_lens_folds_back_into_the_image_is_not_in_view() -> None:
    """A polynomial of a barrel distortion turns back, far off the axis."""
    barrel = pycolmap.Camera(
        model='OPENCV', width=640, height=480, params=[620, 620, 320, 240, -0.35, 0, 0, 0]
    )
    aside = 5.0 * np.array([[1.5, 0.1, 1.0], [-1.4, 0.2, 1.0], [0.3, 1.6, 1.0]])
    folded = barrel.img_from_cam(aside)
    assert ((folded >= 0) & (folded < [640, 480])).all()
    points = np.vstack([wall(barrel), aside])
    one_wall = bare_map(points, [HERE], [np.arange(67)])
    found = support_of(HERE, barrel, PIXELS, ALL, scene_of_all(1, 67), one_wall)
    assert found == Support(in_view=64, unmatched=0.0)


def test_support_is_the_same_wherever_the_map_lies() -> None:
    shift = np.array([1e5, -1e5, 3e4])
    there = rigid3d_from([1, 0, 0, 0], -shift)
    far_wall = bare_map(wall() + shift, [there], [ALL])
    inliers = ALL[:20]
    found = support_of(there, CAMERA, PIXELS[inliers], inliers, scene_of_all(1, 64), far_wall)
    assert found == support(HERE, inliers)
