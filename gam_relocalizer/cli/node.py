# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`gam_relocalizer node`: the ROS 2 node, as `ros2 run gam_relocalizer node` starts it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gam_relocalizer.errors import UsageError

ROS_ARGS = '--ros-args'


def node(
    context: typer.Context,
    map_path: Annotated[
        Path | None, typer.Option('--map', help='Map bundle; sets the parameter `map`.')
    ] = None,
) -> None:
    """Runs the ROS 2 node; ROS arguments are passed on.

    Example: gam_relocalizer node --map maps/demo --ros-args -p period:=1.0 -r image:=/camera/image
    """
    args = context.args
    if args and args[0] != ROS_ARGS:
        msg = f'unknown argument `{args[0]}`; ROS arguments come after {ROS_ARGS}'
        raise UsageError(msg)
    try:
        from gam_relocalizer.ros.main import run
    except ModuleNotFoundError as err:
        msg = (
            f'the node needs ROS 2, and `{err.name}` is missing: source your ROS 2 installation '
            f'and build the workspace, or install the `ros` extra and gam_relocalizer_msgs'
        )
        raise UsageError(msg) from err
    run(args, None if map_path is None else str(map_path))
