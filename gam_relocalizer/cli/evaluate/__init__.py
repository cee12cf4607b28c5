# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The `evaluate` commands: the parts and the whole against the truth."""

from __future__ import annotations

import typer

from gam_relocalizer.cli.evaluate import localization, matching, timing

app = typer.Typer(help='Measure how good the parts are.', no_args_is_help=True)
app.command()(matching.matching)
app.command()(localization.localization)
app.command()(timing.timing)
