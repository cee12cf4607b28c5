# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`map info` and `map check`."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pycolmap
import pytest
import yaml
from corner_room import CAMERA, write_room_images
from typer.testing import CliRunner

from gam_relocalizer.cameras import format_camera
from gam_relocalizer.cli.map import app
from gam_relocalizer.errors import UsageError
from gam_relocalizer.geometry import rigid3d_from
from gam_relocalizer.mapping.facts import plain, text_of
from gam_relocalizer.scene_map import (
    MANIFEST,
    MapFrame,
    load_content,
    load_map,
    read_manifest,
    save_frame,
    save_map,
)

if TYPE_CHECKING:
    from pathlib import Path

    from click.testing import Result

RUNNER = CliRunner()
WRONG_PLACE = 4


def run(*arguments: str) -> Result:
    return RUNNER.invoke(app, arguments)


@pytest.fixture(scope='module')
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('room') / 'images'
    write_room_images(folder, count=6)
    return folder


@pytest.fixture(scope='module')
def path(images: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of six images."""
    path = tmp_path_factory.mktemp('maps') / 'room.map'
    build = ['build', '--images', str(images), '--out', str(path), '--max-keypoints', '600']
    assert run(*build, '--camera', format_camera(CAMERA)).exit_code == 0
    return path


@pytest.fixture
def copy(path: Path, tmp_path: Path) -> Path:
    return shutil.copytree(path, tmp_path / 'copy.map')


def test_build_leaves_a_report_beside_the_map(path: Path) -> None:
    folder = path.with_name(f'{path.name}.report')

    assert json.loads((folder / 'report.json').read_text())['images_registered'] == 6
    assert sorted(file.name for file in folder.glob('*.png')) == [
        'covisibility.png',
        'side.png',
        'top.png',
    ]
    assert not any('.png' in name for name in read_manifest(path).files)


def info_of(path: Path) -> dict[str, Any]:
    return json.loads(run('info', str(path), '--json').stdout)


def test_info_has_the_bounds_of_the_map(path: Path) -> None:
    bounds = info_of(path)['bounds']

    positions = load_map(path).camera_positions
    np.testing.assert_allclose(bounds['cameras']['low'], positions.min(axis=0))
    np.testing.assert_allclose(bounds['cameras']['extent'], np.ptp(positions, axis=0))
    assert all(extent > 0 for extent in bounds['points']['extent'])


def test_info_has_the_bytes_for_each_point_by_file(path: Path) -> None:
    shown = info_of(path)

    points = shown['counts']['points']
    for name, size in shown['bytes_per_point'].items():
        assert size * points == pytest.approx((path / name).stat().st_size)


def test_info_shows_the_alignment(copy: Path) -> None:
    frame = MapFrame(2.5, metric=True, source='positions')
    save_frame(copy, frame, {'method': 'positions', 'residual_median': 0.034, 'worst': [1, 2]})

    done = run('info', str(copy))

    assert info_of(copy)['alignment']['residual_median'] == 0.034
    assert '0.034' in done.stdout
    assert '(metric)' in done.stdout


def test_info_shows_what_was_done_to_the_map(copy: Path) -> None:
    manifest = yaml.safe_load((copy / MANIFEST).read_text())
    manifest['build']['changes'] = [{'command': 'prune', 'images': 5}, 'something']
    (copy / MANIFEST).write_text(yaml.safe_dump(manifest))

    assert 'command prune, images 5' in run('info', str(copy)).stdout


def test_info_of_a_map_with_a_damaged_file_has_the_manifest_still(copy: Path) -> None:
    (copy / 'points.npy').write_bytes(b'')

    shown = info_of(copy)

    assert shown['map_id'] == read_manifest(copy).map_id
    assert shown['bounds'] == {}


STRANGE = {
    'numbers': 'build: {options: 3, report: [1, 2], changes: {a: b}}',
    'times': 'build: {options: {2026-01-01: 2026-01-02}, report: {cameras: no}}',
    'nothing': 'build: {options: null, report: {mean_reprojection_error: .nan, cameras: [1, {}]}}',
    'terminal': 'build: {options: {"\\e[31m": "\\e]0;title\\a\\n\\n"}}',
    'itself': 'build: {options: {a: &self [*self]}, changes: [*self, {b: *self}]}',
    'doubling': 'build: {options: {a: &a [x, x, x, x, x, x, x, x], b: &b [*a, *a, *a, *a, *a, *a], '
    'c: &c [*b, *b, *b, *b, *b, *b], d: &d [*c, *c, *c, *c, *c, *c], e: &e [*d, *d, *d, *d, *d], '
    'f: &f [*e, *e, *e, *e, *e], g: [*f, *f, *f, *f, *f]}}',
}


@pytest.mark.parametrize('name', STRANGE)
def test_info_is_not_led_astray_by_a_manifest(copy: Path, name: str) -> None:
    manifest = yaml.safe_load((copy / MANIFEST).read_text())
    del manifest['build']
    (copy / MANIFEST).write_text(f'{yaml.safe_dump(manifest)}{STRANGE[name]}\n')

    done = run('info', str(copy))

    assert done.exit_code == 0
    assert '\x1b' not in done.stdout
    assert len(done.stdout) < 20_000
    assert info_of(copy)['map_id'] in done.stdout


def test_plain_values_stay_as_they_are() -> None:
    value = {'a': [1, 2.5, None, True, 'text'], 'b': {'c': (1, 2)}}

    assert plain(value) == {'a': [1, 2.5, None, True, 'text'], 'b': {'c': [1, 2]}}
    assert text_of('a word') == 'a word'
    assert text_of(2.5) == '2.5'


def test_check_says_that_no_image_was_tried(path: Path) -> None:
    done = run('check', str(path))

    assert done.exit_code == 0
    assert '--images' in done.stdout


def test_check_as_json_is_the_whole_report(path: Path) -> None:
    report = json.loads(run('check', str(path), '--json').stdout)

    assert report['problems'] == []
    assert report['components'] == [6]
    assert report['coverage'] is None
    assert report['not_checked']


def test_check_finds_the_images_of_a_map(path: Path, images: Path, tmp_path: Path) -> None:
    out = tmp_path / 'out' / 'check'

    done = run('check', str(path), '--images', str(images), '--out', str(out))

    assert done.exit_code == 0
    report = json.loads((out / 'check.json').read_text())
    tried = report['coverage']['images']
    assert [one['name'] for one in tried] == list(load_map(path).image_names)
    assert report['coverage']['recall'] == 1.0
    assert report['not_checked'] == []
    assert (out / 'coverage.png').stat().st_size > 10_000


def test_check_exits_with_1_when_an_image_is_found_in_a_wrong_place(
    path: Path, images: Path, tmp_path: Path
) -> None:
    manifest, content = load_content(path)
    poses = list(content.camera_from_sfm)
    size = np.ptp(load_map(path).points, axis=0).max()
    poses[WRONG_PLACE] = rigid3d_from([1, 0, 0, 0], [size, 0, 0]) * poses[WRONG_PLACE]

    moved = replace(content, camera_from_sfm=tuple(poses))
    save_map(tmp_path / 'map', moved, manifest, pycolmap.Reconstruction(path / 'sfm'))

    done = run('check', str(tmp_path / 'map'), '--images', str(images), '--json', '--every', '4')

    assert done.exit_code == 1
    report = json.loads(done.stdout)
    assert [one['standing'] for one in report['coverage']['images']] == ['found', 'wrong']
    assert len(report['problems']) == 2  # the model has another pose, too


def test_check_of_a_damaged_map_does_not_try_images(copy: Path, images: Path) -> None:
    (copy / 'points.npy').write_bytes(b'')

    done = run('check', str(copy), '--images', str(images))

    assert done.exit_code == 1
    assert 'points.npy' in done.stdout


def test_check_with_images_elsewhere_is_a_usage_error(path: Path, tmp_path: Path) -> None:
    assert isinstance(
        run('check', str(path), '--images', str(tmp_path / 'nowhere')).exception, UsageError
    )


def test_check_with_a_file_in_place_of_a_folder_is_a_usage_error(
    path: Path, tmp_path: Path
) -> None:
    (tmp_path / 'out').touch()

    assert isinstance(run('check', str(path), '--out', str(tmp_path / 'out')).exception, UsageError)


@pytest.mark.parametrize('options', [['--every', '3'], ['--global-weights', 'weights.mat']])
def test_check_refuses_options_that_nothing_follows_from(path: Path, options: list[str]) -> None:
    assert isinstance(run('check', str(path), *options).exception, UsageError)


def test_check_refuses_a_folder_below_a_file(path: Path, tmp_path: Path) -> None:
    (tmp_path / 'file').touch()

    done = run('check', str(path), '--out', str(tmp_path / 'file' / 'deeper' / 'out'))

    assert isinstance(done.exception, UsageError)
