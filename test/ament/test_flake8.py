# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
# Named, for a workspace has its builds beside them.
FOLDERS = ('benchmarks', 'gam_relocalizer', 'launch', 'scripts', 'test')

main_with_errors = pytest.importorskip('ament_flake8.main').main_with_errors


def test_code_is_clean_for_ament_flake8(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(REPOSITORY)

    _, errors = main_with_errors(['--config', 'setup.cfg', 'setup.py', *FOLDERS])

    assert errors == []
