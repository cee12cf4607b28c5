# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The `map` commands: build, inspect and change maps."""

from __future__ import annotations

import typer

from gam_relocalizer.cli.map import align, build, change, importing, inspect

app = typer.Typer(help='Build, inspect, align and change maps.', no_args_is_help=True)
app.command()(build.build)
app.command()(inspect.info)
app.command()(inspect.check)
app.command()(align.align)
app.command('import')(importing.import_map)
app.command()(change.extend)
app.command()(change.merge)
app.command()(change.prune)
