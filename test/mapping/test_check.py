# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import shutil
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from gam_relocalizer.geometry import rigid3d_from
from gam_relocalizer.mapping.check import check_map
from gam_relocalizer.scene_map import (
    ExtractorIdentity,
    Manifest,
    MapContent,
    MapFrame,
    load_map,
    save_map,
)

if TYPE_CHECKING:
    from pathlib import Path

    from conftest import BuiltMap

MANIFEST_TO_BE = Manifest(ExtractorIdentity('xfeat', 4, ''), 'vlad', MapFrame(metric=True), {})


def content_seeing(seen: list[range]) -> MapContent:
    """Images that see the given ranges of 200 points."""
    return MapContent(
        image_names=tuple(f'{index}.jpg' for index in range(len(seen))),
        camera_from_sfm=(rigid3d_from([1, 0, 0, 0], [0, 0, 0]),) * len(seen),
        points=np.zeros((200, 3)),
        descriptors=np.ones((200, 4)),
        observation_offsets=np.cumsum([0, *map(len, seen)], dtype=np.int64),
        observation_points=np.array([point for one in seen for point in one], dtype=np.int32),
        global_descriptors=np.ones((len(seen), 4), dtype=np.float32),
        codebook=np.ones((1, 4), dtype=np.float32),
    )


def test_a_good_map_is_sound(posed_map: BuiltMap) -> None:
    report = check_map(posed_map.path)

    assert report.problems == report.warnings == report.weak_bridges == ()
    assert report.components == (8,)
    assert report.counts == load_map(posed_map.path).manifest.counts


@pytest.mark.parametrize('name', ['points.npy', 'sfm/points3D.bin', 'manifest.yaml'])
def test_a_damaged_file_is_a_problem(posed_map: BuiltMap, tmp_path: Path, name: str) -> None:
    damaged = tmp_path / 'map'
    shutil.copytree(posed_map.path, damaged)
    (damaged / name).write_bytes((damaged / name).read_bytes()[:-7])

    (problem,) = check_map(damaged).problems

    assert name in problem


def test_a_missing_map_is_a_problem(tmp_path: Path) -> None:
    assert len(check_map(tmp_path / 'nowhere').problems) == 1


def test_a_strange_file_is_a_warning(posed_map: BuiltMap, tmp_path: Path) -> None:
    copy = tmp_path / 'map'
    shutil.copytree(posed_map.path, copy)
    (copy / 'notes.txt').touch()

    report = check_map(copy)

    assert report.problems == ()
    assert len(report.warnings) == 1
    assert 'notes.txt' in report.warnings[0]


def test_parts_that_share_nothing_are_a_problem(tmp_path: Path) -> None:
    seen = [range(100), range(60), range(100, 200)]
    save_map(tmp_path / 'map', content_seeing(seen), MANIFEST_TO_BE, None)

    report = check_map(tmp_path / 'map')

    assert report.components == (2, 1)
    assert len(report.problems) == 1


def test_parts_that_given_poses_hold_together_are_no_problem(tmp_path: Path) -> None:
    seen = [range(100), range(60), range(100, 200)]
    posed = replace(MANIFEST_TO_BE, build={'options': {'poses': 3}})
    save_map(tmp_path / 'map', content_seeing(seen), posed, None)

    report = check_map(tmp_path / 'map')

    assert report.components == (2, 1)
    assert report.problems == ()
    assert report.warnings


def test_a_weak_bridge_is_found(tmp_path: Path) -> None:
    seen = [range(100), range(95), range(90, 200), range(95, 200)]
    save_map(tmp_path / 'map', content_seeing(seen), MANIFEST_TO_BE, None)

    report = check_map(tmp_path / 'map')

    assert report.problems == ()
    (bridge,) = report.weak_bridges
    assert (bridge.first, bridge.second, bridge.shared_points) == ('0.jpg', '2.jpg', 10)


def test_counts_points_per_image(tmp_path: Path) -> None:
    seen = [range(100), range(60), range(200)]
    save_map(tmp_path / 'map', content_seeing(seen), MANIFEST_TO_BE, None)

    assert check_map(tmp_path / 'map').points_per_image == (60, 100, 200)


def test_an_unscaled_map_is_a_warning(tmp_path: Path) -> None:
    unscaled = replace(MANIFEST_TO_BE, frame=MapFrame())
    save_map(tmp_path / 'map', content_seeing([range(200)] * 2), unscaled, None)

    assert any('metric' in warning for warning in check_map(tmp_path / 'map').warnings)


def test_an_empty_map_is_a_problem(tmp_path: Path) -> None:
    empty = replace(content_seeing([]), observation_points=np.zeros(0, dtype=np.int32))
    save_map(tmp_path / 'map', empty, MANIFEST_TO_BE, None)

    assert len(check_map(tmp_path / 'map').problems) == 1
