# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from surveyed_room import save_room, straight_drive, walk

if TYPE_CHECKING:
    from surveyed_room import SurveyedRoom


# Every alignment starts from the SfM frame, so that tests may share a map and change it.
@pytest.fixture(scope='session')
def room(tmp_path_factory: pytest.TempPathFactory) -> SurveyedRoom:
    """A walk through a room, with the COLMAP model."""
    return save_room(tmp_path_factory.mktemp('room') / 'map', walk(), with_sfm=True)


@pytest.fixture(scope='session')
def corridor(tmp_path_factory: pytest.TempPathFactory) -> SurveyedRoom:
    """A straight drive, without the COLMAP model."""
    return save_room(tmp_path_factory.mktemp('corridor') / 'map', straight_drive())
