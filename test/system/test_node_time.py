# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The node under the clock of a bag that runs, pauses and loops."""

from __future__ import annotations

import time
from itertools import pairwise
from typing import TYPE_CHECKING

import pytest
from builtin_interfaces.msg import Duration
from lifecycle_msgs.srv import GetState
from live_robot import (
    LIMIT_S,
    POSITION_TOLERANCE_M,
    ROTATION_TOLERANCE_DEG,
    NodeProcess,
    Robot,
    camera_info,
    image_message,
    rigid3d_of,
    spinning_node,
    time_message,
    wait_for,
)
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool

from gam_relocalizer.geometry import pose_error
from gam_relocalizer.localization.result import Status
from gam_relocalizer_msgs.srv import Relocalize

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tiny_place import TinyPlace

    from gam_relocalizer_msgs.msg import RelocalizationStatus

PERIOD_S, STEP_S = 2.0, 0.2
STEPS = round(PERIOD_S / STEP_S)
# The newest image is up to a step old, and on a busy machine the clock may come after it.
MARGIN_S = 2.5 * STEP_S
BEGIN_S, MOMENT_S = 100.0, 1e-4


class Bag:
    """A bag that is played: a clock, and an image at each of its steps."""

    def __init__(self, robot: Robot, tiny_place: TinyPlace) -> None:
        self.robot = robot
        self._pixels, self.camera_from_map = tiny_place.queries[0]
        self._clock = robot.node.create_publisher(Clock, '/clock', 1)
        self._state = robot.node.create_client(GetState, robot.topic('get_state'))
        self._steps = self._shown = 0

    @property
    def now(self) -> float:
        return BEGIN_S + self._steps * STEP_S

    @property
    def tried(self) -> list[RelocalizationStatus]:
        return self.robot.heard.statuses

    def step(self) -> None:
        """Goes on, and waits until the node has heard of it."""
        self._steps += 1
        self._shown = 0
        self._clock.publish(Clock(clock=time_message(self.now)))
        self.wait_for_node()
        self.show()

    def show(self) -> None:
        """Shows another image, a moment newer, and waits until the node has heard of it."""
        self.robot.show(image_message(self._pixels, self.now + self._shown * MOMENT_S))
        self._shown += 1
        self.wait_for_node()

    def wait_for_node(self) -> None:
        """The node takes everything that has come before it looks for more, this request too."""
        self.robot.request(self._state, GetState.Request())

    def play_one_period(self) -> None:
        """So many steps as a period has, and a pause in which an attempt can come to its end."""
        before = len(self.tried)
        for _ in range(STEPS):
            self.step()
        wait_for(lambda: len(self.tried) > before, 'an attempt')

    def begin_anew(self) -> None:
        """Plays from the beginning, as a bag that loops, and pauses after the first attempt."""
        self.tried.clear()
        self._steps = 0
        self.step()
        wait_for(lambda: self.show() or self.tried, 'the first attempt')

    def relocalize(self) -> Relocalize.Response:
        """Asks while the clock stands, and images come."""

        def show() -> None:
            self.show()
            time.sleep(0.05)

        request = Relocalize.Request(timeout=Duration(sec=30))
        name = self.robot.topic('relocalize')
        return self.robot.call(Relocalize, name, request, LIMIT_S, meanwhile=show)

    def wait_for_fix(self) -> None:
        """Until an attempt is over that gave a fix; nothing is due after it."""
        answers: list[Relocalize.Response] = []

        def accepted() -> bool:  # the calibration comes by a topic of its own
            answers.append(self.relocalize())
            return bool(answers[-1].accepted)

        wait_for(accepted, 'an answer with a pose')
        last = answers[-1].status.header.stamp
        wait_for(lambda: last in [status.header.stamp for status in self.tried], 'the fix')
        self.tried.clear()

    def set_enabled(self, *, enabled: bool) -> None:
        request = SetBool.Request(data=enabled)
        assert self.robot.call(SetBool, self.robot.topic('set_enabled'), request).success


@pytest.fixture(scope='module')
def played(tiny_place: TinyPlace, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bag]:
    log = tmp_path_factory.mktemp('node') / 'node.log'
    settings = {'use_sim_time': True, 'period': PERIOD_S, 'base_frame': "''"}
    node = NodeProcess(log, '--map', str(tiny_place.map_path), **settings)
    try:
        with spinning_node('robot') as own:
            robot = Robot(own)
            robot.camera_info = camera_info(tiny_place.camera)
            robot.connect(node)
            yield Bag(robot, tiny_place)
        node.end_cleanly()
    finally:
        node.process.kill()
        node.process.wait()


@pytest.fixture
def bag(played: Bag) -> Bag:
    """A bag that is paused after a fix."""
    played.wait_for_fix()
    return played


def seconds(statuses: list[RelocalizationStatus]) -> list[float]:
    stamps = [status.header.stamp for status in statuses]
    return [stamp.sec + stamp.nanosec / 1e9 for stamp in stamps]


def test_there_is_one_attempt_in_each_period_of_the_clock(bag: Bag) -> None:
    for periods in range(1, 6):
        bag.play_one_period()
        assert len(bag.tried) == periods, seconds(bag.tried)
    stamps = seconds(bag.tried)
    assert all(abs(after - before - PERIOD_S) < MARGIN_S for before, after in pairwise(stamps))


def test_while_the_clock_stands_nothing_is_tried_and_then_it_goes_on(bag: Bag) -> None:
    for _ in range(10):
        bag.show()
    bag.play_one_period()
    # the attempt of this period, and none before it
    assert len(bag.tried) == 1, seconds(bag.tried)


def test_requests_are_answered_while_the_clock_stands(bag: Bag) -> None:
    answer = bag.relocalize()
    assert answer.accepted, answer.status.reason
    error = pose_error(rigid3d_of(answer.pose.pose.pose).inverse(), bag.camera_from_map)
    assert error.position < POSITION_TOLERANCE_M
    assert error.rotation_deg < ROTATION_TOLERANCE_DEG
    soon = Relocalize.Request(timeout=Duration(nanosec=200_000_000))
    late = bag.robot.call(Relocalize, bag.robot.topic('relocalize'), soon)
    assert Status(late.status.status) is Status.NO_IMAGE


def test_attempts_end_and_begin_again_while_the_clock_stands(bag: Bag) -> None:
    bag.set_enabled(enabled=False)
    for _ in range(2 * STEPS):
        bag.step()
    assert bag.tried == []
    bag.set_enabled(enabled=True)
    wait_for(lambda: bag.tried, 'an attempt on the image that was there')
    bag.play_one_period()
    assert len(bag.tried) == 2, seconds(bag.tried)


def test_every_round_of_a_looping_bag_has_its_fixes(bag: Bag) -> None:
    for _ in range(3):
        bag.begin_anew()
        for _ in range(2):
            bag.play_one_period()
        assert all(status.accepted for status in bag.tried), bag.tried
        stamps = seconds(bag.tried)
        assert len(stamps) == 3, stamps
        assert BEGIN_S < stamps[0] < stamps[1] < stamps[2] <= bag.now
