# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import hashlib
import shutil
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pycolmap
import pytest
import yaml
from scipy.spatial.transform import Rotation

from gam_relocalizer.errors import MapError
from gam_relocalizer.geometry import pose_error, rigid3d_from_rotation
from gam_relocalizer.scene_map import (
    MANIFEST,
    ExtractorIdentity,
    Manifest,
    MapContent,
    MapFrame,
    SceneMap,
    frame_from_sim3d,
    load_map,
    read_manifest,
    save_map,
)

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

DIMENSION = 4
ROTATION = Rotation.from_rotvec([0.3, -0.5, 1.1])
MAP_FROM_SFM = pycolmap.Sim3d(
    scale=2.5, rotation=pycolmap.Rotation3d(ROTATION.as_quat()), translation=[1.0, -2.0, 3.0]
)
MANIFEST_TO_BE = Manifest(
    extractor=ExtractorIdentity('xfeat', DIMENSION, 'a' * 64),
    retrieval='vlad',
    frame=frame_from_sim3d(MAP_FROM_SFM, metric=True, source='a test'),
    counts={},
    build={'options': {'mapper': 'incremental'}},
)


def random_content(seed: int = 0, images: int = 5, points: int = 40) -> MapContent:
    rng = np.random.default_rng(seed)
    descriptors = rng.normal(size=(points, DIMENSION))
    seen = [np.sort(rng.choice(points, 10, replace=False)) for _ in range(images)]
    return MapContent(
        image_names=tuple(f'folder/image {i}.jpg' for i in range(images)),
        camera_from_sfm=tuple(
            rigid3d_from_rotation(Rotation.random(rng=rng), rng.normal(size=3))
            for _ in range(images)
        ),
        points=rng.normal(size=(points, 3)),
        descriptors=descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True),
        observation_offsets=np.arange(images + 1, dtype=np.int64) * 10,
        observation_points=np.concatenate(seen).astype(np.int32),
        global_descriptors=rng.normal(size=(images, 6)).astype(np.float32),
        codebook=rng.normal(size=(3, DIMENSION)).astype(np.float32),
    )


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    path = tmp_path / 'map'
    save_map(path, random_content(), MANIFEST_TO_BE, None)
    return path


def edit_manifest(bundle: Path, edit: Callable[[dict[str, Any]], None]) -> None:
    data = yaml.safe_load((bundle / MANIFEST).read_text())
    edit(data)
    (bundle / MANIFEST).write_text(yaml.safe_dump(data))


def replace_array(bundle: Path, name: str, array: np.ndarray, *, pickled: bool = False) -> None:
    """Replaces a file and its sum, as someone would who means harm."""
    np.save(bundle / name, array, allow_pickle=pickled)
    data = (bundle / name).read_bytes()
    entry = {'size': len(data), 'sha256': hashlib.sha256(data).hexdigest()}
    edit_manifest(bundle, lambda manifest: manifest['files'].update({name: entry}))


def test_round_trip_in_the_map_frame(bundle: Path) -> None:
    content = random_content()

    loaded = load_map(bundle)

    assert loaded.image_names == content.image_names
    expected_points = 2.5 * ROTATION.apply(content.points) + [1.0, -2.0, 3.0]
    np.testing.assert_allclose(loaded.points, expected_points, atol=1e-9)
    np.testing.assert_allclose(loaded.descriptors, content.descriptors, atol=1e-3)
    np.testing.assert_array_equal(loaded.observation_points, content.observation_points)
    np.testing.assert_array_equal(loaded.observation_offsets, content.observation_offsets)
    np.testing.assert_array_equal(loaded.global_descriptors, content.global_descriptors)
    np.testing.assert_array_equal(loaded.codebook, content.codebook)
    assert loaded.manifest.frame.metric
    assert loaded.manifest.counts == {'images': 5, 'points': 40, 'observations': 50}


def test_poses_and_points_stay_consistent_under_the_similarity(bundle: Path) -> None:
    content = random_content()

    loaded = load_map(bundle)

    for camera_from_map, camera_from_sfm in zip(
        loaded.camera_from_map, content.camera_from_sfm, strict=True
    ):
        np.testing.assert_allclose(
            camera_from_map * loaded.points, 2.5 * (camera_from_sfm * content.points), atol=1e-6
        )


def test_identity_frame_keeps_the_poses(tmp_path: Path) -> None:
    content = random_content()
    save_map(tmp_path / 'map', content, replace(MANIFEST_TO_BE, frame=MapFrame()), None)

    loaded = load_map(tmp_path / 'map')

    for found, expected in zip(loaded.camera_from_map, content.camera_from_sfm, strict=True):
        assert pose_error(found, expected).position < 1e-9
    np.testing.assert_array_equal(loaded.points, content.points)


def test_points_seen_by_and_covisibility_agree(bundle: Path) -> None:
    loaded = load_map(bundle)

    for first in range(loaded.num_images):
        for second in range(loaded.num_images):
            shared = np.intersect1d(loaded.points_seen_by(first), loaded.points_seen_by(second))
            assert loaded.covisibility[first, second] == len(shared)


