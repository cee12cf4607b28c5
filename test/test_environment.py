# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What the package asks of libraries when it is imported, and leaves to who knows better."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

PROGRAM = 'import gam_relocalizer, os; print(os.environ["OPENBLAS_NUM_THREADS"])'


@pytest.mark.parametrize(('given', 'used'), [({}, '1'), ({'OPENBLAS_NUM_THREADS': '4'}, '4')])
def test_numpy_has_one_thread_unless_told_otherwise(given: dict[str, str], used: str) -> None:
    rest = {name: value for name, value in os.environ.items() if name != 'OPENBLAS_NUM_THREADS'}
    printed = subprocess.check_output([sys.executable, '-c', PROGRAM], env=rest | given, text=True)
    assert printed.strip() == used
