# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import hashlib
import io
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from full_disk import files_no_larger_than
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of

from gam_relocalizer.errors import MapBuildError
from gam_relocalizer.mapping.workspace import (
    MARKER,
    key_of,
    open_workspace,
    report_of,
    workspace_of,
)

KEY = key_of(image='a')
ARRAYS = {'numbers': np.arange(1000.0), 'text': np.array('a name')}


@given(
    st.dictionaries(
        st.text('abc.', min_size=1, max_size=4),
        arrays_of.arrays(
            st.sampled_from([np.float32, np.uint32, np.int64]), arrays_of.array_shapes(min_side=0)
        ),
        max_size=4,
    )
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=30)
def test_arrays_come_back_as_they_were(tmp_path: Path, arrays: dict[str, np.ndarray]) -> None:
    with open_workspace(tmp_path / 'work') as workspace:
        workspace.save('step', KEY, arrays)
        loaded = workspace.load('step', KEY)

    assert loaded is not None
    assert loaded.keys() == arrays.keys()
    for name, array in arrays.items():
        assert loaded[name].dtype == array.dtype
        np.testing.assert_array_equal(loaded[name], array)


def test_results_outlive_the_build(tmp_path: Path) -> None:
    with open_workspace(tmp_path / 'work') as workspace:
        workspace.save('step', KEY, ARRAYS)
        with workspace.writing('other', KEY) as folder:
            (folder / 'file').write_text('contents')

    with open_workspace(tmp_path / 'work') as workspace:
        loaded, folder = workspace.load('step', KEY), workspace.finished('other', KEY)
        assert loaded is not None
        np.testing.assert_array_equal(loaded['numbers'], ARRAYS['numbers'])
        assert folder is not None
        assert (folder / 'file').read_text() == 'contents'


def test_what_was_never_stored_is_not_there(tmp_path: Path) -> None:
    with open_workspace(tmp_path / 'work') as workspace:
        assert workspace.load('step', KEY) is None
        assert workspace.finished('step', KEY) is None


@pytest.mark.parametrize('length', [0, 10, 32, 1000, -1])
def test_truncated_arrays_are_as_good_as_none(tmp_path: Path, length: int) -> None:
    with open_workspace(tmp_path / 'work') as workspace:
        workspace.save('step', KEY, ARRAYS)
        (file,) = (workspace.path / 'step').iterdir()
        file.write_bytes(file.read_bytes()[:length])

        assert workspace.load('step', KEY) is None


@given(st.floats(0, 1, exclude_max=True))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=30)
def test_arrays_with_a_changed_byte_are_as_good_as_none(tmp_path: Path, where: float) -> None:
    with open_workspace(tmp_path / 'work') as workspace:
        workspace.save('step', KEY, ARRAYS)
        (file,) = (workspace.path / 'step').iterdir()
        data = bytearray(file.read_bytes())
        data[int(where * len(data))] ^= 1
        file.write_bytes(data)

        assert workspace.load('step', KEY) is None


@pytest.mark.parametrize('damage', ['shorter', 'changed', 'missing', 'no sums', 'bad sums'])
def test_a_damaged_folder_is_as_good_as_none(tmp_path: Path, damage: str) -> None:
    with open_workspace(tmp_path / 'work') as workspace:
        with workspace.writing('step', KEY) as folder:
            (folder / 'sub').mkdir()
            (folder / 'sub' / 'file').write_bytes(b'contents')
        file, sums = (workspace.path / 'step' / KEY / name for name in ('sub/file', 'sums.json'))
        {
            'shorter': lambda: file.write_bytes(b'content'),
            'changed': lambda: file.write_bytes(b'Contents'),
            'missing': file.unlink,
            'no sums': sums.unlink,
            'bad sums': lambda: sums.write_text('[1]'),
        }[damage]()

        assert workspace.finished('step', KEY) is None


class _Harmful:
    def __reduce__(self) -> tuple[object, ...]:
        return exec, ('raise SystemExit',)


def test_nothing_is_ever_unpickled(tmp_path: Path) -> None:
    stream = io.BytesIO()
    np.savez(stream, harm=np.array([_Harmful()], dtype=object))
    stored = stream.getvalue()
    with open_workspace(tmp_path / 'work') as workspace:
        workspace.save('step', KEY, ARRAYS)
        (file,) = (workspace.path / 'step').iterdir()
        file.write_bytes(hashlib.sha256(stored).digest() + stored)

        assert workspace.load('step', KEY) is None


def write_half(file: Path) -> None:
    file.write_bytes(b'half')
    raise ZeroDivisionError


def test_a_block_that_fails_leaves_no_result(tmp_path: Path) -> None:
    with open_workspace(tmp_path / 'work') as workspace:
        with pytest.raises(ZeroDivisionError), workspace.writing('step', KEY) as folder:
            write_half(folder / 'file')

        assert workspace.finished('step', KEY) is None


