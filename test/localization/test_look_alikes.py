# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The same image elsewhere in the map: found where there is such a place, and nowhere else."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from synthetic_place import CAMERA, Place, features_of, query_pose, save_place, twin_of

from gam_relocalizer.geometry import pose_error
from gam_relocalizer.localization.look_alikes import look_alike_of, points_around
from gam_relocalizer.localization.pose import PoseOptions

if TYPE_CHECKING:
    from pathlib import Path

    from gam_relocalizer.localization.look_alikes import LookAlike
    from gam_relocalizer.scene_map import SceneMap

PLACE = Place()
OFFSET = np.array([0.0, 0.0, 100.0])


def look_alike(scene_map: SceneMap, view: int) -> LookAlike | None:
    """Of the true pose of a view in the first of the two places."""
    features = features_of(PLACE, query_pose(view), seed=view, clutter=0)
    return look_alike_of(
        query_pose(view),
        np.arange(len(features)),
        features,
        CAMERA,
        np.arange(len(scene_map.points)),
        scene_map,
        PoseOptions(),
    )


@pytest.mark.parametrize('view', range(3))
def test_a_twin_is_found_where_it_is(tmp_path: Path, view: int) -> None:
    twins, poses = twin_of(PLACE, OFFSET)
    found = look_alike(save_place(tmp_path / 'twins', twins, poses=poses), view)

    assert found is not None
    assert found.share > 0.9
    moved = found.camera_from_map.tgt_origin_in_src() - OFFSET
    assert np.linalg.norm(moved - query_pose(view).tgt_origin_in_src()) < 0.1
    assert pose_error(found.camera_from_map, query_pose(view)).rotation_deg < 1.0


@pytest.mark.parametrize('view', range(3))
def test_a_place_that_is_like_no_other_has_no_twin(tmp_path: Path, view: int) -> None:
    found = look_alike(save_place(tmp_path / 'place', PLACE), view)

    assert found is None or found.share < 0.1


def test_points_around_images_are_those_of_their_scenes(tmp_path: Path) -> None:
    scene_map = save_place(tmp_path / 'place', PLACE)

    alone = points_around([3], scene_map, 1)
    expanded = points_around([3, 4], scene_map, 5)

    np.testing.assert_array_equal(alone, np.unique(scene_map.points_seen_by(3)))
    assert np.isin(alone, expanded).all()
    assert len(alone) < len(expanded) < len(scene_map.points)
