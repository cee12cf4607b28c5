# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pycolmap
import pytest

from gam_relocalizer.demo.world import World, demo_world, tiny_world


@pytest.fixture(scope='session')
def tiny() -> World:
    return tiny_world()


@pytest.fixture(scope='session')
def rooms() -> World:
    return demo_world()


@pytest.fixture
def small_camera() -> pycolmap.Camera:
    return pycolmap.Camera(
        camera_id=1, model='PINHOLE', width=160, height=120, params=[110.0, 112.0, 79.0, 61.5]
    )
