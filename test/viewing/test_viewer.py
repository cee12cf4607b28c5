# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""How the viewer is started."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from gam_relocalizer.errors import ViewerError
from gam_relocalizer.viewing.viewer import show, viewer_command, viewer_environment

pytest.importorskip('rerun', reason='the extra `view` is not installed')


def test_the_viewer_knows_every_option_that_it_is_given() -> None:
    done = subprocess.run(
        [*viewer_command(Path('map.rrd')), '--help'],
        env=viewer_environment({}),
        capture_output=True,
        text=True,
        check=True,
    )

    options = [word for word in viewer_command(Path('map.rrd')) if word.startswith('--')]
    assert '--bind' in options
    assert all(option in done.stdout for option in options)


def test_the_viewer_counts_nobody(tmp_path: Path) -> None:
    environment = viewer_environment(
        {'FORCE_RERUN_ANALYTICS': '1', 'HOME': str(tmp_path), 'RUST_LOG': 're_analytics=debug'}
    )

    # without a display the viewer ends before it draws anything, and long after it counted
    done = subprocess.run(
        viewer_command(tmp_path / 'map.rrd'),
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )

    assert 'Analytics disabled' in done.stderr + done.stdout
    assert not list(tmp_path.rglob('analytics.json'))


def test_the_viewer_reaches_nobody() -> None:
    given = {'https_proxy': 'http://proxy.example:3128', 'NO_PROXY': '*', 'DISPLAY': ':0'}

    environment = viewer_environment(given)

    assert environment['DISPLAY'] == ':0'
    for name in ('http_proxy', 'https_proxy', 'all_proxy'):
        assert environment[name] == environment[name.upper()] == 'http://127.0.0.1:9'
    assert environment['NO_PROXY'] == environment['no_proxy'] == 'localhost,127.0.0.1'


def test_a_viewer_that_cannot_start_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ('DISPLAY', 'WAYLAND_DISPLAY', 'WAYLAND_SOCKET'):
        monkeypatch.delenv(name, raising=False)

    with pytest.raises(ViewerError):
        show(tmp_path / 'map.rrd')