def test_observers_of_a_point_are_the_images_that_see_it(bundle: Path) -> None:
    loaded = load_map(bundle)

    assert loaded.observers.shape == (len(loaded.points), loaded.num_images)
    assert set(loaded.observers.data.tolist()) == {1}
    for image in range(loaded.num_images):
        seen = loaded.observers[:, [image]].nonzero()[0]
        np.testing.assert_array_equal(np.sort(seen), loaded.points_seen_by(image))


def test_camera_positions_are_where_the_poses_are(bundle: Path) -> None:
    loaded = load_map(bundle)

    assert loaded.camera_positions.shape == (loaded.num_images, 3)
    for position, camera_from_map in zip(
        loaded.camera_positions, loaded.camera_from_map, strict=True
    ):
        np.testing.assert_allclose(camera_from_map * position, np.zeros(3), atol=1e-9)
    empty = replace(loaded, image_names=(), camera_from_map=())
    assert empty.camera_positions.shape == (0, 3)


def test_same_content_same_id_and_other_content_another(tmp_path: Path) -> None:
    ids = [
        save_map(tmp_path / name, random_content(seed), MANIFEST_TO_BE, None).map_id
        for name, seed in (('a', 0), ('b', 0), ('c', 1))
    ]

    assert ids[0] == ids[1] != ids[2]


def test_replaces_an_older_map(bundle: Path) -> None:
    save_map(bundle, random_content(seed=1), MANIFEST_TO_BE, None)

    np.testing.assert_array_equal(load_map(bundle).codebook, random_content(seed=1).codebook)
    assert [folder.name for folder in bundle.parent.iterdir()] == ['map']


def test_never_replaces_what_is_not_a_map(tmp_path: Path) -> None:
    (tmp_path / 'photos').mkdir()
    (tmp_path / 'photos' / 'dear.jpg').write_bytes(b'x')

    with pytest.raises(MapError):
        save_map(tmp_path / 'photos', random_content(), MANIFEST_TO_BE, None)
    assert (tmp_path / 'photos' / 'dear.jpg').exists()


def test_a_failed_save_leaves_the_older_map_and_nothing_else(bundle: Path) -> None:
    unequal = replace(random_content(seed=1), image_names=('one',))

    with pytest.raises(ValueError, match='zip'):
        save_map(bundle, unequal, MANIFEST_TO_BE, None)
    assert load_map(bundle).num_images == 5
    assert [folder.name for folder in bundle.parent.iterdir()] == ['map']


def test_missing_bundle_is_a_map_error(tmp_path: Path) -> None:
    with pytest.raises(MapError, match=r'manifest\.yaml'):
        load_map(tmp_path / 'nowhere')


FILES = [
    'images.txt',
    'points.npy',
    'descriptors.npy',
    'observation_offsets.npy',
    'observation_points.npy',
    'global.npy',
    'codebook.npy',
]


@pytest.mark.parametrize('name', FILES)
def test_rejects_a_truncated_file(bundle: Path, name: str) -> None:
    (bundle / name).write_bytes((bundle / name).read_bytes()[:-1])

    with pytest.raises(MapError, match=name):
        load_map(bundle)


@pytest.mark.parametrize('name', FILES)
def test_rejects_a_changed_byte(bundle: Path, name: str) -> None:
    data = bytearray((bundle / name).read_bytes())
    data[-1] ^= 1
    (bundle / name).write_bytes(data)

    with pytest.raises(MapError, match=name):
        load_map(bundle)


@pytest.mark.parametrize('name', FILES)
def test_rejects_a_missing_file(bundle: Path, name: str) -> None:
    (bundle / name).unlink()

    with pytest.raises(MapError, match=name):
        load_map(bundle)


@pytest.mark.parametrize('name', FILES)
def test_rejects_a_file_that_the_manifest_does_not_list(bundle: Path, name: str) -> None:
    edit_manifest(bundle, lambda manifest: manifest['files'].pop(name))

    with pytest.raises(MapError, match=name):
        load_map(bundle)


@pytest.mark.parametrize('version', [0, 2, '1', None])
def test_rejects_another_version(bundle: Path, version: object) -> None:
    edit_manifest(bundle, lambda manifest: manifest.update(format_version=version))

    with pytest.raises(MapError, match='version'):
        load_map(bundle)


def test_rejects_another_extractor_dimension(bundle: Path) -> None:
    edit_manifest(bundle, lambda manifest: manifest['extractor'].update(dimension=8))

    with pytest.raises(MapError, match=r'descriptors\.npy'):
        load_map(bundle)


@pytest.mark.parametrize('name', ['../outside.npy', '/etc/passwd', 'sfm/../../outside.npy'])
def test_rejects_names_that_leave_the_bundle(bundle: Path, name: str) -> None:
    entry = {'size': 1, 'sha256': '0' * 64}
    edit_manifest(bundle, lambda manifest: manifest['files'].update({name: entry}))

    with pytest.raises(MapError, match='leave the bundle'):
        load_map(bundle)


