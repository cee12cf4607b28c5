# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
from corner_room import CAMERA, CornerRoom, looking_into_the_corner
from foreign_model import ForeignModel, write_foreign_model
from miniature_datasets import write_cambridge, write_euroc, write_seven_scenes
from typer.testing import CliRunner

from gam_relocalizer.cameras import format_camera
from gam_relocalizer.cli.map import app
from gam_relocalizer.errors import CameraError, DatasetError, MapError, ModelError, UsageError
from gam_relocalizer.geometry import pose_error
from gam_relocalizer.localization.localizer import Localizer, LocalizerOptions
from gam_relocalizer.scene_map import load_map

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from click.testing import Result
    from conftest import Room

RUNNER = CliRunner()
FEW = ('--max-keypoints', 400, '--extractor', 'sift')


def run_import(source: Path, out: Path, *arguments: object) -> Result:
    return RUNNER.invoke(app, ['import', str(source), '--out', str(out), *map(str, arguments)])


def imported(source: Path, out: Path, *arguments: object) -> Path:
    done = run_import(source, out, *arguments)
    assert done.exit_code == 0, done.exception
    return out


def refusal(source: Path, out: Path, *arguments: object) -> BaseException | None:
    """The error of an import; it has to leave no map behind, and no part of one."""
    done = run_import(source, out, *arguments)
    assert {one.name for one in out.parent.glob(f'*{out.name}*')} <= {f'{out.name}.work'}
    return done.exception


def assert_poses_kept(
    path: Path, poses: Mapping[str, pycolmap.Rigid3d], tolerance: float = 1e-6
) -> None:
    scene_map = load_map(path)
    assert set(scene_map.image_names) <= set(poses)
    for name, camera_from_map in zip(scene_map.image_names, scene_map.camera_from_map, strict=True):
        assert pose_error(camera_from_map, poses[name]).position < tolerance
    assert np.median(np.abs(scene_map.points).min(axis=1)) < 0.02  # on the walls of the room


@pytest.fixture(scope='module')
def foreign(room: Room, tmp_path_factory: pytest.TempPathFactory) -> ForeignModel:
    return write_foreign_model(tmp_path_factory.mktemp('x') / 'colmap', room.images, room.poses)


