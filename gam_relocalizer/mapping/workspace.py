# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The folder beside a map where the steps of a build keep their results.

    WORKSPACE.txt             says what the folder is; locked while a build uses it
    <step>/<key>.npz          a result of arrays: a SHA-256 sum, then NumPy's npz of what it sums
    <step>/<key>/             a result of files, with their sizes and sums in sums.json

A key is a hash of everything that a result depends on (`key_of`): what is found under its key needs
no further check of dates or options. Results are written under a temporary name and renamed, so
that a build that is killed leaves whole results or none. One whose sum is wrong is as good as none.
"""

from __future__ import annotations

import fcntl
import hashlib
import io
import json
import shutil
import tempfile
import zipfile
import zlib
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gam_relocalizer.errors import MapBuildError
from gam_relocalizer.scene_map import sha256_of

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping

    from numpy.typing import NDArray

MARKER = 'WORKSPACE.txt'
_EXPLANATION = (
    'Finished steps of a gam_relocalizer map build. With them an interrupted build continues, and\n'
    'one with other options repeats only what depends on them. The map does not need this folder:\n'
    'delete it whenever no build is running.\n'
)
_SUMS = 'sums.json'
_PART = '.part'
_SUM_BYTES = hashlib.sha256().digest_size


def key_of(**inputs: object) -> str:
    """The name of a result: a hash of everything it depends on.

    Args:
        inputs: Numbers, texts, None, and lists and mappings of them.
    """
    text = json.dumps(inputs, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


class Workspace:
    """Results of the steps of one build, each under its key; see `open_workspace`."""

    def __init__(self, path: Path) -> None:
        self._path = path

    @property
    def path(self) -> Path:
        """The folder."""
        return self._path

    @property
    def size(self) -> int:
        """Bytes of all its files."""
        return sum(file.stat().st_size for file in self._path.rglob('*') if file.is_file())

    def load(self, step: str, key: str) -> dict[str, NDArray[Any]] | None:
        """The arrays of a result; None when there is none, or a damaged one."""
        try:
            data = self._arrays(step, key).read_bytes()
        except OSError:
            return None
        stated, stored = data[:_SUM_BYTES], data[_SUM_BYTES:]
        if hashlib.sha256(stored).digest() != stated:
            return None
        try:
            with np.load(io.BytesIO(stored), allow_pickle=False) as arrays:
                return dict(arrays)
        except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error):
            return None

    def save(self, step: str, key: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Stores a result of arrays, replacing one of this key.

        Raises:
            MapBuildError: The disk is full, or the folder cannot be written to.
        """
        stream = io.BytesIO()
        np.savez(stream, allow_pickle=False, **arrays)
        stored = stream.getvalue()
        target = self._arrays(step, key)
        temporary = target.with_name(f'{target.name}{_PART}')
        with self._writes():
            target.parent.mkdir(exist_ok=True)
            temporary.write_bytes(hashlib.sha256(stored).digest() + stored)
            temporary.replace(target)

    def finished(self, step: str, key: str) -> Path | None:
        """The folder of a result of files; None when there is none, or a damaged one."""
        folder = self._path / step / key
        try:
            sums = json.loads((folder / _SUMS).read_text(encoding='utf-8'))
            whole = all(
                (folder / name).stat().st_size == size and sha256_of(folder / name) == sum_
                for name, (size, sum_) in sums.items()
            )
        except (OSError, ValueError, TypeError, AttributeError):
            return None
        return folder if whole else None

    @contextmanager
    def writing(self, step: str, key: str) -> Iterator[Path]:
        """An empty folder to write a result into; without an error it then is `finished`.

        Raises:
            MapBuildError: The disk is full, or the folder cannot be written to.
        """
        target = self._path / step / key
        temporary = target.with_name(f'{key}{_PART}')
        with self._writes():
            _remove(temporary)
            temporary.mkdir(parents=True)
            yield temporary
            sums = {
                file.relative_to(temporary).as_posix(): (file.stat().st_size, sha256_of(file))
                for file in sorted(temporary.rglob('*'))
                if file.is_file()
            }
            (temporary / _SUMS).write_text(json.dumps(sums), encoding='utf-8')
            _remove(target)
            temporary.rename(target)

    @contextmanager
    def scratch(self) -> Iterator[Path]:
        """An empty folder for the time of the block.

        Raises:
            MapBuildError: The disk is full, or the folder cannot be written to.
        """
        folder = self._path / f'scratch{_PART}'
        try:
            with self._writes():
                _remove(folder)
                folder.mkdir()
                yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def keep_only(self, step: str, keys: Collection[str]) -> None:
        """Removes the results of a step that nobody needs any more."""
        kept = {name for key in keys for name in (key, f'{key}.npz')}
        for result in (self._path / step).glob('*'):
            if result.name not in kept:
                _remove(result)

    def discard(self) -> None:
        """Removes the whole folder."""
        shutil.rmtree(self._path)

    def _arrays(self, step: str, key: str) -> Path:
        return self._path / step / f'{key}.npz'

    @contextmanager
    def _writes(self) -> Iterator[None]:
        try:
            yield
        except OSError as err:
            raise _not_writable(self._path, err) from err


