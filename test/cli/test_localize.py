# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`gam_relocalizer localize` on rendered images with known poses."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from gam_relocalizer.cameras import format_camera
from gam_relocalizer.cli.main import app
from gam_relocalizer.errors import (
    CameraError,
    MapError,
    PosesFileError,
    UsageError,
    WeightsError,
)
from gam_relocalizer.geometry import pose_error, read_poses, rigid3d_from, write_poses

if TYPE_CHECKING:
    from pathlib import Path

    from tiny_place import TinyPlace

GOOD = ('a.png', 'left/b.png')
BLACK, DAMAGED, SMALL = 'black.png', 'damaged.jpg', 'small.png'


@dataclass(frozen=True)
class Run:
    """What one call of the command left behind."""

    images: Path
    poses: Path
    rows: list[dict[str, Any]]
    output: str


def write_image(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image)


def command(world: TinyPlace, *arguments: Path | str) -> list[str]:
    camera = format_camera(world.camera)
    return ['localize', '--map', str(world.map_path), '--camera', camera, *map(str, arguments)]


@pytest.fixture(scope='module')
def run(tiny_place: TinyPlace, tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp('localize')
    images, results = folder / 'images', folder / 'results'
    truth = {}
    for name, (image, camera_from_map) in zip(GOOD, tiny_place.queries, strict=False):
        write_image(images / name, image)
        truth[name] = camera_from_map
    size = (tiny_place.camera.height, tiny_place.camera.width)
    write_image(images / BLACK, np.zeros(size, np.uint8))
    write_image(images / SMALL, np.zeros((20, 30), np.uint8))
    (images / DAMAGED).write_bytes(b'\xff\xd8\xff\xe0 no picture')
    write_poses(
        folder / 'truth.txt', truth | {'elsewhere.png': rigid3d_from([1, 0, 0, 0], [0] * 3)}
    )
    poses, jsonl = results / 'poses.txt', results / 'results.jsonl'
    arguments = [images, '--out', poses, '--jsonl', jsonl, '--truth', folder / 'truth.txt']
    called = CliRunner().invoke(app, command(tiny_place, *arguments))
    assert called.exit_code == 0
    rows = [json.loads(line) for line in jsonl.read_text().splitlines()]
    return Run(images, poses, rows, called.output)


def row_of(run: Run, name: str) -> dict[str, Any]:
    return next(row for row in run.rows if row['name'] == name)


def test_accepted_images_lie_near_the_truth(run: Run, tiny_place: TinyPlace) -> None:
    poses = read_poses(run.poses)
    assert set(poses) == set(GOOD)
    for name, (_, truth) in zip(GOOD, tiny_place.queries, strict=False):
        error = pose_error(poses[name], truth)
        assert error.position < 0.05
        assert error.rotation_deg < 1.0


def test_every_image_has_a_row_in_order(run: Run) -> None:
    assert [row['name'] for row in run.rows] == sorted([*GOOD, BLACK, DAMAGED, SMALL])
    statuses = {row['name']: row['status'] for row in run.rows}
    assert statuses == dict.fromkeys(GOOD, 'ACCEPTED') | {
        BLACK: 'TOO_FEW_FEATURES',
        DAMAGED: 'UNDECODABLE_IMAGE',
        SMALL: 'NO_CALIBRATION',
    }
    assert all(row['reason'] for row in run.rows)


def test_rows_of_accepted_images_hold_pose_and_covariance(run: Run) -> None:
    poses = read_poses(run.poses)
    for name in GOOD:
        row = row_of(run, name)
        covariance = np.reshape(row['covariance'], (6, 6))
        np.testing.assert_array_equal(covariance, covariance.T)
        np.linalg.cholesky(covariance)
        camera_from_map = rigid3d_from(row['camera_from_map'][:4], row['camera_from_map'][4:])
        np.testing.assert_allclose(camera_from_map.matrix(), poses[name].matrix(), atol=1e-9)
        assert row['keypoints'] >= row['matches'] >= row['inliers'] > 0
        timings = row['timings_ms']
        assert all(timings.values())
        total = timings.pop('total')
        assert total == pytest.approx(sum(timings.values()), abs=0.01)


def test_rows_of_refused_images_hold_no_pose(run: Run) -> None:
    for name in (BLACK, DAMAGED, SMALL):
        assert 'camera_from_map' not in row_of(run, name)


def test_single_files_are_named_by_their_file_name(
    run: Run, tiny_place: TinyPlace, tmp_path: Path
) -> None:
    out = tmp_path / 'poses.txt'
    files = [run.images / name for name in GOOD]
    called = CliRunner().invoke(app, command(tiny_place, *files, '--out', out))
    assert called.exit_code == 0
    again, before = read_poses(out), read_poses(run.poses)
    assert list(again) == ['a.png', 'b.png']
    assert again['b.png'].matrix().tobytes() == before['left/b.png'].matrix().tobytes()


def test_matcher_is_the_one_named(run: Run, tiny_place: TinyPlace, tmp_path: Path) -> None:
    out = tmp_path / 'poses.txt'
    image = run.images / GOOD[0]
    called = CliRunner().invoke(
        app, command(tiny_place, image, '--out', out, '--matcher', 'nn-cross')
    )
    assert called.exit_code == 0
    camera_from_map, (_, truth) = read_poses(out)[GOOD[0]], tiny_place.queries[0]
    assert pose_error(camera_from_map, truth).position < 0.05


@pytest.mark.parametrize('near', [('0', '0', '0'), ('-1e3', '-2.5', '1e3')])
def test_hint_right_or_wrong_takes_no_fix_away(
    run: Run, tiny_place: TinyPlace, tmp_path: Path, near: tuple[str, str, str]
) -> None:
    out, image = tmp_path / 'poses.txt', run.images / GOOD[0]
    called = CliRunner().invoke(
        app, command(tiny_place, image, '--out', out, '--near', *near, '--radius', '1.5')
    )
    assert called.exit_code == 0
    camera_from_map, (_, truth) = read_poses(out)[GOOD[0]], tiny_place.queries[0]
    assert pose_error(camera_from_map, truth).position < 0.05


@pytest.mark.parametrize(
    'hint',
    [
        ['--near', '1', '2', '3'],
        ['--radius', '2'],
        ['--near', '1', '2', '3', '--radius', '-2'],
        ['--near', '1', '2', '3', '--radius', 'nan'],
        ['--near', '1', 'nan', '3', '--radius', '2'],
    ],
)
def test_hint_that_says_no_place_is_an_error(
    run: Run, tiny_place: TinyPlace, tmp_path: Path, hint: list[str]
) -> None:
    called = CliRunner().invoke(
        app, command(tiny_place, run.images, '--out', tmp_path / 'poses.txt', *hint)
    )
    assert isinstance(called.exception, UsageError)
    assert not list(tmp_path.iterdir())


def test_nothing_accepted_leaves_an_empty_file_and_exit_code_zero(
    run: Run, tiny_place: TinyPlace, tmp_path: Path
) -> None:
    out = tmp_path / 'poses.txt'
    called = CliRunner().invoke(app, command(tiny_place, run.images / BLACK, '--out', out))
    assert called.exit_code == 0
    assert out.read_text() == ''


@pytest.mark.parametrize(
    ('replaced', 'error'),
    [
        ({'--map': 'nowhere'}, MapError),
        ({'--camera': 'PINHOLE 640 480'}, CameraError),
        ({'--truth': 'nowhere.txt'}, PosesFileError),
        ({'--out': '.'}, UsageError),
        ({'--matcher': 'best'}, UsageError),
        ({'--matcher': 'nn-cross', '--weights': 'tuned.npz'}, UsageError),
        ({'--weights': 'nowhere.npz'}, WeightsError),
        ({'--global-weights': 'netvlad.mat'}, UsageError),
    ],
)
def test_unusable_arguments_are_errors_and_write_nothing(
    run: Run,
    tiny_place: TinyPlace,
    tmp_path: Path,
    replaced: dict[str, str],
    error: type[Exception],
) -> None:
    options = {
        '--map': str(tiny_place.map_path),
        '--camera': format_camera(tiny_place.camera),
        '--out': str(tmp_path / 'poses.txt'),
    } | replaced
    words = [word for option in options.items() for word in option]
    called = CliRunner().invoke(app, ['localize', str(run.images), *words])
    assert isinstance(called.exception, error)
    assert not list(tmp_path.iterdir())


def test_folder_without_images_is_an_error(tiny_place: TinyPlace, tmp_path: Path) -> None:
    called = CliRunner().invoke(app, command(tiny_place, tmp_path, '--out', tmp_path / 'poses.txt'))
    assert isinstance(called.exception, UsageError)


def test_missing_image_is_an_error(tiny_place: TinyPlace, tmp_path: Path) -> None:
    missing = tmp_path / 'nowhere.jpg'
    called = CliRunner().invoke(app, command(tiny_place, missing, '--out', tmp_path / 'poses.txt'))
    assert isinstance(called.exception, UsageError)
    assert not list(tmp_path.iterdir())


def test_two_images_of_one_name_are_an_error(
    run: Run, tiny_place: TinyPlace, tmp_path: Path
) -> None:
    image = run.images / GOOD[0]
    called = CliRunner().invoke(
        app, command(tiny_place, image, image, '--out', tmp_path / 'poses.txt')
    )
    assert isinstance(called.exception, UsageError)
