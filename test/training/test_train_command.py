# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
import typer
from typer.testing import CliRunner

from gam_relocalizer.cli.train import train
from gam_relocalizer.errors import TrainingError
from gam_relocalizer.training.loop import CHECKPOINT_NAME

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def app() -> typer.Typer:
    app = typer.Typer()
    app.command()(train)
    return app


def test_resume_without_a_run_is_an_error(app: typer.Typer, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ['--out', str(tmp_path), '--resume'])

    assert isinstance(result.exception, TrainingError)


def test_a_directory_with_a_run_is_not_overwritten(app: typer.Typer, tmp_path: Path) -> None:
    (tmp_path / CHECKPOINT_NAME).write_bytes(b'a run')

    result = CliRunner().invoke(app, ['--out', str(tmp_path), '--steps', '1'])

    assert isinstance(result.exception, TrainingError)
    assert (tmp_path / CHECKPOINT_NAME).read_bytes() == b'a run'


def test_out_is_required(app: typer.Typer) -> None:
    assert CliRunner().invoke(app, []).exit_code == 2
