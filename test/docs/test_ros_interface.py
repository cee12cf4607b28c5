# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
SCRIPT = Path('scripts', 'generate_interface_docs.py')
PAGE, PARAMETERS = Path('docs', 'ros_interface.md'), Path('config', 'params.yaml')


def generate(repository: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, repository / SCRIPT, *arguments],
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """What the script reads and writes."""
    for path in (SCRIPT, PAGE, PARAMETERS):
        (tmp_path / path.parent).mkdir()
        shutil.copy(REPOSITORY / path, tmp_path / path)
    shutil.copytree(REPOSITORY / 'gam_relocalizer_msgs', tmp_path / 'gam_relocalizer_msgs')
    return tmp_path


def test_the_tables_and_the_file_of_parameters_are_those_of_the_code() -> None:
    check = generate(REPOSITORY, '--check')
    assert check.returncode == 0, check.stdout + check.stderr


def test_what_was_changed_by_hand_is_named_and_put_right(copied: Path) -> None:
    good = {path: (copied / path).read_text() for path in (PAGE, PARAMETERS)}
    (copied / PAGE).write_text(good[PAGE].replace('| `period` | double |', '| `pause` | double |'))
    (copied / PARAMETERS).write_text(good[PARAMETERS].replace('period: 2.0', 'period: 3.0'))
    check = generate(copied, '--check')
    assert check.returncode == 1
    assert str(PAGE) in check.stdout
    assert str(PARAMETERS) in check.stdout
    assert generate(copied).returncode == 0
    assert {path: (copied / path).read_text() for path in good} == good


def test_a_table_without_a_place_is_an_error(copied: Path) -> None:
    text = (copied / PAGE).read_text()
    (copied / PAGE).write_text(text.replace('begin generated: statuses', 'begin: statuses'))
    check = generate(copied)
    assert check.returncode == 1
    assert 'statuses' in check.stderr
