# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import re

from gam_relocalizer.cli import options
from gam_relocalizer.matching.registry import DEFAULT_MATCHER, MATCHER_NAMES


def test_the_matchers_of_the_command_line_are_those_of_the_registry() -> None:
    assert options.DEFAULT_MATCHER == DEFAULT_MATCHER
    assert tuple(re.split(', | or ', options.MATCHERS)) == MATCHER_NAMES
