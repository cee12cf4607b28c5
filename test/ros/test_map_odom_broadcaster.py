# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nav_msgs.msg import Odometry
from ros_graph import transform_message
from scipy.spatial.transform import Rotation
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from gam_relocalizer.geometry import rigid3d_from_rotation
from gam_relocalizer.localization.continuity import Continuity, ContinuityOptions
from gam_relocalizer.localization.result import LocalizationResult, Status
from gam_relocalizer.localization.robot_pose import RobotPose
from gam_relocalizer.ros import map_odom_broadcaster, transform_listener
from gam_relocalizer.ros.conversions import (
    nanoseconds_from,
    pose_message,
    rigid3d_from_message,
    stamp_from,
)
from gam_relocalizer.ros.health import Health
from gam_relocalizer.ros.interface import Topic
from gam_relocalizer.ros.map_odom_broadcaster import (
    REMEMBERED,
    RIVAL_S,
    MapOdomBroadcaster,
    Owners,
    RisingStamps,
)
from gam_relocalizer.ros.parameters import NodeParameters
from gam_relocalizer.ros.prior_listener import PriorListener
from gam_relocalizer.ros.transform_listener import TransformListener

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import pycolmap
    from geometry_msgs.msg import TransformStamped
    from ros_graph import Graph

SECOND = 10**9
ACCEPTED = LocalizationResult(Status.ACCEPTED, 'good')
TIMES = st.integers(0, 2**31 * SECOND)
OWN_RATE = 200.0


def planar(x: float, y: float, yaw: float) -> pycolmap.Rigid3d:
    return rigid3d_from_rotation(Rotation.from_euler('z', yaw), (x, y, 0.0))


ODOM_FROM_BASE = planar(3.0, -2.0, 0.7)
MAP_FROM_BASE = planar(-1.0, 5.0, -2.0)


def own(stamp_ns: int, x: float = 1.0) -> TransformStamped:
    return transform_message('map', 'odom', planar(x, 0.0, 0.0), stamp_ns)


# Stamps


@given(times=st.lists(TIMES, max_size=50), ahead=st.floats(0.0, 10.0))
def test_stamps_rise_strictly_ahead_of_a_clock_that_does_not_go_back(
    times: list[int], ahead: float
) -> None:
    rising = RisingStamps()
    stamps = [rising.next(now_ns, ahead) for now_ns in sorted(times)]
    given_out = [stamp for stamp in stamps if stamp is not None]
    assert all(before < after for before, after in pairwise(given_out))
    ahead_ns = round(ahead * SECOND)
    assert given_out == sorted({now_ns + ahead_ns for now_ns in times} - {0})


@given(times=st.lists(st.integers(10 * SECOND, 10**12)), ahead=st.lists(st.floats(0.0, 10.0)))
def test_stamps_rise_strictly_whatever_the_tolerance_is_set_to(
    times: list[int], ahead: list[float]
) -> None:
    rising = RisingStamps()
    stamps = [rising.next(*each) for each in zip(sorted(times), ahead, strict=False)]
    given_out = [stamp for stamp in stamps if stamp is not None]
    assert all(before < after for before, after in pairwise(given_out))


def test_stamps_start_anew_when_time_jumps_back() -> None:
    rising = RisingStamps()
    assert rising.next(100 * SECOND, 0.1) == 100_100_000_000
    assert rising.next(100 * SECOND, 0.1) is None
    assert rising.next(5 * SECOND, 0.1) == 5_100_000_000
    assert rising.next(5 * SECOND, 0.1) is None


# Owners


def test_what_this_node_has_sent_is_no_rival_when_it_comes_back() -> None:
    owners = Owners()
    sent = [own(stamp_ns) for stamp_ns in range(REMEMBERED)]
    for transform in sent:
        owners.sent(transform)
    for transform in sent:
        owners.heard(transform, 0.0, static=False)
    assert not owners.has_rival('odom', 0.0)


def test_another_transform_of_the_same_stamp_is_a_rival() -> None:
    """As of two relocalizers that share a /clock."""
    owners = Owners()
    owners.sent(own(7))
    owners.heard(own(7, x=2.0), 0.0, static=False)
    assert owners.has_rival('odom', 0.0)


def test_a_rival_is_one_from_whatever_parent() -> None:
    owners = Owners()
    owners.heard(transform_message('utm', '/odom', planar(0.0, 0.0, 0.0)), 0.0, static=False)
    assert owners.has_rival('odom', 0.0)
    assert not owners.has_rival('utm', 0.0)


def test_a_rival_is_forgotten_when_it_has_been_silent_for_a_while() -> None:
    owners = Owners()
    owners.heard(own(1), 10.0, static=False)
    owners.heard(own(2), 12.0, static=False)
    assert owners.has_rival('odom', 12.0 + 0.99 * RIVAL_S)
    assert not owners.has_rival('odom', 12.0 + RIVAL_S)


