# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace
from typing import TYPE_CHECKING

import h5py
import numpy as np
import pycolmap
import pytest
from foreign_model import ForeignModel, write_foreign_model
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from gam_relocalizer.errors import ModelError
from gam_relocalizer.features import create_extractor
from gam_relocalizer.images import read_image
from gam_relocalizer.mapping.colmap_model import read_colmap_model
from gam_relocalizer.mapping.foreign_features import DatabaseFeatures, HlocFeatures

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from conftest import Room

    from gam_relocalizer.features.local import LocalFeatures
    from gam_relocalizer.mapping.colmap_model import ModelImage


@pytest.fixture(scope='module')
def foreign(room: Room, tmp_path_factory: pytest.TempPathFactory) -> ForeignModel:
    return write_foreign_model(tmp_path_factory.mktemp('x') / 'colmap', room.images, room.poses)


@pytest.fixture(scope='module')
def image(foreign: ForeignModel) -> ModelImage:
    return read_colmap_model(foreign.sfm).images[0]


def likeness(found: LocalFeatures, ours: LocalFeatures) -> float:
    """Median cosine of the descriptors of keypoints at the same place."""
    near = cKDTree(ours.keypoints).query_ball_point(found.keypoints, 0.5)
    best = [
        (ours.descriptors[there] @ found.descriptors[index]).max()
        for index, there in enumerate(near)
        if there
    ]
    assert len(best) > 100
    return float(np.median(best))


def test_sift_of_colmap_is_like_ours(room: Room, foreign: ForeignModel, image: ModelImage) -> None:
    found = DatabaseFeatures(foreign.database).of(image, 128)
    ours = create_extractor('sift', 3000).extract(read_image(room.images / image.name))

    assert np.allclose(np.linalg.norm(found.descriptors, axis=1), 1.0, atol=1e-5)
    assert np.array_equal(found.keypoints, image.keypoints.astype(np.float32))
    assert likeness(found, ours) > 0.97


def test_sift_without_square_roots_is_brought_to_ours(
    room: Room, image: ModelImage, tmp_path: Path
) -> None:
    plain = write_foreign_model(tmp_path / 'l2', room.images, room.poses, pycolmap.Normalization.L2)
    its_image = read_colmap_model(plain.sfm).images[0]
    found = DatabaseFeatures(plain.database).of(its_image, 128)
    ours = create_extractor('sift', 3000).extract(read_image(room.images / image.name))

    assert np.allclose(np.linalg.norm(found.descriptors, axis=1), 1.0, atol=1e-5)
    assert likeness(found, ours) > 0.97


def test_features_of_hloc_are_those_of_the_database(
    foreign: ForeignModel, image: ModelImage
) -> None:
    of_hloc = HlocFeatures(foreign.features, 'sift').of(image, 128)
    of_database = DatabaseFeatures(foreign.database).of(image, 128)

    assert np.allclose(of_hloc.keypoints, of_database.keypoints, atol=1e-3)
    assert np.allclose(of_hloc.descriptors, of_database.descriptors, atol=1e-3)


def test_groups_are_nested_where_names_have_slashes(
    foreign: ForeignModel, image: ModelImage, tmp_path: Path
) -> None:
    with h5py.File(foreign.features) as source, h5py.File(tmp_path / 'f.h5', 'w') as target:
        source.copy(image.name, target.create_group('day/one'), name='a.png')

    found = HlocFeatures(tmp_path / 'f.h5', 'sift').of(replace(image, name='day/one/a.png'), 128)

    assert len(found) == len(image.keypoints)


def test_databases_of_before_colmap_4_have_no_type(
    foreign: ForeignModel, image: ModelImage, tmp_path: Path
) -> None:
    file = tmp_path / 'old #1?.db'
    with closing(sqlite3.connect(foreign.database)) as source, closing(sqlite3.connect(file)) as db:
        source.backup(db)
        db.execute('ALTER TABLE descriptors DROP COLUMN type')
        db.commit()

    assert len(DatabaseFeatures(file).of(image, 128)) == len(image.keypoints)


def test_the_database_is_only_read(foreign: ForeignModel, image: ModelImage) -> None:
    before = {file: file.stat().st_mtime_ns for file in foreign.database.parent.iterdir()}

    DatabaseFeatures(foreign.database).of(image, 128)

    assert {file: file.stat().st_mtime_ns for file in foreign.database.parent.iterdir()} == before


