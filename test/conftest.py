# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator
    from contextlib import AbstractContextManager

    from tiny_place import TinyPlace

# Message classes read this when they are imported: a wrong type in a field becomes an error.
os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'

try:
    from domain_coordinator import domain_id
except ImportError:  # a tool for building ROS packages, not needed to run them

    @contextmanager
    def domain_id() -> Iterator[int]:
        yield os.getpid() % 100 + 1


@pytest.fixture(scope='session', autouse=True)
def ros_domain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keeps the ROS graphs of two test runs apart, and their logs out of the home folder."""
    environment = pytest.MonkeyPatch()
    with ExitStack() as stack:
        stack.callback(environment.undo)
        own_domain: AbstractContextManager[int] = domain_id()
        environment.setenv('ROS_DOMAIN_ID', str(stack.enter_context(own_domain)))
        environment.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
        environment.setenv('ROS_LOG_DIR', str(tmp_path_factory.mktemp('ros_log')))
        yield


@pytest.fixture(scope='session')
def tiny_place(tmp_path_factory: pytest.TempPathFactory) -> TinyPlace:
    """A room with a map and a recorded drive; takes a while, so all tests share it."""
    from tiny_place import make_tiny_place

    return make_tiny_place(tmp_path_factory.mktemp('tiny_place'))
