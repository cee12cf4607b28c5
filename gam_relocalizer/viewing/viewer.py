# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Opens a recording in rerun's viewer, a program of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import TYPE_CHECKING

from gam_relocalizer.errors import ViewerError
from gam_relocalizer.viewing.recording import import_rerun

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

# `-m rerun_cli` would hide the viewer's exit code.
_PROGRAM = 'import sys; from rerun_cli.__main__ import main; sys.exit(main())'
# The viewer listens for recordings; only this machine may send it any.
_OPTIONS = ('--bind', '127.0.0.1', '--port', 'auto', '--hide-welcome-screen')
# It counts its users, but not where tests run.
_NO_ANALYTICS = {'CI': 'true', 'TELEMETRY_ENABLED': 'false'}
_FORCED_ANALYTICS = 'FORCE_RERUN_ANALYTICS'
# It asks for news of itself whenever it starts, and has no option against that. So all that is not
# on this machine is to be had through a proxy that nobody runs: the port of the discard service.
_NOWHERE = 'http://127.0.0.1:9'
_NO_NETWORK = {
    **dict.fromkeys(('HTTP_PROXY', 'HTTPS_PROXY', 'ALL_PROXY'), _NOWHERE),
    **dict.fromkeys(('http_proxy', 'https_proxy', 'all_proxy'), _NOWHERE),
    **dict.fromkeys(('NO_PROXY', 'no_proxy'), 'localhost,127.0.0.1'),
}


def show(file: Path) -> None:
    """Opens a recording and waits until the viewer is closed.

    Raises:
        UsageError: rerun is not installed.
        ViewerError: The viewer did not start, as without a display, or failed.
    """
    import_rerun()
    done = subprocess.run(  # noqa: S603 - our own interpreter and file
        viewer_command(file), env=viewer_environment(os.environ), check=False
    )
    if done.returncode != 0:
        msg = (
            f'the viewer ended with code {done.returncode}; without a display, write the recording '
            f'with --save and open it elsewhere with `rerun FILE.rrd`'
        )
        raise ViewerError(msg)


def viewer_command(file: Path) -> list[str]:
    """The viewer with a recording, reachable from this machine alone."""
    return [sys.executable, '-c', _PROGRAM, str(file), *_OPTIONS]


def viewer_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """An environment in which the viewer reaches nobody, and tells nobody that it is used."""
    kept = {name: value for name, value in environment.items() if name != _FORCED_ANALYTICS}
    return {**kept, **_NO_ANALYTICS, **_NO_NETWORK}
