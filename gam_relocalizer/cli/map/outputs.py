# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Files that a command is told to write."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gam_relocalizer.errors import UsageError

if TYPE_CHECKING:
    from pathlib import Path


def check_file_to_write(file: Path, option: str) -> None:
    """Refuses, before the work, a file that cannot be put in place at its end.

    A finished file is renamed over what is there: a device such as `/dev/null` would be gone.

    Raises:
        UsageError: There is something else than a file already, or no folder for it.
    """
    if file.exists() and not file.is_file():
        msg = f'{file}: is not a file that can be replaced; give another name with {option}'
        raise UsageError(msg)
    if not file.parent.is_dir():
        msg = f'{file}: there is no folder {file.parent}; create it, or give {option} another place'
        raise UsageError(msg)


def check_folder_to_write(folder: Path, option: str) -> None:
    """Refuses, before the work, a folder that cannot be made at its end.

    Raises:
        UsageError: It, or what it is to be in, is something else than a folder.
    """
    there = next(one for one in (folder, *folder.absolute().parents) if one.exists())
    if not there.is_dir():
        msg = f'{folder}: {there} is not a folder; give another place with {option}'
        raise UsageError(msg)
