# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import re
from pathlib import Path

from gam_relocalizer.localization.result import Status
from gam_relocalizer.ros.conditions import Condition

PAGE = Path(__file__).parents[2] / 'docs' / 'troubleshooting.md'


def test_it_says_what_to_do_about_every_status_and_every_condition() -> None:
    words = set(re.findall(r'\w+', PAGE.read_text(encoding='utf-8')))
    named = [*Status.__members__, *Condition.__members__]
    assert [name for name in named if name not in words] == []


def test_what_it_names_in_capitals_exists() -> None:
    words = set(re.findall(r'`([A-Z]+(?:_[A-Z]+)+)`', PAGE.read_text(encoding='utf-8')))
    known = {*Status.__members__, *Condition.__members__, 'ROS_DOMAIN_ID', 'RMW_IMPLEMENTATION'}
    known |= {'ROS_AUTOMATIC_DISCOVERY_RANGE', 'OMP_NUM_THREADS'}
    assert words - known == set()