@pytest.mark.parametrize(
    'statement',
    [
        'DELETE FROM descriptors',
        'DROP TABLE descriptors',
        'UPDATE descriptors SET rows = rows + 1',
        'UPDATE descriptors SET cols = -128',
        'UPDATE descriptors SET type = 1',
        'UPDATE descriptors SET data = NULL',
        "UPDATE keypoints SET data = 'text'",
        "UPDATE keypoints SET rows = 'many'",
        'UPDATE keypoints SET rows = rows / 2, data = substr(data, 1, length(data) / 2)',
        'UPDATE keypoints SET data = zeroblob(length(data))',
    ],
)
def test_a_database_that_does_not_fit_is_an_error(
    statement: str, foreign: ForeignModel, image: ModelImage, tmp_path: Path
) -> None:
    shutil.copy(foreign.database, tmp_path / 'd.db')
    with closing(sqlite3.connect(tmp_path / 'd.db')) as database:
        database.execute(statement)
        database.commit()

    with pytest.raises(ModelError, match=r'd\.db'):
        DatabaseFeatures(tmp_path / 'd.db').of(image, 128)


@pytest.mark.parametrize('content', [b'', b'no database at all' * 99])
def test_files_of_another_kind_are_errors(
    content: bytes, image: ModelImage, tmp_path: Path
) -> None:
    (tmp_path / 'file').write_bytes(content)

    for features in (DatabaseFeatures(tmp_path / 'file'), HlocFeatures(tmp_path / 'file', 'sift')):
        with pytest.raises(ModelError, match='file'):
            features.of(image, 128)


def test_missing_files_are_errors(tmp_path: Path) -> None:
    with pytest.raises(ModelError):
        DatabaseFeatures(tmp_path / 'no.db')
    with pytest.raises(ModelError):
        HlocFeatures(tmp_path / 'no.h5', 'sift')


def _replaced(
    name: str, change: Callable[[np.ndarray], np.ndarray]
) -> Callable[[h5py.Group], None]:
    def damage(group: h5py.Group) -> None:
        values = group[name][()]
        del group[name]
        group[name] = change(values)

    return damage


def _external_link(group: h5py.Group) -> None:
    del group['descriptors']
    group['descriptors'] = h5py.ExternalLink('feats.h5', f'{group.name}/descriptors')


def _soft_link(group: h5py.Group) -> None:
    del group['descriptors']
    group['descriptors'] = h5py.SoftLink(f'{group.name}/keypoints')


def _external_storage(group: h5py.Group) -> None:
    shape = group['descriptors'].shape
    del group['descriptors']
    group.create_dataset(
        'descriptors', shape, 'f4', external=[('/etc/hostname', 0, h5py.h5f.UNLIMITED)]
    )


def _virtual(group: h5py.Group) -> None:
    shape = group['descriptors'].shape
    del group['descriptors']
    virtual = h5py.VirtualLayout(shape, 'f4')
    virtual[:] = h5py.VirtualSource('feats.h5', f'{group.name}/descriptors', shape)
    group.create_virtual_dataset('descriptors', virtual)


def _objects(group: h5py.Group) -> None:
    shape = group['descriptors'].shape
    del group['descriptors']
    group.create_dataset('descriptors', shape, h5py.string_dtype())


def _huge(group: h5py.Group) -> None:
    del group['descriptors']
    group.create_dataset('descriptors', (128, 2**40), 'f4', chunks=(128, 64), compression='gzip')


@pytest.mark.parametrize(
    'damage',
    [
        _replaced('keypoints', lambda values: values[:-1]),
        _replaced('keypoints', lambda values: values + 9.0),
        _replaced('descriptors', lambda values: values[:64]),
        _replaced('descriptors', lambda values: values.T),
        _replaced('descriptors', lambda values: values * np.nan),
        _external_link,
        _soft_link,
        _external_storage,
        _virtual,
        _objects,
        _huge,
    ],
)
def test_features_that_do_not_fit_are_errors(
    damage: Callable[[h5py.Group], None], foreign: ForeignModel, image: ModelImage, tmp_path: Path
) -> None:
    shutil.copy(foreign.features, tmp_path / 'f.h5')
    with h5py.File(tmp_path / 'f.h5', 'r+') as file:
        damage(file[image.name])

    with pytest.raises(ModelError, match=image.name):
        HlocFeatures(tmp_path / 'f.h5', 'sift').of(image, 128)


@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_damaged_bytes_give_finite_features_or_an_error(
    data: st.DataObject, foreign: ForeignModel, image: ModelImage, tmp_path: Path
) -> None:
    for file, of in (
        (foreign.features, lambda path: HlocFeatures(path, 'sift')),
        (foreign.database, DatabaseFeatures),
    ):
        content = bytearray(file.read_bytes())
        for _ in range(data.draw(st.integers(0, 3))):
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
        kept = data.draw(st.one_of(st.just(len(content)), st.integers(0, len(content) - 1)))
        (tmp_path / 'damaged').write_bytes(content[:kept])

        try:
            found = of(tmp_path / 'damaged').of(image, 128)
        except ModelError:
            continue
        assert np.isfinite(found.descriptors).all()
        assert len(found) == len(image.keypoints)
