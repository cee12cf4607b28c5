# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from surveyed_room import looking, room_points, save_room, straight_drive, walk

from gam_relocalizer.alignment.align import align_map
from gam_relocalizer.alignment.constraints import Level
from gam_relocalizer.errors import AlignmentError
from gam_relocalizer.scene_map import load_map, read_manifest

if TYPE_CHECKING:
    from pathlib import Path

    import pycolmap
    from surveyed_room import SurveyedRoom


def tilt_deg(room: SurveyedRoom) -> float:
    """Angle between the z axis of the map and the true up direction."""
    frame = read_manifest(room.path).frame
    map_from_world = frame.map_from_sfm * room.world_from_sfm.inverse()
    up = Rotation.from_quat(np.asarray(map_from_world.rotation.quat)).apply([0.0, 0.0, 1.0])
    return float(np.degrees(np.arccos(np.clip(up[2], -1.0, 1.0))))


def test_levels_by_cameras_and_floor_and_keeps_the_scale(room: SurveyedRoom) -> None:
    before = read_manifest(room.path).frame

    report = align_map(room.path, Level())

    assert tilt_deg(room) < 0.1
    assert report.frame.scale == before.scale
    assert report.frame.metric == before.metric
    heights = load_map(room.path).camera_positions[:, 2] / report.frame.scale
    truth = np.array(list(room.positions.values()))[:, 2] / room.world_from_sfm.scale
    assert np.allclose(heights, truth, atol=0.002)


def test_the_first_camera_stands_above_the_origin_and_looks_along_x(room: SurveyedRoom) -> None:
    align_map(room.path, Level())

    first = load_map(room.path).camera_from_map[0]
    looks = first.rotation.matrix()[2]
    assert np.allclose(first.tgt_origin_in_src()[:2], 0.0, atol=1e-6)
    assert looks[0] > 0.9
    assert abs(looks[1]) < 1e-6


def test_cameras_that_all_look_ahead_are_levelled_by_the_floor(corridor: SurveyedRoom) -> None:
    align_map(corridor.path, Level())

    assert tilt_deg(corridor) < 0.1


def test_the_height_of_the_cameras_gives_the_scale(corridor: SurveyedRoom) -> None:
    report = align_map(corridor.path, Level(camera_height=0.8))

    assert report.frame.scale == pytest.approx(corridor.world_from_sfm.scale, rel=0.003)
    assert report.frame.metric


def test_the_floor_is_found_below_a_larger_table(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    table = rng.uniform([-4, -3, 0.75], [2, 3, 0.75], (2500, 3))
    room = save_room(tmp_path / 'map', walk(), np.concatenate([room_points(), table]))

    align_map(room.path, Level(camera_height=1.2))

    heights = load_map(room.path).camera_positions[:, 2]
    truth = np.array(list(room.positions.values()))[:, 2]
    assert np.allclose(heights, truth, atol=0.05)


def test_without_a_floor_the_cameras_alone_say_what_is_up(tmp_path: Path) -> None:
    points = room_points()
    room = save_room(tmp_path / 'map', walk(), points[points[:, 2] > 0.9])

    report = align_map(room.path, Level())

    assert tilt_deg(room) < 2.0
    assert any('floor' in warning for warning in report.findings.warnings)
    with pytest.raises(AlignmentError, match='floor'):
        align_map(room.path, Level(camera_height=1.2))


def tumbling(rng: np.random.Generator) -> dict[str, pycolmap.Rigid3d]:
    return {
        f'{index}.png': looking([0.1 * index, 0.0, 1.2], *rng.uniform(-3.0, 3.0, 3))
        for index in range(20)
    }


def portrait(rng: np.random.Generator) -> dict[str, pycolmap.Rigid3d]:
    return {
        f'{index}.png': looking([0.1 * index, 0.0, 1.2], rng.uniform(-3, 3), roll=np.pi / 2)
        for index in range(20)
    }


def looking_down(rng: np.random.Generator) -> dict[str, pycolmap.Rigid3d]:
    return {
        f'{index}.png': looking([0.1 * index, 0.0, 1.2], rng.uniform(-3, 3), pitch=np.pi / 2)
        for index in range(20)
    }


@pytest.mark.parametrize('views', [tumbling, portrait, looking_down])
def test_cameras_that_do_not_tell_what_is_up_are_refused(views: object, tmp_path: Path) -> None:
    assert callable(views)
    room = save_room(tmp_path / 'map', views(np.random.default_rng(1)))

    with pytest.raises(AlignmentError, match='upright'):
        align_map(room.path, Level())


def test_parallel_cameras_without_a_floor_are_refused(tmp_path: Path) -> None:
    points = room_points()
    room = save_room(tmp_path / 'map', straight_drive(), points[points[:, 2] > 0.9])

    with pytest.raises(AlignmentError, match='tilt'):
        align_map(room.path, Level())


def test_a_third_of_rolled_images_does_not_change_what_is_up(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    views = walk(30)
    for name in list(views)[::3]:
        position = views[name].tgt_origin_in_src()
        views[name] = looking(position, rng.uniform(-3, 3), 0.3, roll=rng.uniform(0.5, 1.5))
    room = save_room(tmp_path / 'map', views)

    align_map(room.path, Level())

    assert tilt_deg(room) < 0.2
