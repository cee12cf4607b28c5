# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from live_robot import NodeProcess, Robot, spinning_node

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path


@pytest.fixture
def robot() -> Iterator[Robot]:
    with spinning_node('robot') as node:
        yield Robot(node)


@pytest.fixture
def start_node(tmp_path: Path) -> Iterator[Callable[..., NodeProcess]]:
    """Starts the node with arguments and parameters; ends it when the test ends."""
    started: list[NodeProcess] = []

    def start(*arguments: str, **options: Any) -> NodeProcess:  # noqa: ANN401 - of NodeProcess
        log = tmp_path / f'node_{len(started)}.log'
        started.append(NodeProcess(log, *arguments, **options))
        return started[-1]

    yield start
    for node in started:
        node.process.kill()
        node.process.wait()