def test_a_full_disk_is_named_and_leaves_no_result(tmp_path: Path) -> None:
    with open_workspace(tmp_path / 'work') as workspace:
        with files_no_larger_than(4096), pytest.raises(MapBuildError, match='work'):
            workspace.save('step', KEY, ARRAYS)
        with (
            files_no_larger_than(4096),
            pytest.raises(MapBuildError, match='work'),
            workspace.writing('step', KEY) as folder,
        ):
            (folder / 'file').write_bytes(b' ' * 5000)

        assert workspace.load('step', KEY) is None
        assert workspace.finished('step', KEY) is None


def test_what_a_killed_build_left_half_written_is_removed(tmp_path: Path) -> None:
    code = (
        'import os, signal, sys; from pathlib import Path\n'
        'from gam_relocalizer.mapping.workspace import open_workspace\n'
        'with open_workspace(Path(sys.argv[1])) as workspace, workspace.scratch() as scratch:\n'
        '    (scratch / "half").touch()\n'
        '    with workspace.writing("step", "key") as folder:\n'
        '        (folder / "half").touch()\n'
        '        os.kill(os.getpid(), signal.SIGKILL)\n'
    )
    subprocess.run([sys.executable, '-c', code, str(tmp_path / 'work')], check=False)
    assert len(list((tmp_path / 'work').rglob('half'))) == 2

    with open_workspace(tmp_path / 'work') as workspace:
        assert list(workspace.path.rglob('half')) == []


def test_a_second_build_is_refused_while_the_first_runs(tmp_path: Path) -> None:
    with (
        open_workspace(tmp_path / 'work'),
        pytest.raises(MapBuildError, match='another build'),
        open_workspace(tmp_path / 'work'),
    ):
        pass

    with open_workspace(tmp_path / 'work'):
        pass


@pytest.mark.parametrize('there', ['folder', 'file'])
def test_something_else_in_its_place_is_refused_and_kept(tmp_path: Path, there: str) -> None:
    path = tmp_path / 'work'
    kept = path / 'photo.jpg' if there == 'folder' else path
    kept.parent.mkdir(exist_ok=True)
    kept.write_bytes(b'precious')

    with pytest.raises(MapBuildError, match='something else'), open_workspace(path):
        pass
    assert kept.read_bytes() == b'precious'


def test_a_place_that_cannot_be_written_to_is_named(tmp_path: Path) -> None:
    (tmp_path / 'file').touch()

    with pytest.raises(MapBuildError, match='file'), open_workspace(tmp_path / 'file' / 'work'):
        pass


def test_an_empty_workspace_is_removed_and_another_kept(tmp_path: Path) -> None:
    with open_workspace(tmp_path / 'work'):
        pass
    assert not (tmp_path / 'work').exists()

    with open_workspace(tmp_path / 'work') as workspace:
        workspace.save('step', KEY, ARRAYS)
    assert (tmp_path / 'work' / MARKER).is_file()


def test_what_is_not_needed_any_more_is_removed(tmp_path: Path) -> None:
    other = key_of(image='b')
    with open_workspace(tmp_path / 'work') as workspace:
        for key in (KEY, other):
            workspace.save('step', key, ARRAYS)
            with workspace.writing('step', key) as folder:
                (folder / 'file').touch()
        workspace.keep_only('step', {other})

        assert workspace.load('step', KEY) is None
        assert workspace.finished('step', KEY) is None
        assert workspace.load('step', other) is not None
        assert workspace.finished('step', other) is not None


def test_keys_tell_inputs_apart() -> None:
    keys = {
        key_of(image='a', size=1),
        key_of(image='a', size='1'),
        key_of(image='a', size=None),
        key_of(image='a', size=[1]),
        key_of(image='a1', size=''),
    }
    assert len(keys) == 5
    assert key_of(image='a', size=1) == key_of(size=1, image='a')


def test_lies_beside_the_map(tmp_path: Path) -> None:
    assert workspace_of(tmp_path / 'office.map') == tmp_path / 'office.map.work'


@pytest.mark.parametrize('out', ['office.map', '.', '..', 'inner/..', '../place', 'link'])
def test_workspace_and_report_lie_beside_the_map_however_it_is_called(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, out: str
) -> None:
    place = tmp_path / 'outer' / 'place'
    (place / 'inner').mkdir(parents=True)
    (place / 'link').symlink_to(place / 'inner')
    monkeypatch.chdir(place)
    bundle = (place / out).resolve()

    assert workspace_of(Path(out)) == bundle.parent / f'{bundle.name}.work'
    assert report_of(Path(out)) == bundle.parent / f'{bundle.name}.report'
