# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]

main = pytest.importorskip('ament_pep257.main').main

# As ruff and flake8 have it (setup.cfg says why).
IGNORED = ('D105', 'D107', 'D403')


def test_docstrings_are_clean_for_ament_pep257(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(REPOSITORY)

    status = main(
        ['--convention', 'google', '--add-ignore', *IGNORED, '--', 'gam_relocalizer', 'scripts']
    )

    assert status == 0