def test_a_static_rival_stays_one() -> None:
    """It is said once, and everybody who has heard it keeps it."""
    owners = Owners()
    owners.heard(own(0), 10.0, static=True)
    owners.heard(own(1), 20.0, static=False)
    assert owners.has_rival('odom', 1e9)


def test_transforms_of_other_frames_are_no_rivals() -> None:
    owners = Owners()
    owners.heard(transform_message('odom', 'base_link', planar(1.0, 0.0, 0.0)), 0.0, static=False)
    assert not owners.has_rival('odom', 0.0)
    assert not owners.has_rival('', 0.0)


# The broadcaster in a graph


class World:
    """Odometry, fixes and ears around a broadcaster."""

    def __init__(self, graph: Graph, *, metric: bool = True, **parameters: object) -> None:
        self.graph = graph
        self.heard: list[TransformStamped] = []
        health = Health()
        self.continuity = Continuity(ContinuityOptions(metric=metric))
        settings = {'publish_map_odom': True, 'map_odom_rate': OWN_RATE} | parameters
        self.parameters = NodeParameters(**settings)
        self.prior_listener = PriorListener(graph.own, self.parameters, self.continuity, health)
        self.transforms = TransformListener(graph.own)
        self.broadcaster = MapOdomBroadcaster(
            graph.own,
            self.parameters,
            self.continuity,
            self.prior_listener,
            self.transforms,
            health,
        )
        self._odometry = graph.world.create_publisher(Odometry, '/odom', 10)
        graph.world.create_subscription(
            TFMessage, '/tf', lambda message: self.heard.extend(message.transforms), 100
        )

    def drive(self, frame: str = 'odom') -> None:
        """Odometry at 1 s, as often as it takes to be heard."""
        message = Odometry(
            header=Header(stamp=stamp_from(SECOND), frame_id=frame), child_frame_id='base_link'
        )
        message.pose.pose = pose_message(ODOM_FROM_BASE)

        def is_heard() -> bool:
            self._odometry.publish(message)
            return self.prior_listener.odometry_frame == frame.strip('/')

        self.graph.spin_until(is_heard, 'the odometry')

    def get_fixes(self) -> None:
        """Two that agree, at the time of the odometry."""
        pose = RobotPose(MAP_FROM_BASE, np.eye(6) * 1e-4)
        for _ in range(2):
            self.continuity.judge(SECOND, ACCEPTED, pose)
        assert self.continuity.correction is not None

    def hear_broadcasts(self, number: int = 3) -> list[TransformStamped]:
        """The next ones, at least so many."""
        before = len(self.heard)
        self.graph.spin_until(lambda: len(self.heard) >= before + number, 'a broadcast')
        return self.heard[before:]

    def close(self) -> None:
        self.broadcaster.destroy()
        self.transforms.destroy()
        self.prior_listener.destroy()


@pytest.fixture
def make_world(graph: Graph) -> Iterator[Callable[..., World]]:
    made: list[World] = []

    def make(**options: object) -> World:
        made.append(World(graph, **options))
        return made[-1]

    yield make
    for world in made:
        world.close()


def wait_for_output(capfd: pytest.CaptureFixture[str], graph: Graph, text: str) -> str:
    """All that was put out until that text was."""
    output = ''

    def is_said() -> bool:
        nonlocal output
        output += capfd.readouterr().err
        return text in output

    graph.spin_until(is_said, f'`{text}` in the log')
    return output


def test_it_is_off_unless_asked_for(make_world: Callable[..., World], graph: Graph) -> None:
    world = make_world(publish_map_odom=False)
    assert '/tf' not in [publisher.topic_name for publisher in graph.own.publishers]
    assert '/tf' not in [each.topic_name for each in graph.own.subscriptions]
    assert not world.broadcaster.has_rival


def test_what_it_broadcasts_lays_the_odometry_on_the_fix(
    make_world: Callable[..., World], graph: Graph
) -> None:
    world = make_world(map_frame='/world', transform_tolerance=3.0)
    world.drive(frame='/odom')
    world.get_fixes()
    before_ns = graph.own.get_clock().now().nanoseconds
    broadcasts = world.hear_broadcasts()
    for transform in broadcasts:
        assert (transform.header.frame_id, transform.child_frame_id) == ('world', 'odom')
        map_from_base = rigid3d_from_message(transform.transform) * ODOM_FROM_BASE
        np.testing.assert_allclose(map_from_base.matrix(), MAP_FROM_BASE.matrix(), atol=1e-12)
    stamps = [nanoseconds_from(transform.header.stamp) for transform in broadcasts]
    assert all(before < after for before, after in pairwise(stamps))
    assert stamps[0] >= before_ns + 3 * SECOND
    assert stamps[-1] <= graph.own.get_clock().now().nanoseconds + 3 * SECOND
    assert not world.broadcaster.has_rival


