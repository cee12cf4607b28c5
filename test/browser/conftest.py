# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Pages as the commands write them, and a real browser to look at them with."""

from __future__ import annotations

import os
import shutil
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import cv2
import pytest
from typer.testing import CliRunner

from gam_relocalizer.cameras import format_camera
from gam_relocalizer.cli.main import app
from gam_relocalizer.geometry import write_poses

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from contextlib import AbstractContextManager
    from pathlib import Path

    from playwright.sync_api import Browser, Page
    from tiny_place import TinyPlace

HOW_TO_INSTALL = '`apt install chromium` and `pip install playwright` (no download of its browsers)'
OPTIONS = [
    '--no-sandbox', '--disable-gpu', '--disable-quic', '--no-first-run',
    '--disable-background-networking', '--disable-component-update', '--disable-sync',
]  # fmt: skip


def missing(what: str) -> None:
    """Skips, but not where the browser is a promise."""
    message = f'{what} is not installed: {HOW_TO_INSTALL}'
    if os.environ.get('CI'):
        pytest.fail(message)
    pytest.skip(message)


@pytest.fixture(scope='session')
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """Chromium without a window, in an environment without the libraries of ROS."""
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        missing('playwright')
    program = shutil.which('chromium')
    if program is None:
        missing('chromium')
    home = str(tmp_path_factory.mktemp('browser'))
    environment = {'HOME': home, 'PATH': os.environ['PATH'], 'TMPDIR': home}
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(
            executable_path=program, args=OPTIONS, env=environment
        )
        yield chromium
        chromium.close()


@dataclass
class Shown:
    """A page in the browser, and what it did."""

    page: Page
    requests: list[str] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)


@pytest.fixture
def show(browser: Browser) -> Callable[..., AbstractContextManager[Shown]]:
    """Opens a file as a double click does, on a screen of given size."""

    @contextmanager
    def shown(file: Path, **screen: object) -> Iterator[Shown]:
        context = browser.new_context(**screen)
        context.set_default_timeout(60_000)
        seen = Shown(context.new_page())
        seen.page.on('request', lambda request: seen.requests.append(request.url))
        seen.page.on('console', lambda message: seen.complaints.append(message.text))
        seen.page.on('pageerror', lambda error: seen.complaints.append(str(error)))
        seen.page.goto(file.resolve().as_uri(), wait_until='load')
        yield seen
        context.close()

    return shown


def run(*arguments: object) -> None:
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert done.exit_code == 0, done.output


@pytest.fixture(scope='session')
def replayed(tiny_place: TinyPlace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `replay` leaves of a drive with odometry and truth."""
    out = tmp_path_factory.mktemp('replays') / 'out'
    run(
        'replay', tiny_place.bag, '--map', tiny_place.map_path, '--out', out, '--period', 1.0,
        '--odom-topic', '/odom', '--truth-topic', '/ground_truth',
    )  # fmt: skip
    return out


@pytest.fixture(scope='session')
def evaluated(tiny_place: TinyPlace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `evaluate localization` leaves."""
    folder = tmp_path_factory.mktemp('evaluation')
    (folder / 'queries').mkdir()
    truth = {}
    for index, (image, camera_from_map) in enumerate(tiny_place.queries[:3]):
        truth[f'{index}.png'] = camera_from_map
        picture = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(folder / 'queries' / f'{index}.png'), picture)
    write_poses(folder / 'truth.txt', truth)
    run(
        'evaluate', 'localization', '--map', tiny_place.map_path, '--queries', folder / 'queries',
        '--truth', folder / 'truth.txt', '--camera', format_camera(tiny_place.camera),
        '--matcher', 'nn-ratio', '--out', folder / 'out',
    )  # fmt: skip
    return folder / 'out'


@pytest.fixture(scope='session', params=['replay', 'localization'])
def page_file(request: pytest.FixtureRequest) -> Path:
    """The page of each command."""
    if request.param == 'replay':
        return request.getfixturevalue('replayed') / 'report.html'
    return request.getfixturevalue('evaluated') / 'localization.html'