def workspace_of(out: Path) -> Path:
    """Where the workspace of a map lies: beside the bundle `out`."""
    return _beside(out, 'work')


def report_of(out: Path) -> Path:
    """Where the report of a build lies: beside the bundle `out`."""
    return _beside(out, 'report')


def _beside(out: Path, ending: str) -> Path:
    # `.` and `..` have no name of their own
    return Path(f'{out.resolve()}.{ending}')


@contextmanager
def open_workspace(path: Path) -> Iterator[Workspace]:
    """Opens the workspace in a folder, or makes one; nobody else can use it meanwhile.

    The lock ends with the process, however that ends. A workspace in which nothing was stored is
    removed again.

    Raises:
        MapBuildError: Another build uses it, it is a folder of something else, or it cannot be
            written to.
    """
    marker = path / MARKER
    try:
        if path.exists() and not marker.is_file() and (not path.is_dir() or any(path.iterdir())):
            msg = (
                f'{path}: is to hold the finished steps of the build, but something else is there '
                f'(no {MARKER}); move it away'
            )
            raise MapBuildError(msg)
        path.mkdir(parents=True, exist_ok=True)
        stream = marker.open('a', encoding='utf-8')
    except OSError as err:
        raise _not_writable(path, err) from err
    with stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as err:
            msg = f'{path}: another build is using it; wait for its end, or choose another map name'
            raise MapBuildError(msg) from err
        except OSError as err:  # a file system without locks
            raise _not_writable(path, err) from err
        _prepare(path)
        try:
            yield Workspace(path)
        finally:
            if path.is_dir() and [entry.name for entry in path.iterdir()] == [MARKER]:
                shutil.rmtree(path)


@contextmanager
def temporary_workspace() -> Iterator[Workspace]:
    """A workspace for the time of the block."""
    with (
        tempfile.TemporaryDirectory(prefix='map_build_') as folder,
        open_workspace(Path(folder)) as workspace,
    ):
        yield workspace


def _prepare(path: Path) -> None:
    """Explains the folder, and removes what a killed build left half-written."""
    try:
        (path / MARKER).write_text(_EXPLANATION, encoding='utf-8')
        for left in (*path.glob(f'*{_PART}'), *path.glob(f'*/*{_PART}')):
            _remove(left)
    except OSError as err:
        raise _not_writable(path, err) from err


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _not_writable(path: Path, err: OSError) -> MapBuildError:
    return MapBuildError(
        f'{path}: the finished steps of the build cannot be kept there: {err.strerror or err}; '
        f'make room or give the map another place, and start again: what is finished stays'
    )
