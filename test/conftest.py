# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import re
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING

import pytest

from gam_relocalizer.errors import UsageError

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


# A ROS workspace may lack them: they come with extras of pip, and only some tests need them.
OPTIONAL = frozenset({'miniworld', 'playwright', 'rerun', 'rerun_cli', 'tf2_msgs'})


def lacking(error: BaseException | None) -> str | None:
    """What is not installed and therefore the cause of an error; in CI everything must be."""
    if os.environ.get('CI'):
        return None
    if isinstance(error, pytest.Collector.CollectError):
        error = error.__cause__
    if isinstance(error, ModuleNotFoundError) and error.name in OPTIONAL:
        return f'{error.name} is not installed'
    # Our own words for a missing extra.
    found = re.search(r'gam_relocalizer\[\w+\]', str(error))
    return f'{found[0]} is not installed' if isinstance(error, UsageError) and found else None


@pytest.hookimpl(hookwrapper=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Iterator[None]:
    """Skips a module that imports what is not installed."""
    outcome = yield
    report = outcome.get_result()
    call = getattr(report, 'call', None)
    if call is not None and call.excinfo and (reason := lacking(call.excinfo.value)):
        report.outcome = 'skipped'
        report.longrepr = (str(collector.path), 0, f'Skipped: {reason}')


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[None]:
    """Skips a test that needs what is not installed."""
    outcome = yield
    if call.excinfo and (reason := lacking(call.excinfo.value)):
        report = outcome.get_result()
        report.outcome = 'skipped'
        report.longrepr = (str(item.path), 0, f'Skipped: {reason}')


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
