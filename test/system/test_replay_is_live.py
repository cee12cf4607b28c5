# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from gam_relocalizer.geometry import quaternion_wxyz, rigid3d_from
from gam_relocalizer.localization.localizer import Localizer
from gam_relocalizer.replay.replay import ReplayOptions, replay_bag
from gam_relocalizer.ros.live import LiveOptions, run_live

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    import pycolmap
    from tiny_place import TinyPlace


@pytest.fixture
def one_torch_thread() -> Iterator[None]:
    """Sums of floats depend on how they are split over threads."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def as_sent(map_from_base: pycolmap.Rigid3d) -> np.ndarray:
    """A pose after a message has carried it."""
    received = rigid3d_from(quaternion_wxyz(map_from_base), map_from_base.translation)
    return np.asarray(received.matrix())


@pytest.mark.usefixtures('one_torch_thread')
def test_the_node_and_the_replay_of_a_bag_agree_to_the_last_bit(
    tiny_place: TinyPlace, tmp_path: Path
) -> None:
    answers = run_live(
        tiny_place.bag,
        tiny_place.map_path,
        tmp_path / 'node.log',
        LiveOptions(period=0.2, truth={}, torch_threads=1),
        lambda _answer: None,
    )
    localizer = Localizer.load(tiny_place.map_path)
    replay = replay_bag(tiny_place.bag, localizer, ReplayOptions(period=0.0))
    replayed = {attempt.stamp_ns: attempt for attempt in replay.attempts}
    fixes = [answer for answer in answers if answer.robot_pose is not None]
    assert len(fixes) >= 2
    for answer in answers:
        expected = replayed[answer.stamp_ns]
        assert (answer.status, answer.inliers) == (expected.result.status, expected.result.inliers)
    for fix in fixes:
        expected_pose = replayed[fix.stamp_ns].robot_pose
        assert expected_pose is not None
        assert fix.robot_pose is not None
        np.testing.assert_array_equal(
            np.asarray(fix.robot_pose.map_from_base.matrix()), as_sent(expected_pose.map_from_base)
        )
        np.testing.assert_array_equal(fix.robot_pose.covariance, expected_pose.covariance)
