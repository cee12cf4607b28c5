# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import time
from contextlib import contextmanager
from typing import TYPE_CHECKING

import pytest
import rclpy
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Int32

from gam_relocalizer.ros.executor import MOST_IN_A_ROW, GatheringExecutor

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rclpy.node import Node

LIMIT_S = 20.0
WAIT_S = 0.1


class Spun:
    """A node under the executor, in the thread of the test."""

    def __init__(self, node: Node, executor: GatheringExecutor) -> None:
        self.node = node
        self.executor = executor

    def until(self, condition: Callable[[], object], limit: float = LIMIT_S) -> bool:
        give_up = time.monotonic() + limit
        while not condition() and time.monotonic() < give_up:
            self.executor.spin_once(timeout_sec=WAIT_S)
        return bool(condition())


@contextmanager
def spun_node() -> Iterator[Spun]:
    context = rclpy.Context()
    rclpy.init(args=[], context=context)
    node = rclpy.create_node('listener', context=context)
    executor = GatheringExecutor(context=context)
    executor.add_node(node)
    try:
        yield Spun(node, executor)
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown(context=context)


@pytest.fixture
def spun() -> Iterator[Spun]:
    with spun_node() as one:
        yield one


def test_every_message_of_a_burst_is_handled_once_and_in_order(spun: Spun) -> None:
    count = 2 * MOST_IN_A_ROW + 7
    heard: list[int] = []
    qos = QoSProfile(depth=count, reliability=ReliabilityPolicy.RELIABLE)
    publisher = spun.node.create_publisher(Int32, 'burst', qos)
    spun.node.create_subscription(Int32, 'burst', lambda m: heard.append(m.data), qos)
    assert spun.until(publisher.get_subscription_count)
    for number in range(count):
        publisher.publish(Int32(data=number))
    assert spun.until(lambda: len(heard) >= count)
    assert heard == list(range(count))


def test_a_flood_on_one_topic_leaves_the_others_and_timers_their_turn(spun: Spun) -> None:
    heard: list[str] = []
    flood = spun.node.create_publisher(Int32, 'flood', 1000)
    other = spun.node.create_publisher(Int32, 'other', 10)

    def go_on(_: Int32) -> None:
        heard.append('flood')
        flood.publish(Int32())  # there is always one more

    spun.node.create_subscription(Int32, 'flood', go_on, 1000)
    spun.node.create_subscription(Int32, 'other', lambda _: heard.append('other'), 10)
    spun.node.create_timer(0.001, lambda: heard.append('timer'))
    assert spun.until(lambda: flood.get_subscription_count() and other.get_subscription_count())
    flood.publish(Int32())
    other.publish(Int32())
    assert spun.until(lambda: {'flood', 'other', 'timer'} <= set(heard))


def test_a_subscription_may_go_while_its_messages_are_handled(spun: Spun) -> None:
    heard: list[int] = []
    publisher = spun.node.create_publisher(Int32, 'last', 10)

    def hear_one(message: Int32) -> None:
        heard.append(message.data)
        spun.node.destroy_subscription(subscription)

    subscription = spun.node.create_subscription(Int32, 'last', hear_one, 10)
    assert spun.until(publisher.get_subscription_count)
    for number in range(5):
        publisher.publish(Int32(data=number))
    assert spun.until(lambda: heard)
    spun.until(lambda: False, limit=3 * WAIT_S)
    assert heard == [0]


def test_an_incompatible_publisher_is_reported_while_messages_flood_in(spun: Spun) -> None:
    heard: list[int] = []
    events: list[object] = []
    publisher = spun.node.create_publisher(Int32, 'numbers', 10)
    spun.node.create_subscription(Int32, 'numbers', lambda m: heard.append(m.data), 10)
    spun.node.create_timer(0.005, lambda: publisher.publish(Int32()))
    assert spun.until(lambda: heard)
    spun.node.create_subscription(
        Int32,
        'image',
        lambda _: None,
        QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE),
        event_callbacks=SubscriptionEventCallbacks(incompatible_qos=events.append),
    )
    spun.node.create_publisher(
        Int32, 'image', QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    )
    assert spun.until(lambda: events)
    assert len(heard) > 1
