# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gam_relocalizer.errors import TransformError
from gam_relocalizer.geometry import pose_error, rigid3d_from, rigid3d_from_rotation
from gam_relocalizer.transforms import TransformTree

if TYPE_CHECKING:
    from random import Random

SECOND = 10**9


def yaw(angle: float, translation: tuple[float, float, float]) -> pycolmap.Rigid3d:
    return rigid3d_from_rotation(Rotation.from_euler('z', angle), translation)


def assert_same(found: pycolmap.Rigid3d, expected: pycolmap.Rigid3d) -> None:
    np.testing.assert_allclose(found.matrix(), expected.matrix(), atol=1e-12)


BASE_FROM_HEAD = yaw(0.5 * math.pi, (1.0, 0.0, 2.0))
HEAD_FROM_CAMERA = rigid3d_from((0.5, -0.5, 0.5, -0.5), (0.1, 0.2, 0.3))
BASE_FROM_LIDAR = yaw(-0.3, (0.0, 0.4, 0.9))


@pytest.fixture
def tree() -> TransformTree:
    tree = TransformTree()
    tree.add('base', 'head', BASE_FROM_HEAD, 0, static=True)
    tree.add('head', 'camera', HEAD_FROM_CAMERA, 0, static=True)
    tree.add('base', 'lidar', BASE_FROM_LIDAR, 0, static=True)
    return tree


def test_static_transforms_compose_down_up_and_across(tree: TransformTree) -> None:
    base_from_camera = BASE_FROM_HEAD * HEAD_FROM_CAMERA
    assert_same(tree.lookup('base', 'camera', 5), base_from_camera)
    assert_same(tree.lookup('camera', 'base', 5), base_from_camera.inverse())
    assert_same(tree.lookup('lidar', 'camera', 5), BASE_FROM_LIDAR.inverse() * base_from_camera)


def test_a_point_goes_through_the_chain_as_by_hand(tree: TransformTree) -> None:
    # the head is turned left by 90 degrees: its x is the base's y
    in_base = tree.lookup('base', 'head', 0) * np.array([1.0, 0.0, 0.0])
    np.testing.assert_allclose(in_base, [1.0, 1.0, 2.0], atol=1e-12)


def test_a_frame_is_where_it_is_even_when_unknown() -> None:
    assert_same(TransformTree().lookup('camera', 'camera', 0), pycolmap.Rigid3d())


def test_leading_slashes_of_old_bags_do_not_matter(tree: TransformTree) -> None:
    tree.add('/camera', '/optical', HEAD_FROM_CAMERA, 0, static=True)
    assert_same(tree.lookup('camera', '/optical', 0), HEAD_FROM_CAMERA)


def test_moving_frames_are_interpolated() -> None:
    tree = TransformTree()
    tree.add('base', 'head', yaw(0.0, (0.0, 0.0, 1.0)), 1 * SECOND, static=False)
    tree.add('base', 'head', yaw(1.0, (4.0, 0.0, 1.0)), 2 * SECOND, static=False)
    assert_same(tree.lookup('base', 'head', int(1.25 * SECOND)), yaw(0.25, (1.0, 0.0, 1.0)))


