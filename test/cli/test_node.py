# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
from typer.testing import CliRunner

from gam_relocalizer.cli.main import app
from gam_relocalizer.errors import UsageError


@pytest.mark.parametrize('arguments', [['map'], ['--mpa', 'maps/demo'], ['-p', 'period:=1.0']])
def test_arguments_that_are_not_for_ros_are_refused(arguments: list[str]) -> None:
    result = CliRunner().invoke(app, ['node', *arguments])
    assert isinstance(result.exception, UsageError)
    assert arguments[0] in str(result.exception)
