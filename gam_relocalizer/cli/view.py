# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`view`."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated

import typer

from gam_relocalizer.cli.map.outputs import check_file_to_write
from gam_relocalizer.cli.map.printing import MapArgument


def view(
    path: MapArgument,
    replay: Annotated[
        Path | None,
        typer.Option(help='Output folder of `gam_relocalizer replay` with this map, to be shown.'),
    ] = None,
    save: Annotated[
        Path | None,
        typer.Option(help='Write a recording (.rrd) for `rerun FILE.rrd` instead of showing it.'),
    ] = None,
) -> None:
    """Shows a map in 3D with rerun: points, cameras, covisibility, and a replayed drive.

    Needs rerun, the extra `view` of the package. Nothing leaves this machine.
    """
    from gam_relocalizer.scene_map import load_map
    from gam_relocalizer.viewing.drive import read_drive
    from gam_relocalizer.viewing.recording import import_rerun, write_recording
    from gam_relocalizer.viewing.viewer import show

    import_rerun()  # before the work, and not after it
    if save is not None:
        check_file_to_write(save, '--save')
    scene_map = load_map(path)
    drive = None if replay is None else read_drive(replay)
    if drive is not None and drive.map_id != scene_map.manifest.map_id:
        typer.echo(
            f'warning: {replay} was localized in map {drive.map_id}, this is '
            f'{scene_map.manifest.map_id}: the poses may not fit',
            err=True,
        )
    if save is not None:
        write_recording(save, scene_map, drive)
        typer.echo(f'recording: {save}')
        return
    with tempfile.TemporaryDirectory(prefix='view_') as folder:
        file = Path(folder, f'{path.resolve().name}.rrd')
        write_recording(file, scene_map, drive)
        show(file)
