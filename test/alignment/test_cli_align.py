# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from gam_relocalizer.cli.map import app
from gam_relocalizer.errors import UsageError
from gam_relocalizer.geometry import write_poses
from gam_relocalizer.scene_map import MANIFEST, read_manifest

if TYPE_CHECKING:
    from pathlib import Path

    from click.testing import Result
    from surveyed_room import SurveyedRoom

RUNNER = CliRunner()


def run(room: SurveyedRoom, *arguments: object) -> Result:
    return RUNNER.invoke(app, ['align', str(room.path), *map(str, arguments)])


def write_lines(path: Path, values: dict[str, np.ndarray]) -> Path:
    path.write_text(''.join(f'{name} {" ".join(map(str, one))}\n' for name, one in values.items()))
    return path


@pytest.fixture
def positions(room: SurveyedRoom, tmp_path: Path) -> Path:
    return write_lines(tmp_path / 'positions.txt', dict(room.positions))


def test_aligns_by_poses_and_says_what_was_written(room: SurveyedRoom, tmp_path: Path) -> None:
    write_poses(tmp_path / 'poses.txt', room.camera_from_world)

    done = run(room, '--poses', tmp_path / 'poses.txt')

    assert done.exit_code == 0
    assert room.errors()[0] < 1e-6
    assert '20 of 20' in done.stdout
    assert read_manifest(room.path).map_id in done.stdout


def test_json_is_the_report(room: SurveyedRoom, positions: Path) -> None:
    done = run(room, '--positions', positions, '--json')

    shown = json.loads(done.stdout)
    assert done.exit_code == 0
    assert shown['written']
    assert shown['frame']['scale'] == read_manifest(room.path).frame.scale
    assert len(shown['residuals']) == 20


def test_a_dry_run_leaves_the_map_alone(room: SurveyedRoom, positions: Path) -> None:
    before = (room.path / MANIFEST).read_bytes()

    done = run(room, '--positions', positions, '--level', '--dry-run')

    assert done.exit_code == 0
    assert (room.path / MANIFEST).read_bytes() == before


def test_aligns_by_gps_with_a_datum(room: SurveyedRoom, tmp_path: Path) -> None:
    # a hundred thousandth of a degree of latitude is 1.1 m
    fixes = {
        name: np.array([48.0 + one[1] * 9e-6, 11.0 + one[0] * 1.345e-5, 500.0 + one[2]])
        for name, one in room.positions.items()
    }
    file = write_lines(tmp_path / 'gps.txt', fixes)

    done = run(room, '--gps', file, '--datum', 48.0, 11.0, 500.0)

    assert done.exit_code == 0
    assert room.errors()[0] < 0.05


def test_aligns_to_an_occupancy_map_with_a_picture(room: SurveyedRoom, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / 'plan.pgm'), np.full((200, 200), 254, np.uint8))
    (tmp_path / 'map.yaml').write_text('image: plan.pgm\nresolution: 0.05\norigin: [-5, -5, 0]\n')
    picks = {name: np.array([5 + x, 5 - y]) / 0.05 for name, (x, y, _) in room.positions.items()}
    file = write_lines(tmp_path / 'picks.txt', picks)

    done = run(
        room,
        *('--occupancy', tmp_path / 'map.yaml', '--picks', file, '--level'),
        *('--picture', tmp_path / 'plan.png'),
    )

    assert done.exit_code == 0
    assert room.errors()[0] < 0.01
    assert (tmp_path / 'plan.png').is_file()


@pytest.mark.parametrize('name', ['pipe', 'folder', 'nosuch/plan.png'])
def test_a_picture_that_cannot_be_put_in_place_is_refused_before_the_work(
    room: SurveyedRoom, tmp_path: Path, name: str
) -> None:
    os.mkfifo(tmp_path / 'pipe')
    (tmp_path / 'folder').mkdir()
    cv2.imwrite(str(tmp_path / 'plan.png'), np.full((300, 400), 254, np.uint8))
    plan = tmp_path / 'plan.yaml'
    plan.write_text('image: plan.png\nresolution: 0.05\norigin: [-10, -7, 0]\n')
    pixels = {
        name: np.array([(x + 10) / 0.05, 300 - (y + 7) / 0.05])
        for name, (x, y, _) in room.positions.items()
    }
    picks = write_lines(tmp_path / 'picks.txt', pixels)
    before = (room.path / MANIFEST).read_bytes()

    done = run(
        *(room, '--occupancy', plan, '--picks', picks, '--level'),
        *('--picture', tmp_path / name),
    )

    assert isinstance(done.exception, UsageError)
    assert (room.path / MANIFEST).read_bytes() == before
    assert (tmp_path / 'pipe').is_fifo()
    assert sorted(one.name for one in tmp_path.iterdir() if one.name.startswith('.')) == []


def test_aligns_by_distances_and_levels(room: SurveyedRoom, tmp_path: Path) -> None:
    names, places = list(room.positions), list(room.positions.values())
    lines = [
        f'"{names[0]}" "{names[other]}" {np.linalg.norm(places[0] - places[other])}\n'
        for other in (5, 9, 12)
    ]
    (tmp_path / 'distances.txt').write_text(''.join(lines))

    done = run(room, '--distances', tmp_path / 'distances.txt', '--level')

    assert done.exit_code == 0
    frame = read_manifest(room.path).frame
    assert frame.scale == pytest.approx(room.world_from_sfm.scale, rel=1e-6)


@pytest.mark.parametrize(
    'arguments',
    [
        [],
        ['--poses', 'a.txt', '--positions', 'b.txt'],
        ['--poses', 'a.txt', '--level'],
        ['--distances', 'a.txt', '--markers', '0.2', '--dictionary', 'DICT_4X4_50'],
        ['--markers', '0.2'],
        ['--markers', '0.2', '--dictionary', 'DICT_4X4_50'],
        ['--marker-positions', 'a.txt', '--level'],
        ['--camera-height', '1.0'],
        ['--camera-height', '1.0', '--level', '--distances', 'a.txt'],
        ['--level', '--datum', '48', '11', '500'],
        ['--occupancy', 'map.yaml'],
        ['--picks', 'picks.txt', '--level'],
        ['--level', '--picture', 'a.png'],
        ['--level', '--camera-height', '-1'],
        ['--positions', 'nowhere.txt'],
        ['--gps', 'nowhere.txt', '--datum', '95', '11', '500'],
    ],
)
def test_options_that_make_no_sense_together_are_refused(
    room: SurveyedRoom, arguments: list[str]
) -> None:
    before = (room.path / MANIFEST).read_bytes()

    done = run(room, *arguments)

    assert isinstance(done.exception, UsageError)
    assert (room.path / MANIFEST).read_bytes() == before
