# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
import rclpy
from ros_graph import Graph

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture
def ros() -> Iterator[None]:
    rclpy.init(args=[])
    yield
    rclpy.try_shutdown()


@pytest.fixture
def graph(ros: None) -> Iterator[Graph]:  # noqa: ARG001 - ROS must be up
    graph = Graph()
    yield graph
    graph.close()