@pytest.fixture(scope='module')
def database_map(foreign: ForeignModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a model and its database."""
    out = tmp_path_factory.mktemp('maps') / 'map'
    return imported(foreign.sfm, out, '--database', foreign.database)


def test_a_dataset_becomes_a_map_in_its_own_frame(tmp_path: Path) -> None:
    poses = write_cambridge(tmp_path / 'set')

    path = imported(tmp_path / 'set', tmp_path / 'map', *FEW, '--spacing', 0, 0)

    assert load_map(path).num_images == len(poses) - 1  # the last one is to test with
    assert load_map(path).manifest.frame.metric
    assert_poses_kept(path, poses)


def test_a_dataset_is_thinned(tmp_path: Path) -> None:
    poses = write_euroc(tmp_path / 'set')

    path = imported(tmp_path / 'set', tmp_path / 'map', *FEW, '--spacing', 0.4, 90, '--no-metric')

    assert 3 <= load_map(path).num_images < len(poses)
    assert not load_map(path).manifest.frame.metric
    assert_poses_kept(path, poses)


def test_a_given_camera_replaces_that_of_a_dataset(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path / 'set')  # of images that are not of the nominal camera
    camera = format_camera(CAMERA)

    assert isinstance(refusal(tmp_path / 'set', tmp_path / 'map', *FEW), CameraError)
    path = imported(tmp_path / 'set', tmp_path / 'map', *FEW, '--camera', camera)

    assert load_map(path).manifest.build['report']['cameras'] == [camera]
    assert not load_map(path).manifest.build['options']['refine_camera']


def test_a_model_with_its_images_keeps_poses_and_cameras(
    room: Room, foreign: ForeignModel, tmp_path: Path
) -> None:
    model = pycolmap.Reconstruction(foreign.sfm)
    (tmp_path / 'model').mkdir()
    model.write_text(tmp_path / 'model')
    cameras = tmp_path / 'model' / 'cameras.txt'
    second = 'OPENCV 384 288 340 340 192 144 0 0 0 0'
    cameras.write_text(f'{cameras.read_text()}9 {second}\n')
    images = tmp_path / 'model' / 'images.txt'
    images.write_text(images.read_text().replace(' 1 view 03.png', ' 9 view 03.png'))

    path = imported(tmp_path / 'model', tmp_path / 'map', '--images', room.images, *FEW)

    assert load_map(path).num_images == len(room.poses)
    assert not load_map(path).manifest.frame.metric
    found = load_map(path).manifest.build['report']['cameras']
    assert set(found) == {format_camera(CAMERA), second}
    assert_poses_kept(path, room.poses)


def test_images_of_a_model_that_are_missing_are_named(
    room: Room, foreign: ForeignModel, tmp_path: Path
) -> None:
    shutil.copytree(room.images, tmp_path / 'images')
    (tmp_path / 'images' / 'view 03.png').unlink()

    done = run_import(
        foreign.sfm, tmp_path / 'map', '--images', tmp_path / 'images', '--metric', *FEW
    )

    assert done.exit_code == 0
    assert 'view 03.png' in done.stdout
    assert load_map(tmp_path / 'map').num_images == len(room.poses) - 1
    assert load_map(tmp_path / 'map').manifest.frame.metric


def test_a_model_and_its_database_are_a_map_without_images(
    foreign: ForeignModel, room: Room, database_map: Path
) -> None:
    scene_map = load_map(database_map)

    model = pycolmap.Reconstruction(foreign.sfm)
    assert scene_map.manifest.extractor.name == 'sift'
    assert not scene_map.manifest.frame.metric
    assert len(scene_map.points) == model.num_points3D()
    assert scene_map.manifest.counts['observations'] <= model.compute_num_observations()
    assert_poses_kept(database_map, room.poses)


def test_a_view_is_localized_in_an_imported_map(database_map: Path) -> None:
    localizer = Localizer.load(database_map, LocalizerOptions(max_keypoints=1000))
    truth = looking_into_the_corner(0.35)

    result = localizer.localize(CornerRoom().render(truth), CAMERA)

    assert result.accepted
    assert pose_error(result.estimate.camera_from_map, truth).position < 0.03


def test_an_output_of_hloc_is_the_same_map(
    foreign: ForeignModel, database_map: Path, tmp_path: Path
) -> None:
    features = ('--features', foreign.features, '--extractor', 'sift', '--metric')

    found = load_map(imported(foreign.sfm, tmp_path / 'map', *features))

    expected = load_map(database_map)
    rows = np.arange(len(expected.points))
    assert found.manifest.frame.metric
    assert found.manifest.extractor == expected.manifest.extractor
    assert found.image_names == expected.image_names
    assert np.allclose(found.points, expected.points)
    assert np.allclose(found.descriptors_of(rows), expected.descriptors_of(rows), atol=2e-3)


def test_an_import_takes_the_options_of_a_build_and_leaves_its_report(
    foreign: ForeignModel, room: Room, tmp_path: Path
) -> None:
    out, database = tmp_path / 'map', foreign.database
    imported(foreign.sfm, out, '--database', database, '--descriptor-bits', 8)
    assert load_map(out).manifest.descriptor_bits == 8
    assert (tmp_path / 'map.report' / 'report.json').is_file()

    imported(foreign.sfm, out, '--images', room.images, *FEW, '--discard-work')
    assert load_map(out).manifest.descriptor_bits == 16
    assert sorted(path.name for path in tmp_path.iterdir()) == ['map', 'map.report']


def test_the_same_import_gives_the_same_map_and_leaves_its_source_alone(
    foreign: ForeignModel, database_map: Path, tmp_path: Path
) -> None:
    source = foreign.database.parent
    before = {file: file.stat().st_mtime_ns for file in source.rglob('*')}

    again = load_map(imported(foreign.sfm, tmp_path / 'map', '--database', foreign.database))

    assert {file: file.stat().st_mtime_ns for file in source.rglob('*')} == before
    arrays = {name: entry for name, entry in again.manifest.files.items() if '.npy' in name}
    assert arrays
    assert arrays.items() <= load_map(database_map).manifest.files.items()


def test_a_model_alone_is_refused_with_what_it_needs(foreign: ForeignModel, tmp_path: Path) -> None:
    error = refusal(foreign.sfm, tmp_path / 'map')

    assert isinstance(error, UsageError)
    assert all(name in str(error) for name in ('--images', '--database', '--features'))


def test_features_of_another_extractor_are_refused(foreign: ForeignModel, tmp_path: Path) -> None:
    error = refusal(
        foreign.sfm,
        *(tmp_path / 'map', '--features', foreign.features, '--extractor', 'xfeat'),
    )

    assert isinstance(error, ModelError)
    assert '--images' in str(error)


def test_a_model_whose_points_nobody_sees_is_refused(foreign: ForeignModel, tmp_path: Path) -> None:
    model = pycolmap.Reconstruction(foreign.sfm)
    for point in list(model.point3D_ids()):
        model.delete_point3D(point)
    (tmp_path / 'model').mkdir()
    model.write_binary(tmp_path / 'model')

    error = refusal(tmp_path / 'model', tmp_path / 'map', '--database', foreign.database)

    assert isinstance(error, ModelError)


@pytest.mark.parametrize(
    'arguments',
    [
        ['--images', '.', '--database', 'x.db'],
        ['--images', '.', '--layout', 'tum'],
        ['--images', '.', '--camera', format_camera(CAMERA)],
        ['--features', 'x.h5'],
        ['--features', 'x.h5', '--extractor', 'magic'],
        ['--database', 'x.db', '--extractor', 'xfeat'],
        ['--database', 'x.db', '--refine-camera'],
        ['--database', 'x.db', '--discard-work'],
        ['--database', 'x.db', '--global', 'netvlad'],
    ],
)
def test_options_that_do_not_go_with_a_model_are_usage_errors(
    arguments: list[str], foreign: ForeignModel, tmp_path: Path
) -> None:
    for name in ('x.db', 'x.h5'):
        (tmp_path / name).touch()
    given = [str(tmp_path / one) if one.startswith('x.') else one for one in arguments]

    assert isinstance(refusal(foreign.sfm, tmp_path / 'map', *given), UsageError)


def test_options_of_models_do_not_go_with_datasets(room: Room, tmp_path: Path) -> None:
    error = refusal(room.images, tmp_path / 'map', '--database', 'x.db')

    assert isinstance(error, UsageError)


def test_sources_that_are_nothing_are_refused(
    foreign: ForeignModel, room: Room, tmp_path: Path
) -> None:
    (tmp_path / 'empty').mkdir()
    out = tmp_path / 'map'

    assert isinstance(refusal(tmp_path / 'nowhere', out), DatasetError)
    assert isinstance(refusal(room.images, out), DatasetError)
    assert isinstance(refusal(foreign.sfm, out, '--images', tmp_path / 'empty'), ModelError)
    assert isinstance(refusal(foreign.sfm, out, '--database', tmp_path / 'no.db'), ModelError)


def test_a_folder_that_is_no_map_is_not_replaced(foreign: ForeignModel, tmp_path: Path) -> None:
    (tmp_path / 'mine.txt').write_text('mine')

    done = run_import(foreign.sfm, tmp_path, '--database', foreign.database)

    assert isinstance(done.exception, MapError)
    assert (tmp_path / 'mine.txt').read_text() == 'mine'
