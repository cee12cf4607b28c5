# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The `map` commands: build, inspect and change maps."""

from __future__ import annotations

import typer

from gam_relocalizer.cli.map import build, inspect

app = typer.Typer(help='Build, inspect, align and change maps.', no_args_is_help=True)
app.command()(build.build)
app.command()(inspect.info)
app.command()(inspect.check)
