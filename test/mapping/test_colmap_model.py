# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gam_relocalizer.cameras import CAMERA_MODELS, format_camera
from gam_relocalizer.errors import ModelError
from gam_relocalizer.mapping.colmap_model import NO_POINT, ColmapModel, read_colmap_model
from gam_relocalizer.mapping.sfm import quiet_colmap

if TYPE_CHECKING:
    from pathlib import Path

FORMATS = ('bin', 'txt')


@pytest.fixture(scope='module')
def truth() -> pycolmap.Reconstruction:
    """Two rigs of two cameras each."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 2, 2, 3
    options.num_points3D = 40
    with quiet_colmap():
        model = pycolmap.synthesize_dataset(options)
    model.update_point_3d_errors()
    return model


@pytest.fixture(scope='module')
def folders(
    truth: pycolmap.Reconstruction, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Path]:
    """The same model, binary and as text."""
    made = {name: tmp_path_factory.mktemp(name) for name in FORMATS}
    truth.write_binary(made['bin'])
    truth.write_text(made['txt'])
    return made


def copy_of(folder: Path, target: Path) -> Path:
    shutil.copytree(folder, target, dirs_exist_ok=True)
    return target


def read_or_refuse(folder: Path) -> ColmapModel | None:
    """None when it is refused with the error that is meant for it; others are raised."""
    try:
        return read_colmap_model(folder)
    except ModelError:
        return None


def assert_same(model: ColmapModel, truth: pycolmap.Reconstruction) -> None:
    ids = sorted(truth.point3D_ids())
    assert np.allclose(model.points, [truth.point3D(one).xyz for one in ids], rtol=0, atol=1e-9)
    assert model.mean_reprojection_error == pytest.approx(truth.compute_mean_reprojection_error())
    by_name = {image.name: image for image in truth.images.values()}
    assert [image.name for image in model.images] == sorted(by_name)
    for image in model.images:
        true = by_name[image.name]
        pose_off = image.camera_from_world.matrix() - true.cam_from_world().matrix()
        assert np.abs(pose_off).max() < 1e-9
        assert format_camera(model.cameras[image.camera_id]) == format_camera(true.camera)
        points = true.points2D
        assert np.allclose(image.keypoints, [one.xy for one in points], rtol=0, atol=1e-9)
        seen = [ids.index(p.point3D_id) if p.has_point3D() else NO_POINT for p in points]
        assert image.points.tolist() == seen


@pytest.mark.parametrize('kind', FORMATS)
def test_reads_a_model_of_rigs(
    kind: str, folders: dict[str, Path], truth: pycolmap.Reconstruction
) -> None:
    assert_same(read_colmap_model(folders[kind]), truth)


@pytest.mark.parametrize('kind', FORMATS)
def test_reads_a_model_of_before_rigs(
    kind: str, folders: dict[str, Path], truth: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    folder = copy_of(folders[kind], tmp_path)
    for name in ('rigs', 'frames'):
        (folder / f'{name}.{kind}').unlink()

    assert_same(read_colmap_model(folder), truth)


@pytest.mark.parametrize('kind', FORMATS)
@pytest.mark.parametrize('name', CAMERA_MODELS)
def test_every_camera_model_is_kept(name: str, kind: str, tmp_path: Path) -> None:
    camera = pycolmap.Camera.create_from_model_name(7, name, 300.0, 640, 480)
    params = np.array(camera.params)
    params[len(params) - 1] += 0.01
    camera.params = params
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    image = pycolmap.Image(name='a b.png', keypoints=np.zeros((0, 2)), camera_id=7, image_id=3)
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    model.write_text(tmp_path) if kind == 'txt' else model.write_binary(tmp_path)

    read = read_colmap_model(tmp_path)

    assert format_camera(read.cameras[7]) == format_camera(camera)
    assert [one.name for one in read.images] == ['a b.png']
    assert read.mean_reprojection_error is None


@pytest.mark.parametrize('name', ['cameras', 'images', 'points3D'])
@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_damaged_bytes_give_a_model_or_a_named_error(
    name: str, data: st.DataObject, folders: dict[str, Path], tmp_path: Path
) -> None:
    folder = copy_of(folders['bin'], tmp_path)
    file = folder / f'{name}.bin'
    content = bytearray(file.read_bytes())
    for _ in range(data.draw(st.integers(0, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    kept = data.draw(st.one_of(st.just(len(content)), st.integers(0, len(content) - 1)))
    file.write_bytes(content[:kept])

    model = read_or_refuse(folder)

    assert model is None or (kept == len(content) and np.isfinite(model.points).all())


@pytest.mark.parametrize('name', ['cameras', 'images', 'points3D'])
@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_damaged_text_gives_a_model_or_a_named_error(
    name: str, data: st.DataObject, folders: dict[str, Path], tmp_path: Path
) -> None:
    folder = copy_of(folders['txt'], tmp_path)
    file = folder / f'{name}.txt'
    content = file.read_text()
    at = data.draw(st.integers(0, len(content) - 1))
    with_junk = content[:at] + data.draw(st.text(max_size=3)) + content[at + 1 :]
    file.write_text(with_junk[: data.draw(st.integers(at, len(with_junk)))], errors='replace')

    model = read_or_refuse(folder)

    assert model is None or np.isfinite(model.points).all()


@pytest.mark.parametrize('name', ['cameras.bin', 'images.bin', 'points3D.bin'])
def test_a_missing_file_is_an_error(name: str, folders: dict[str, Path], tmp_path: Path) -> None:
    folder = copy_of(folders['bin'], tmp_path)
    (folder / name).unlink()

    with pytest.raises(ModelError):
        read_colmap_model(folder)


def test_the_folder_of_a_project_is_told_where_its_model_is(
    folders: dict[str, Path], tmp_path: Path
) -> None:
    copy_of(folders['bin'], tmp_path / 'sparse' / '0')

    with pytest.raises(ModelError, match='sparse/0'):
        read_colmap_model(tmp_path)


def test_an_empty_model_is_an_error(tmp_path: Path) -> None:
    pycolmap.Reconstruction().write_binary(tmp_path)

    with pytest.raises(ModelError, match='no images'):
        read_colmap_model(tmp_path)


@pytest.mark.parametrize(
    ('file', 'line', 'text'),
    [
        ('cameras.txt', 4, '1 SIMPLE_PINHOLE 640'),
        ('cameras.txt', 4, '1 EQUIRECTANGULAR 640 480'),
        ('cameras.txt', 4, '1 PINHOLE 640 480 nan 1 1 1'),
        ('images.txt', 5, '1 1 0 0 0 0 0 0 1'),
        ('images.txt', 5, '1 1 0 0 0 0 0 0 99 a.png'),
        ('images.txt', 5, '1 7 0 0 0 0 0 0 1 a.png'),
        ('images.txt', 5, '1 1 0 0 0 nan 0 0 1 a.png'),
        ('images.txt', 5, '1 1 0 0 0 0 0 0 1 ../a.png'),
        ('images.txt', 5, '1 1 0 0 0 0 0 0 1 /a.png'),
        ('images.txt', 6, '1 2'),
        ('points3D.txt', 4, '1 0 0 x 0 0 0 0'),
        ('points3D.txt', 4, '-1 0 0 0 0 0 0 0'),
    ],
)
def test_errors_in_text_name_file_and_line(
    file: str, line: int, text: str, folders: dict[str, Path], tmp_path: Path
) -> None:
    folder = copy_of(folders['txt'], tmp_path)
    lines = (folder / file).read_text().splitlines()
    lines[line - 1] = text
    (folder / file).write_text('\n'.join(lines))

    with pytest.raises(ModelError, match=f'{file}:{line}'):
        read_colmap_model(folder)


@pytest.mark.parametrize('text', ['5 5 123456', '5 5 -7', 'inf 5 -1'])
def test_keypoints_that_cannot_be_are_errors(
    text: str, folders: dict[str, Path], tmp_path: Path
) -> None:
    folder = copy_of(folders['txt'], tmp_path)
    lines = (folder / 'images.txt').read_text().splitlines()
    lines[5] = text
    (folder / 'images.txt').write_text('\n'.join(lines))

    with pytest.raises(ModelError, match=r'images\.txt:5'):
        read_colmap_model(folder)


def test_an_image_twice_is_an_error(folders: dict[str, Path], tmp_path: Path) -> None:
    folder = copy_of(folders['txt'], tmp_path)
    with (folder / 'images.txt').open('a') as stream:
        stream.write('\n'.join((folder / 'images.txt').read_text().splitlines()[4:6]) + '\n')

    with pytest.raises(ModelError, match='twice'):
        read_colmap_model(folder)