def test_it_ends_when_there_is_no_correction_any_more(
    make_world: Callable[..., World], graph: Graph
) -> None:
    world = make_world()
    world.drive()
    world.get_fixes()
    world.hear_broadcasts()
    world.continuity.clear()
    # two turns of a timer of the same node, slower than the other one: it has had its turns too
    turns: list[None] = []
    slow = graph.own.create_timer(10.0 / OWN_RATE, lambda: turns.append(None))
    graph.spin_until(lambda: len(turns) >= 2, 'the timer')
    silent_since = len(world.heard)
    graph.spin_until(lambda: len(turns) >= 6, 'the timer')
    graph.own.destroy_timer(slow)
    assert len(world.heard) == silent_since


def test_rate_and_tolerance_change_while_it_runs(make_world: Callable[..., World]) -> None:
    world = make_world(map_odom_rate=0.1)
    world.drive()
    world.get_fixes()
    world.broadcaster.use(NodeParameters(publish_map_odom=True, map_odom_rate=OWN_RATE))
    before = nanoseconds_from(world.hear_broadcasts()[-1].header.stamp)
    world.broadcaster.use(
        NodeParameters(publish_map_odom=True, map_odom_rate=OWN_RATE, transform_tolerance=9.0)
    )
    assert nanoseconds_from(world.hear_broadcasts()[-1].header.stamp) > before + 8 * SECOND


def test_somebody_who_says_the_frame_is_static_silences_it(
    make_world: Callable[..., World], graph: Graph, capfd: pytest.CaptureFixture[str]
) -> None:
    """A static transform is said once, here before there is any odometry."""
    publisher = graph.world.create_publisher(TFMessage, '/tf_static', Topic.TF_STATIC.qos)
    publisher.publish(TFMessage(transforms=[transform_message('map', 'odom', planar(9, 9, 0))]))
    world = make_world()
    graph.spin_until(lambda: 'odom' in world.transforms.tree.frames, 'the static transform')
    world.drive()
    world.get_fixes()
    assert '`odom`' in wait_for_output(capfd, graph, 'somebody else broadcasts')
    assert world.broadcaster.has_rival
    assert world.heard == []


def test_of_two_relocalizers_the_first_one_owns_the_frame(
    make_world: Callable[..., World], graph: Graph
) -> None:
    first, second = make_world(transform_tolerance=1.0), make_world(transform_tolerance=9.0)
    for world in (first, second):
        world.drive()
    first.get_fixes()
    graph.spin_until(lambda: second.broadcaster.has_rival, 'the first one')
    second.get_fixes()
    until_ns = graph.own.get_clock().now().nanoseconds + 5 * SECOND
    broadcasts = first.hear_broadcasts(20)
    assert all(nanoseconds_from(each.header.stamp) < until_ns for each in broadcasts)
    assert not first.broadcaster.has_rival


@pytest.mark.parametrize('frame', ['', 'map', '/map'])
def test_a_frame_that_cannot_be_used_is_named(
    make_world: Callable[..., World], graph: Graph, capfd: pytest.CaptureFixture[str], frame: str
) -> None:
    world = make_world()
    world.drive(frame)
    world.get_fixes()
    output = wait_for_output(capfd, graph, f'is in frame `{frame.strip("/")}`')
    assert 'other than `map`' in output
    assert world.heard == []


def test_without_odometry_it_says_which_topic_is_silent(
    make_world: Callable[..., World], graph: Graph, capfd: pytest.CaptureFixture[str]
) -> None:
    make_world()
    assert '-r odom:=' in wait_for_output(capfd, graph, 'no odometry of `base_link`')


def test_on_a_map_that_is_not_metric_it_says_so(
    make_world: Callable[..., World], graph: Graph, capfd: pytest.CaptureFixture[str]
) -> None:
    make_world(metric=False)
    assert '--poses' in wait_for_output(capfd, graph, 'the map is not metric')


def test_without_the_package_of_the_messages_there_is_one_warning_and_no_more(
    make_world: Callable[..., World],
    graph: Graph,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for module in (transform_listener, map_odom_broadcaster):
        monkeypatch.setattr(module, 'TFMessage', None)
    world = make_world()
    world.transforms.listen()
    output = wait_for_output(capfd, graph, 'tf2_msgs is not installed')
    world.drive()
    world.get_fixes()
    output += capfd.readouterr().err
    assert output.count('[WARN]') == 1
    assert '/tf' not in [publisher.topic_name for publisher in graph.own.publishers]
