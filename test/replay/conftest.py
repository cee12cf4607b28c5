# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from recorded_drive import KnowingLocalizer, fill_drive, wall_map_at, write_bag
from rosbags.rosbag2 import StoragePlugin

if TYPE_CHECKING:
    from pathlib import Path

    from gam_relocalizer.scene_map import SceneMap


@pytest.fixture(scope='session')
def wall_map(tmp_path_factory: pytest.TempPathFactory) -> SceneMap:
    """The room that the drive goes through."""
    return wall_map_at(tmp_path_factory.mktemp('maps') / 'wall')


@pytest.fixture
def localizer(wall_map: SceneMap) -> KnowingLocalizer:
    """Knows where it is."""
    return KnowingLocalizer(wall_map.points)


@pytest.fixture(
    scope='session', params=[StoragePlugin.MCAP, StoragePlugin.SQLITE3], ids=['mcap', 'sqlite3']
)
def drive(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The drive as a bag, once in either storage."""
    return write_bag(tmp_path_factory.mktemp('bags') / 'drive', fill_drive, request.param)


@pytest.fixture(scope='session')
def mcap_drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The drive as an mcap bag."""
    return write_bag(tmp_path_factory.mktemp('bags') / 'drive', fill_drive)
