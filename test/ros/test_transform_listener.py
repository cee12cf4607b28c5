# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_graph import transform_message
from scipy.spatial.transform import Rotation
from tf2_msgs.msg import TFMessage

from gam_relocalizer.errors import TransformError
from gam_relocalizer.geometry import rigid3d_from, rigid3d_from_rotation
from gam_relocalizer.ros.interface import Topic
from gam_relocalizer.ros.transform_listener import TransformListener

if TYPE_CHECKING:
    from collections.abc import Iterator

    import pycolmap
    from geometry_msgs.msg import TransformStamped
    from rclpy.publisher import Publisher
    from ros_graph import Graph

# as tf2_ros latches them: one message with all that the publisher has to say
LATCHED = QoSProfile(depth=1, durability=1)
SECOND = 10**9
BASE_FROM_MAST = rigid3d_from((1.0, 0.0, 0.0, 0.0), (0.1, 0.0, 1.2))
HEAD_FROM_CAMERA = rigid3d_from((0.5, -0.5, 0.5, -0.5), (0.05, 0.0, 0.02))


def mast_from_head(pan: float, tilt: float = 0.0) -> pycolmap.Rigid3d:
    return rigid3d_from_rotation(Rotation.from_euler('ZY', [pan, tilt]), (0.0, 0.0, 0.1))


@pytest.fixture
def listener(graph: Graph) -> Iterator[TransformListener]:
    listener = TransformListener(graph.own)
    listener.listen()
    yield listener
    listener.destroy()


def latch(graph: Graph, *transforms: TransformStamped) -> Publisher:
    """Says it once, as a node does that publishes static transforms."""
    publisher = graph.world.create_publisher(TFMessage, '/tf_static', LATCHED)
    publisher.publish(TFMessage(transforms=list(transforms)))
    return publisher


def base_from_camera(
    graph: Graph, listener: TransformListener, stamp_ns: int = 0
) -> pycolmap.Rigid3d:
    """As soon as it is known."""
    found: list[pycolmap.Rigid3d] = []

    def is_known() -> bool:
        try:
            found.append(listener.tree.lookup('base_link', 'camera', stamp_ns))
        except TransformError:
            return False
        return True

    graph.spin_until(is_known, 'the mount')
    return found[0]


class PanTilt:
    """A head on a mast that says now and then how it is turned."""

    def __init__(self, graph: Graph) -> None:
        self._publisher = graph.world.create_publisher(TFMessage, '/tf', Topic.TF.qos)
        graph.spin_until(self._publisher.get_subscription_count, 'a subscription')

    def say(self, stamp_ns: int, pan: float, tilt: float = 0.0) -> None:
        transform = transform_message('mast', 'head', mast_from_head(pan, tilt), stamp_ns)
        self._publisher.publish(TFMessage(transforms=[transform]))


def assert_same(found: pycolmap.Rigid3d, expected: pycolmap.Rigid3d) -> None:
    np.testing.assert_allclose(found.matrix(), expected.matrix(), atol=1e-12)


def test_a_late_joiner_hears_what_several_have_said_once(graph: Graph) -> None:
    publishers = [
        latch(graph, transform_message('base_link', 'mast', BASE_FROM_MAST)),
        latch(graph, transform_message('head', 'camera', HEAD_FROM_CAMERA)),
        latch(graph, transform_message('mast', 'head', mast_from_head(0.3))),
    ]
    listener = TransformListener(graph.own)
    listener.listen()
    expected = BASE_FROM_MAST * mast_from_head(0.3) * HEAD_FROM_CAMERA
    assert_same(base_from_camera(graph, listener), expected)
    assert len(publishers) == 3  # they have lived until now
    listener.destroy()


def test_a_head_that_turns_is_where_it_was_at_the_stamp(
    graph: Graph, listener: TransformListener
) -> None:
    fixed = latch(
        graph,
        transform_message('base_link', 'mast', BASE_FROM_MAST),
        transform_message('head', 'camera', HEAD_FROM_CAMERA),
    )
    head = PanTilt(graph)
    head.say(10 * SECOND, pan=-0.4)
    head.say(11 * SECOND, pan=0.8)
    # a quarter of the way: -0.4 + 1.2 / 4
    expected = BASE_FROM_MAST * mast_from_head(-0.1) * HEAD_FROM_CAMERA
    assert_same(base_from_camera(graph, listener, round(10.25 * SECOND)), expected)
    assert fixed is not None


