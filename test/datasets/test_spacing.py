# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gam_relocalizer.datasets.spacing import spaced
from gam_relocalizer.geometry import pose_error, rigid3d_from_rotation
from gam_relocalizer.image_set import ImageSet


def drive(positions: list[float], turns_deg: list[float]) -> ImageSet:
    """Along x, turning about z."""
    poses = {
        f'{index:03d}.png': rigid3d_from_rotation(
            Rotation.from_euler('z', turn, degrees=True), np.zeros(3)
        )
        * rigid3d_from_rotation(Rotation.identity(), np.array([-x, 0.0, 0.0]))
        for index, (x, turn) in enumerate(zip(positions, turns_deg, strict=True))
    }
    return ImageSet(Path(), tuple(poses), camera_from_world=poses)


def test_keeps_an_image_for_every_step() -> None:
    images = drive([0.1 * i for i in range(11)], [0.0] * 11)

    assert spaced(images, 0.29).names == ('000.png', '003.png', '006.png', '009.png')


def test_keeps_an_image_for_every_turn_on_the_spot() -> None:
    images = drive([0.0] * 10, [4.0 * i for i in range(10)])

    assert spaced(images, 1.0, 11.9).names == ('000.png', '003.png', '006.png', '009.png')


def test_a_distance_of_zero_keeps_all() -> None:
    images = drive([0.0] * 4, [0.0] * 4)

    assert spaced(images, 0.0).names == images.names


def test_images_without_a_pose_stay_to_be_counted() -> None:
    images = drive([0.0, 0.1, 5.0], [0.0] * 3)
    names = ('lost.png', *images.names)

    kept = spaced(ImageSet(Path(), names, camera_from_world=images.camera_from_world), 1.0)

    assert kept.names == ('lost.png', '000.png', '002.png')


@given(
    st.lists(st.tuples(st.floats(-3, 3), st.floats(-90, 90)), min_size=1, max_size=30),
    st.floats(0.01, 2.0),
    st.floats(1.0, 60.0),
)
def test_those_left_out_are_near_the_last_one_kept(
    steps: list[tuple[float, float]], distance: float, angle_deg: float
) -> None:
    positions, turns = np.cumsum(steps, axis=0).T.tolist()
    images = drive(positions, turns)
    poses = images.camera_from_world

    kept = spaced(images, distance, angle_deg).names

    assert kept[0] == images.names[0]
    last = kept[0]
    for name in images.names:
        last = name if name in kept else last
        error = pose_error(poses[name], poses[last])
        assert error.position < distance
        assert error.rotation_deg < angle_deg
    for first, second in pairwise(kept):
        error = pose_error(poses[second], poses[first])
        assert error.position >= distance or error.rotation_deg >= angle_deg
