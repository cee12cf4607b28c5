# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from recorded_drive import wall_map_at

if TYPE_CHECKING:
    from gam_relocalizer.scene_map import SceneMap


@pytest.fixture(scope='session')
def wall_map(tmp_path_factory: pytest.TempPathFactory) -> SceneMap:
    """The room that the recorded drive goes through."""
    return wall_map_at(tmp_path_factory.mktemp('maps') / 'wall')