@pytest.mark.parametrize(
    'edit',
    [
        lambda manifest: manifest.pop('frame'),
        lambda manifest: manifest.update(files=[]),
        lambda manifest: manifest['frame'].update(scale=0.0),
        lambda manifest: manifest['frame'].update(scale=float('nan')),
        lambda manifest: manifest['frame'].update(rotation_wxyz=[2.0, 0.0, 0.0, 0.0]),
        lambda manifest: manifest['frame'].update(translation=[0.0, 0.0]),
        lambda manifest: manifest['counts'].update(points=-1),
        lambda manifest: manifest['counts'].update(points=float('inf')),
        lambda manifest: manifest['extractor'].update(dimension='many'),
    ],
)
def test_rejects_a_malformed_manifest(bundle: Path, edit: Callable[[dict[str, Any]], None]) -> None:
    edit_manifest(bundle, edit)

    with pytest.raises(MapError, match=MANIFEST):
        load_map(bundle)


@pytest.mark.parametrize(
    'text', ['', '[', '!!python/object/apply:os.getcwd []', '\x00', 'format_version: 1']
)
def test_rejects_a_manifest_that_is_no_manifest(bundle: Path, text: str) -> None:
    (bundle / MANIFEST).write_text(text)

    with pytest.raises(MapError, match=MANIFEST):
        load_map(bundle)


@pytest.mark.parametrize('name', ['points.npy', 'global.npy', 'codebook.npy'])
@pytest.mark.parametrize('value', [np.nan, np.inf])
def test_rejects_numbers_that_are_not_finite(bundle: Path, name: str, value: float) -> None:
    array = np.load(bundle / name)
    array[1, 1] = value
    replace_array(bundle, name, array)

    with pytest.raises(MapError, match=name):
        load_map(bundle)


@pytest.mark.parametrize('index', [-1, 40])
def test_rejects_points_that_do_not_exist(bundle: Path, index: int) -> None:
    seen = np.load(bundle / 'observation_points.npy')
    seen[7] = index
    replace_array(bundle, 'observation_points.npy', seen)

    with pytest.raises(MapError, match=r'observation_points\.npy'):
        load_map(bundle)


@pytest.mark.parametrize('offsets', [[0, 20, 10, 30, 40, 50], [1, 10, 20, 30, 40, 50], [0] * 6])
def test_rejects_offsets_that_do_not_rise(bundle: Path, offsets: list[int]) -> None:
    replace_array(bundle, 'observation_offsets.npy', np.array(offsets, dtype=np.int64))

    with pytest.raises(MapError, match=r'observation_offsets\.npy'):
        load_map(bundle)


@pytest.mark.parametrize('name', ['points.npy', 'descriptors.npy', 'observation_points.npy'])
def test_rejects_arrays_of_another_type(bundle: Path, name: str) -> None:
    replace_array(bundle, name, np.load(bundle / name).astype(np.complex128))

    with pytest.raises(MapError, match=name):
        load_map(bundle)


def test_rejects_an_array_that_claims_more_than_the_file_holds(bundle: Path) -> None:
    data = (bundle / 'global.npy').read_bytes()
    huge = data.replace(b'(5, 6), }' + 11 * b' ', b'(5, 600000000000), }')
    assert len(huge) == len(data)
    (bundle / 'global.npy').write_bytes(huge)
    entry = {'size': len(huge), 'sha256': hashlib.sha256(huge).hexdigest()}
    edit_manifest(bundle, lambda manifest: manifest['files'].update({'global.npy': entry}))

    with pytest.raises(MapError, match=r'global\.npy'):
        load_map(bundle)


def test_never_unpickles(bundle: Path, tmp_path: Path) -> None:
    class Payload:
        def __reduce__(self) -> tuple[Callable[..., Any], tuple[str]]:
            return open, (str(tmp_path / 'executed'), 'w')

    payload = np.empty((40, 3), dtype=object)
    payload[:] = Payload()
    replace_array(bundle, 'points.npy', payload, pickled=True)

    with pytest.raises(MapError, match=r'points\.npy'):
        load_map(bundle)
    assert not (tmp_path / 'executed').exists()


def test_rejects_more_images_than_counted(bundle: Path) -> None:
    edit_manifest(bundle, lambda manifest: manifest['counts'].update(images=4))

    with pytest.raises(MapError):
        load_map(bundle)


def test_id_does_not_depend_on_where_the_map_lies(bundle: Path, tmp_path: Path) -> None:
    shutil.copytree(bundle, tmp_path / 'copy')

    assert read_manifest(tmp_path / 'copy').map_id == read_manifest(bundle).map_id


def test_descriptors_are_not_read_until_needed(bundle: Path) -> None:
    scene_map: SceneMap = load_map(bundle)

    assert isinstance(scene_map.descriptors, np.memmap)
