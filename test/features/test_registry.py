# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest

from gam_relocalizer.errors import UsageError
from gam_relocalizer.features import EXTRACTOR_NAMES, create_extractor


@pytest.mark.parametrize('name', EXTRACTOR_NAMES)
def test_creates_what_is_asked_for(name: str) -> None:
    assert create_extractor(name).identity.name == name


def test_unknown_name_is_refused_with_the_known_ones() -> None:
    with pytest.raises(UsageError, match='xfeat, sift'):
        create_extractor('surf')


def test_refuses_to_keep_no_keypoints() -> None:
    with pytest.raises(UsageError):
        create_extractor('sift', max_keypoints=0)