@given(
    angles=st.lists(st.floats(-3.0, 3.0), min_size=2, max_size=8),
    share=st.floats(0.0, 1.0),
    order=st.randoms(use_true_random=False),
)
def test_interpolation_stays_between_its_samples(
    angles: list[float], share: float, order: Random
) -> None:
    samples = [(index * SECOND, angle) for index, angle in enumerate(angles)]
    order.shuffle(samples)
    tree = TransformTree()
    for stamp, angle in samples:
        tree.add('base', 'head', yaw(angle, (angle, 0.0, 0.0)), stamp, static=False)
    stamp = round(share * (len(angles) - 1) * SECOND)
    before = min(stamp // SECOND, len(angles) - 2)
    low, high = sorted(angles[before : before + 2])
    base_from_head = tree.lookup('base', 'head', stamp)
    assert low - 1e-9 <= base_from_head.translation[0] <= high + 1e-9
    distance = pose_error(base_from_head, yaw(angles[before], (0.0, 0.0, 0.0))).rotation_deg
    whole = math.degrees(high - low)
    assert distance <= min(whole, 360.0 - whole) + 1e-6


@pytest.mark.parametrize('stamp', [0, SECOND - 1, 3 * SECOND + 1, 10**18])
def test_nothing_is_extrapolated(stamp: int) -> None:
    tree = TransformTree()
    for second in (1, 2, 3):
        tree.add('base', 'head', yaw(0.0, (1.0, 0.0, 0.0)), second * SECOND, static=False)
    with pytest.raises(TransformError, match=r'known from 1\.000000 s to 3\.000000 s'):
        tree.lookup('base', 'head', stamp)


def test_a_sample_holds_at_its_own_stamp_even_alone() -> None:
    tree = TransformTree()
    tree.add('base', 'head', BASE_FROM_HEAD, SECOND, static=False)
    assert_same(tree.lookup('base', 'head', SECOND), BASE_FROM_HEAD)


def test_the_same_stamp_again_replaces() -> None:
    tree = TransformTree()
    tree.add('base', 'head', BASE_FROM_LIDAR, SECOND, static=False)
    tree.add('base', 'head', BASE_FROM_HEAD, SECOND, static=False)
    assert_same(tree.lookup('base', 'head', SECOND), BASE_FROM_HEAD)


def test_a_static_transform_again_replaces(tree: TransformTree) -> None:
    tree.add('base', 'head', BASE_FROM_LIDAR, 0, static=True)
    assert_same(tree.lookup('base', 'head', 0), BASE_FROM_LIDAR)


def test_a_new_parent_replaces_the_old_one(tree: TransformTree) -> None:
    tree.add('lidar', 'camera', HEAD_FROM_CAMERA, 0, static=True)
    assert_same(tree.lookup('base', 'camera', 0), BASE_FROM_LIDAR * HEAD_FROM_CAMERA)


def test_history_is_bounded() -> None:
    tree = TransformTree(history_ns=2 * SECOND)
    for second in range(6):
        tree.add('base', 'head', BASE_FROM_HEAD, second * SECOND, static=False)
    assert_same(tree.lookup('base', 'head', 3 * SECOND), BASE_FROM_HEAD)
    with pytest.raises(TransformError, match=r'known from 3\.000000 s'):
        tree.lookup('base', 'head', 3 * SECOND - 1)


def test_time_that_jumps_back_starts_the_history_anew() -> None:
    tree = TransformTree(history_ns=2 * SECOND)
    for second in (100, 101):
        tree.add('base', 'head', BASE_FROM_LIDAR, second * SECOND, static=False)
    tree.add('base', 'head', BASE_FROM_HEAD, 5 * SECOND, static=False)
    assert_same(tree.lookup('base', 'head', 5 * SECOND), BASE_FROM_HEAD)
    with pytest.raises(TransformError, match=r'known from 5\.000000 s to 5\.000000 s'):
        tree.lookup('base', 'head', 100 * SECOND)


def test_clearing_the_history_keeps_static_transforms(tree: TransformTree) -> None:
    tree.add('lidar', 'beam', HEAD_FROM_CAMERA, SECOND, static=False)
    tree.clear_history()
    assert tree.frames == ['base', 'camera', 'head', 'lidar']
    with pytest.raises(TransformError, match='beam'):
        tree.lookup('base', 'beam', SECOND)


def test_an_unknown_frame_is_named_beside_the_known_ones(tree: TransformTree) -> None:
    with pytest.raises(TransformError, match=r'`arm` is not known.*base -> head.*head -> camera'):
        tree.lookup('base', 'arm', 0)
    with pytest.raises(TransformError, match='none'):
        TransformTree().lookup('base', 'camera', 0)


def test_unconnected_frames_are_an_error(tree: TransformTree) -> None:
    tree.add('world', 'table', HEAD_FROM_CAMERA, 0, static=True)
    with pytest.raises(TransformError, match='`table` and `camera` are not connected'):
        tree.lookup('table', 'camera', 0)


def test_a_loop_is_an_error_and_no_hang() -> None:
    tree = TransformTree()
    for parent, child in (('a', 'b'), ('b', 'c'), ('c', 'a')):
        tree.add(parent, child, BASE_FROM_HEAD, 0, static=True)
    with pytest.raises(TransformError, match='loop: a -> c -> b -> a'):
        tree.lookup('a', 'b', 0)


@pytest.mark.parametrize(
    ('parent', 'child', 'x'),
    [('base', 'base', 0.0), ('', 'camera', 0.0), ('base', '', 0.0), ('base', 'head', math.nan)],
)
def test_impossible_transforms_are_refused(parent: str, child: str, x: float) -> None:
    parent_from_child = pycolmap.Rigid3d(pycolmap.Rotation3d(), [x, 0.0, 0.0])
    with pytest.raises(TransformError):
        TransformTree().add(parent, child, parent_from_child, 0, static=True)
