# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`view`: a map, and a drive through it, as a recording."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

import numpy as np
import pytest
from synthetic_place import Place, save_place
from typer.testing import CliRunner

from gam_relocalizer.cli.main import app
from gam_relocalizer.errors import UsageError
from gam_relocalizer.scene_map import MapFrame, load_map

if TYPE_CHECKING:
    from pathlib import Path

    from click.testing import Result


def run(*arguments: str) -> Result:
    return CliRunner().invoke(app, arguments)


@pytest.fixture(scope='module')
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map."""
    path = tmp_path_factory.mktemp('maps') / 'place'
    return save_place(path, Place(num_points=500), MapFrame(metric=True)).path


def test_view_saves_a_recording_of_every_point(path: Path, tmp_path: Path) -> None:
    chunks = pytest.importorskip('rerun.chunk', reason='the extra `view` is not installed')

    done = run('view', str(path), '--save', str(tmp_path / 'map.rrd'))

    assert done.exit_code == 0
    (points,) = [
        chunk.to_record_batch().column('Points3D:positions').to_pylist()[0]
        for chunk in chunks.RrdReader(str(tmp_path / 'map.rrd')).stream()
        if chunk.entity_path == '/map/points'
    ]
    np.testing.assert_allclose(points, load_map(path).points, rtol=1e-5, atol=1e-6)
    assert [file.name for file in tmp_path.iterdir()] == ['map.rrd']


@pytest.mark.parametrize('name', ['pipe', 'folder', 'nosuch/map.rrd'])
def test_view_does_not_replace_what_is_no_file(path: Path, tmp_path: Path, name: str) -> None:
    pytest.importorskip('rerun', reason='the extra `view` is not installed')
    os.mkfifo(tmp_path / 'pipe')
    (tmp_path / 'folder').mkdir()

    done = run('view', str(path), '--save', str(tmp_path / name))

    assert isinstance(done.exception, UsageError)
    assert (tmp_path / 'pipe').is_fifo()
    assert sorted(file.name for file in tmp_path.iterdir()) == ['folder', 'pipe']


def test_view_without_the_viewer_tells_how_to_get_it(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, 'rerun', None)

    done = run('view', str(path), '--save', str(tmp_path / 'map.rrd'))

    assert isinstance(done.exception, UsageError)
    assert 'gam_relocalizer[view]' in str(done.exception)


def test_view_of_something_else_than_a_replay_is_a_usage_error(path: Path, tmp_path: Path) -> None:
    pytest.importorskip('rerun', reason='the extra `view` is not installed')

    done = run('view', str(path), '--replay', str(tmp_path), '--save', str(tmp_path / 'map.rrd'))

    assert isinstance(done.exception, UsageError)
