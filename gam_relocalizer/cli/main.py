# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The `gam_relocalizer` command: registers the sub-commands and turns errors into exit codes."""

from __future__ import annotations

import signal
import sys
from typing import Annotated

import typer
from rich.console import Console

from gam_relocalizer import __version__
from gam_relocalizer.cli import augment, demo, evaluate, localize, node, replay, train, view
from gam_relocalizer.cli import map as map_commands
from gam_relocalizer.errors import RelocalizerError, UsageError

EXIT_FAILURE = 1
EXIT_USAGE = 2

app = typer.Typer(
    name='gam_relocalizer',
    help='Visual relocalization by Geometry-Aided Matching: from an image to a pose in a map.',
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.add_typer(map_commands.app, name='map')
app.command()(localize.localize)
app.command()(replay.replay)
app.command()(view.view)
app.command()(augment.augment)
app.command(
    context_settings={'allow_extra_args': True, 'ignore_unknown_options': True},
)(node.node)
app.command()(train.train)
app.add_typer(evaluate.app, name='evaluate')
app.command()(demo.demo)


def _print_version(requested: bool) -> None:  # noqa: FBT001 - the signature of a typer callback
    if requested:
        Console().print(f'gam_relocalizer {__version__}', highlight=False)
        raise typer.Exit


@app.callback()
def _root(
    *,
    _version: Annotated[
        bool,
        typer.Option(
            '--version',
            help='Print the version and leave.',
            callback=_print_version,
            is_eager=True,
        ),
    ] = False,
) -> None:
    pass


def main() -> None:
    """Runs the command line; exits with 0, 1 (failure) or 2 (the arguments cannot be used)."""
    # The logging library inside pycolmap answers SIGTERM with a stack trace: what was there before
    # it, as Python remembers it.
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)
    try:
        app()
    except RelocalizerError as err:
        _print_error(str(err))
        sys.exit(EXIT_USAGE if isinstance(err, UsageError) else EXIT_FAILURE)
    except OSError as err:  # a full disk, a folder that may not be written to
        _print_error(f'{err.filename}: {err.strerror}' if err.filename else str(err))
        sys.exit(EXIT_FAILURE)


def _print_error(text: str) -> None:
    Console(stderr=True).print(f'error: {text}', style='red', markup=False, soft_wrap=True)


if __name__ == '__main__':
    main()
