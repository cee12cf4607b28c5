# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Plays a rosbag2 into DDS, byte for byte: what `ros2 bag play` does, where only pip is at hand."""

from __future__ import annotations

import importlib
import time
from typing import TYPE_CHECKING, Any

from builtin_interfaces.msg import Time
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock

from gam_relocalizer.errors import BagError
from gam_relocalizer.replay.bag import NANOSECONDS, open_bag

if TYPE_CHECKING:
    from collections.abc import Collection
    from pathlib import Path

    from rclpy.node import Node
    from rclpy.publisher import Publisher

LATCHED_TOPICS = frozenset({'/tf_static'})


class BagPlayer:
    """Publishes the messages of a bag at their recorded pace, and /clock with them."""

    def __init__(self, node: Node, bag: Path, topics: Collection[str]) -> None:
        """Creates the publishers.

        Args:
            node: The node that publishes; spinning it is the caller's business.
            bag: A rosbag2.
            topics: The topics to play; `/clock` is always published.

        Raises:
            BagError: A topic is not in the bag, or the bag cannot be read.
        """
        self._bag = bag
        self._publishers: dict[str, Publisher] = {}
        with open_bag(bag) as reader:
            for topic in topics:
                if topic not in reader.topics:
                    msg = f'{bag}: no topic {topic}; it has {", ".join(reader.topics)}'
                    raise BagError(msg)
                message_type = _message_type(reader.topics[topic].type)
                self._publishers[topic] = node.create_publisher(message_type, topic, _qos(topic))
        self._clock = node.create_publisher(Clock, '/clock', 10)

    def subscriptions(self, topic: str) -> int:
        """How many subscriptions DDS has matched with a topic of the bag."""
        count: int = self._publishers[topic].get_subscription_count()
        return count

    def play(self, rate: float = 1.0) -> None:
        """Plays the whole bag once; returns after the last message.

        Args:
            rate: Bag seconds per second of the wall clock.
        """
        with open_bag(self._bag) as reader:
            begin_wall, begin_bag = time.monotonic(), reader.time_range[0]
            for topic, log_ns, raw in reader.raw_messages(self._publishers):
                elapsed = (log_ns - begin_bag) / NANOSECONDS / rate
                time.sleep(max(0.0, begin_wall + elapsed - time.monotonic()))
                seconds, nanoseconds = divmod(log_ns, NANOSECONDS)
                self._clock.publish(Clock(clock=Time(sec=seconds, nanosec=nanoseconds)))
                self._publishers[topic.name].publish(raw)


def _qos(topic: str) -> QoSProfile:
    if topic in LATCHED_TOPICS:
        return QoSProfile(
            depth=1,
            durability=DurabilityPolicy.TRANSIENT_LOCAL,
            reliability=ReliabilityPolicy.RELIABLE,
        )
    return QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)


def _message_type(name: str) -> Any:  # noqa: ANN401 - any generated message class
    package, kind, message = name.split('/')
    return getattr(importlib.import_module(f'{package}.{kind}'), message)
