# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
from nav_msgs.msg import Odometry
from std_msgs.msg import Header

from gam_relocalizer.localization.continuity import Continuity
from gam_relocalizer.localization.result import LocalizationResult, Status
from gam_relocalizer.localization.robot_pose import RobotPose
from gam_relocalizer.ros.conversions import stamp_from
from gam_relocalizer.ros.health import Health
from gam_relocalizer.ros.parameters import NodeParameters
from gam_relocalizer.ros.prior_listener import PriorListener

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ros_graph import Graph

SECOND = 10**9
ACCEPTED = LocalizationResult(Status.ACCEPTED, 'good')


class Wheels:
    """Odometry of a robot that stands, and the listener that hears it."""

    def __init__(self, graph: Graph) -> None:
        self.continuity = Continuity()
        self.listener = PriorListener(graph.own, NodeParameters(), self.continuity, Health())
        self._graph = graph
        self._publisher = graph.world.create_publisher(Odometry, '/odom', 10)
        graph.spin_until(self._publisher.get_subscription_count, 'a subscription')
        self._stamp_ns = 0

    def say(self, frame: str, child_frame: str = 'base_link') -> None:
        self._stamp_ns += SECOND // 10
        header = Header(stamp=stamp_from(self._stamp_ns), frame_id=frame)
        self._publisher.publish(Odometry(header=header, child_frame_id=child_frame))

    def say_until_heard(self, frame: str) -> None:
        def is_heard() -> bool:
            self.say(frame)
            return self.listener.odometry_frame == frame.strip('/')

        self._graph.spin_until(is_heard, 'the odometry')

    def get_corrected(self) -> None:
        """By two fixes at the time of the newest odometry that has been heard."""
        pose = RobotPose(pycolmap.Rigid3d(), np.eye(6) * 1e-4)

        def is_corrected() -> bool:
            for _ in range(2):
                self.continuity.judge(self._stamp_ns, ACCEPTED, pose)
            return self.continuity.correction is not None

        self._graph.spin_until(is_corrected, 'a correction')


@pytest.fixture
def wheels(graph: Graph) -> Iterator[Wheels]:
    wheels = Wheels(graph)
    yield wheels
    wheels.listener.destroy()


def test_the_frame_is_that_of_the_odometry_that_is_used(
    wheels: Wheels, capfd: pytest.CaptureFixture[str]
) -> None:
    assert wheels.listener.odometry_frame is None
    wheels.say('trailer_odom', child_frame='trailer')
    wheels.say_until_heard('/odom')
    wheels.say('trailer_odom', child_frame='trailer')
    wheels.say_until_heard('vio')  # by the same publisher, so after the one before
    lines = capfd.readouterr().err
    assert 'was in frame `odom`' in lines
    assert 'trailer_odom' not in lines


def test_odometry_in_another_frame_starts_anew(
    wheels: Wheels, capfd: pytest.CaptureFixture[str]
) -> None:
    wheels.say_until_heard('odom')
    wheels.get_corrected()
    wheels.say_until_heard('odom')
    assert wheels.continuity.correction is not None
    wheels.say_until_heard('vio')
    assert wheels.continuity.correction is None
    line = capfd.readouterr().err
    assert '`odom`' in line
    assert '`vio`' in line
    wheels.get_corrected()