def test_a_transform_may_come_after_the_image_that_needs_it(
    graph: Graph, listener: TransformListener
) -> None:
    fixed = latch(
        graph,
        transform_message('base_link', 'mast', BASE_FROM_MAST),
        transform_message('head', 'camera', HEAD_FROM_CAMERA),
    )
    head = PanTilt(graph)
    head.say(10 * SECOND, pan=0.0, tilt=0.0)
    graph.spin_until(lambda: {'camera', 'head', 'base_link'} <= set(listener.tree.frames), 'frames')
    with pytest.raises(TransformError, match='known from'):
        listener.tree.lookup('base_link', 'camera', round(10.5 * SECOND))
    head.say(11 * SECOND, pan=0.0, tilt=0.5)
    expected = BASE_FROM_MAST * mast_from_head(0.0, 0.25) * HEAD_FROM_CAMERA
    assert_same(base_from_camera(graph, listener, round(10.5 * SECOND)), expected)
    assert fixed is not None


def test_a_camera_that_is_mounted_elsewhere_is_where_it_is_now(
    graph: Graph, listener: TransformListener
) -> None:
    latch(graph, transform_message('base_link', 'camera', BASE_FROM_MAST))
    assert_same(base_from_camera(graph, listener), BASE_FROM_MAST)
    latch(
        graph,
        transform_message('base_link', 'arm', HEAD_FROM_CAMERA),
        transform_message('arm', 'camera', BASE_FROM_MAST),
    )
    graph.spin_until(lambda: 'arm' in listener.tree.frames, 'the arm')
    assert_same(base_from_camera(graph, listener), HEAD_FROM_CAMERA * BASE_FROM_MAST)


def test_what_cannot_be_used_is_named_and_the_rest_counts(
    graph: Graph, listener: TransformListener, capfd: pytest.CaptureFixture[str]
) -> None:
    broken = transform_message('base_link', 'wheel', BASE_FROM_MAST)
    broken.transform.rotation.w = 0.0
    fixed = latch(graph, broken, transform_message('base_link', 'camera', BASE_FROM_MAST))
    assert_same(base_from_camera(graph, listener), BASE_FROM_MAST)
    assert 'ignored from /tf_static' in capfd.readouterr().err
    assert 'wheel' not in listener.tree.frames
    assert fixed is not None


def test_nobody_is_listened_to_before_somebody_wants_to_know(graph: Graph) -> None:
    def topics() -> list[str]:
        names = [subscription.topic_name for subscription in graph.own.subscriptions]
        return [name for name in names if name.startswith('/tf')]

    listener = TransformListener(graph.own)
    assert topics() == []
    listener.listen()
    listener.listen()
    assert topics() == ['/tf', '/tf_static']
    listener.destroy()
    assert topics() == []


def test_watchers_see_every_transform_and_whether_it_is_static(graph: Graph) -> None:
    listener = TransformListener(graph.own)
    seen: list[tuple[str, bool]] = []
    listener.watch(lambda transform, static: seen.append((transform.child_frame_id, static)))
    fixed = latch(graph, transform_message('base_link', 'mast', BASE_FROM_MAST))
    PanTilt(graph).say(SECOND, pan=0.0)
    graph.spin_until(lambda: len(seen) == 2, 'two transforms')
    assert set(seen) == {('mast', True), ('head', False)}
    assert fixed is not None
    listener.destroy()


def test_a_publisher_that_cannot_be_heard_is_named_by_its_topic(
    graph: Graph, capfd: pytest.CaptureFixture[str]
) -> None:
    listener = TransformListener(graph.own)
    listener.listen()
    best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    publisher = graph.world.create_publisher(TFMessage, '/tf', best_effort)
    output = ''

    def is_said() -> bool:
        nonlocal output
        output += capfd.readouterr().err
        return 'a publisher on /tf:' in output

    graph.spin_until(is_said, 'a line in the log')
    graph.world.destroy_publisher(publisher)
    listener.destroy()
