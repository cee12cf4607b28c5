# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import hashlib
import shutil
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
import pycolmap
import pytest
import yaml
from full_disk import files_no_larger_than
from hypothesis import given, settings
from hypothesis import strategies as st
from map_content import all_global_descriptors
from scipy.spatial.transform import Rotation

from gam_relocalizer.errors import MapError, UsageError
from gam_relocalizer.geometry import pose_error, rigid3d_from_rotation
from gam_relocalizer.scene_map import (
    IMAGES,
    MANIFEST,
    RUN_TIME_FILES,
    ExtractorIdentity,
    Manifest,
    MapContent,
    MapFrame,
    SceneMap,
    covisibility_of,
    frame_from_sim3d,
    load_content,
    load_map,
    map_in_memory,
    read_manifest,
    save_map,
)

if TYPE_CHECKING:
    from collections.abc import Callable

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


FILES = [name for name in RUN_TIME_FILES if name != IMAGES]


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
        global_descriptors=rng.normal(size=(images, 7)).astype(np.float32),
        codebook=rng.normal(size=(3, DIMENSION)).astype(np.float16).astype(np.float32),
    )


def all_descriptors(scene_map: SceneMap) -> np.ndarray:
    return scene_map.descriptors_of(np.arange(scene_map.num_points))


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    path = tmp_path / 'map'
    save_map(path, random_content(), MANIFEST_TO_BE, None)
    return path


def edit_manifest(bundle: Path, edit: Callable[[dict[str, Any]], None]) -> None:
    data = yaml.safe_load((bundle / MANIFEST).read_text())
    edit(data)
    (bundle / MANIFEST).write_text(yaml.safe_dump(data))


def replace_file(bundle: Path, name: str, data: bytes) -> None:
    """Replaces a file and its sum, as someone would who means harm."""
    (bundle / name).write_bytes(data)
    entry = {'size': len(data), 'sha256': hashlib.sha256(data).hexdigest()}
    edit_manifest(bundle, lambda manifest: manifest['files'].update({name: entry}))


def replace_array(bundle: Path, name: str, array: np.ndarray, *, pickled: bool = False) -> None:
    np.save(bundle / name, array, allow_pickle=pickled)
    replace_file(bundle, name, (bundle / name).read_bytes())


def test_round_trip_in_the_map_frame(bundle: Path) -> None:
    content = random_content()

    loaded = load_map(bundle)

    assert loaded.image_names == content.image_names
    expected_points = 2.5 * ROTATION.apply(content.points) + [1.0, -2.0, 3.0]
    np.testing.assert_allclose(loaded.points, expected_points, atol=1e-6)
    np.testing.assert_allclose(all_descriptors(loaded), content.descriptors, atol=1e-3)
    offsets, points = loaded.observations()
    np.testing.assert_array_equal(points, content.observation_points)
    np.testing.assert_array_equal(offsets, content.observation_offsets)
    np.testing.assert_array_equal(loaded.num_points_seen, np.diff(content.observation_offsets))
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
    np.testing.assert_allclose(loaded.points, content.points, atol=1e-6)


def test_points_seen_by_and_covisibility_agree(bundle: Path) -> None:
    loaded = load_map(bundle)

    for first in range(loaded.num_images):
        for second in range(loaded.num_images):
            shared = np.intersect1d(loaded.points_seen_by(first), loaded.points_seen_by(second))
            assert loaded.covisibility[first, second] == len(shared)


def test_covisibility_is_that_of_the_observations(bundle: Path) -> None:
    loaded = load_map(bundle)

    expected = covisibility_of(*loaded.observations(), loaded.num_points)
    np.testing.assert_array_equal(loaded.covisibility.indptr, expected.indptr)
    np.testing.assert_array_equal(loaded.covisibility.indices, expected.indices)
    np.testing.assert_array_equal(loaded.covisibility.data, expected.data)


def test_an_image_without_points_is_covisible_with_nothing(tmp_path: Path) -> None:
    content = random_content()
    blind = replace(
        content,
        observation_offsets=np.array([0, 10, 20, 20, 30, 40]),
        observation_points=content.observation_points[:40],
    )

    save_map(tmp_path / 'map', blind, MANIFEST_TO_BE, None)

    loaded = load_map(tmp_path / 'map')
    assert not len(loaded.points_seen_by(2))
    assert loaded.num_points_seen.tolist() == [10, 10, 0, 10, 10]
    assert not loaded.covisibility[[2]].nnz
    assert loaded.covisible_with(np.array([2])).tolist() == [2]


@pytest.mark.parametrize('points', [[7, 3, 3, 39], [], list(range(40))])
@pytest.mark.parametrize('images', [[4, 1], [], [0, 1, 2, 3, 4]])
def test_observers_of_a_point_are_the_images_that_see_it(
    bundle: Path, points: list[int], images: list[int]
) -> None:
    loaded = load_map(bundle)

    observers = loaded.observers_of(np.array(points, int), np.array(images, int))

    assert observers.shape == (len(points), len(images))
    for row, point in enumerate(points):
        for column, image in enumerate(images):
            assert observers[row, column] == (point in loaded.points_seen_by(image))


def test_all_who_see_a_point_of_an_image_are_covisible_with_it(bundle: Path) -> None:
    loaded = load_map(bundle)
    everyone = np.arange(loaded.num_images)

    for image in everyone:
        near = loaded.covisible_with(np.array([image]))
        seen = loaded.points_seen_by(image)
        assert image in near
        assert loaded.observers_of(seen, near).nnz == loaded.observers_of(seen, everyone).nnz


def test_points_are_the_same_asked_for_one_by_one(bundle: Path) -> None:
    loaded = load_map(bundle)

    for point in (0, 17, 39):
        np.testing.assert_allclose(
            loaded.positions_of(np.array([point]))[0], loaded.points[point], atol=1e-12
        )
    assert loaded.positions_of(np.empty(0, int)).shape == (0, 3)
    np.testing.assert_allclose(loaded.some_points(40), loaded.points, atol=1e-12)
    np.testing.assert_allclose(loaded.some_points(15), loaded.points[::3], atol=1e-12)


def test_likeness_is_the_cosine_with_the_global_descriptors(bundle: Path) -> None:
    content, loaded = random_content(), load_map(bundle)

    references = all_global_descriptors(loaded)
    cosines = np.einsum('ig,ig->i', references, content.global_descriptors)
    cosines /= np.linalg.norm(references, axis=1)
    cosines /= np.linalg.norm(content.global_descriptors, axis=1)
    assert cosines.min() > 0.99
    query = np.random.default_rng(5).normal(size=7).astype(np.float32)
    np.testing.assert_allclose(loaded.likeness(query), references @ query, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize('bits', [16, 8])
def test_descriptors_of_few_bits_keep_their_direction(tmp_path: Path, bits: int) -> None:
    content = random_content()

    save_map(tmp_path / 'map', content, replace(MANIFEST_TO_BE, descriptor_bits=bits), None)

    loaded = load_map(tmp_path / 'map')
    assert loaded.stored.descriptors.dtype.itemsize == bits // 8
    found = all_descriptors(loaded)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-6)
    # half a step for each of the numbers
    step = {16: 2**-11, 8: 1 / 254}[bits]
    assert np.abs(found - content.descriptors).max() < np.sqrt(DIMENSION) * step


def test_descriptors_of_other_bits_are_refused_before_anything_is_written(bundle: Path) -> None:
    with pytest.raises(UsageError):
        save_map(bundle, random_content(1), replace(MANIFEST_TO_BE, descriptor_bits=4), None)
    assert load_map(bundle).manifest.descriptor_bits == 16


@pytest.mark.parametrize('middle', [[0.0, 0.0, 0.0], [500_000.0, 5_400_000.0, 120.0]])
def test_coordinates_that_count_from_far_away_stay_exact(
    tmp_path: Path, middle: list[float]
) -> None:
    content = random_content()
    far = replace(content, points=content.points + middle)

    saved = save_map(tmp_path / 'map', far, replace(MANIFEST_TO_BE, frame=MapFrame()), None)

    np.testing.assert_allclose(load_map(tmp_path / 'map').points, far.points, rtol=0, atol=1e-6)
    np.testing.assert_allclose(saved.points_origin, middle, atol=1.0)
    # the same numbers in the files, at another place
    here = save_map(tmp_path / 'b', content, replace(MANIFEST_TO_BE, frame=MapFrame()), None)
    assert (saved.map_id == here.map_id) == (not any(middle))


def test_what_is_loaded_and_saved_again_is_the_same_map(tmp_path: Path) -> None:
    small = replace(MANIFEST_TO_BE, descriptor_bits=8)
    saved = save_map(tmp_path / 'map', random_content(), small, None)

    manifest, content = load_content(tmp_path / 'map')
    again = save_map(tmp_path / 'again', content, manifest, None)

    assert again.map_id == saved.map_id


def test_a_map_in_memory_is_the_one_that_is_saved(bundle: Path) -> None:
    content, loaded = random_content(), load_map(bundle)

    in_memory = map_in_memory(bundle, content, MANIFEST_TO_BE)

    assert replace(in_memory.manifest, files=loaded.manifest.files) == loaded.manifest
    np.testing.assert_array_equal(in_memory.points, loaded.points)
    np.testing.assert_array_equal(all_descriptors(in_memory), all_descriptors(loaded))
    for image in range(5):
        np.testing.assert_array_equal(in_memory.points_seen_by(image), loaded.points_seen_by(image))
    assert (in_memory.covisibility != loaded.covisibility).nnz == 0


def test_points_that_an_image_sees_may_come_in_any_order(tmp_path: Path) -> None:
    content = random_content()
    backwards = replace(content, observation_points=content.observation_points[::-1].copy())

    saved = save_map(tmp_path / 'map', backwards, MANIFEST_TO_BE, None)

    assert saved.counts['observations'] == 50
    seen = load_map(tmp_path / 'map').points_seen_by(0)
    np.testing.assert_array_equal(seen, np.sort(content.observation_points[-10:]))


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


def test_a_disk_that_is_full_before_the_model_is_written_leaves_the_older_map(bundle: Path) -> None:
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 5
    options.num_points3D = 3000
    model = pycolmap.synthesize_dataset(options)

    # the arrays have room, and the model has not
    with files_no_larger_than(100_000), pytest.raises(OSError, match='No space left'):
        save_map(bundle, random_content(seed=1), MANIFEST_TO_BE, model)
    assert not (bundle / 'sfm').exists()
    assert load_map(bundle).num_images == 5
    assert [folder.name for folder in bundle.parent.iterdir()] == ['map']


def test_missing_bundle_is_a_map_error(tmp_path: Path) -> None:
    with pytest.raises(MapError, match=r'manifest\.yaml'):
        load_map(tmp_path / 'nowhere')


@pytest.mark.parametrize('name', RUN_TIME_FILES)
def test_rejects_a_truncated_file(bundle: Path, name: str) -> None:
    (bundle / name).write_bytes((bundle / name).read_bytes()[:-1])

    with pytest.raises(MapError, match=name):
        load_map(bundle)


@pytest.mark.parametrize('name', RUN_TIME_FILES)
def test_rejects_a_changed_byte(bundle: Path, name: str) -> None:
    data = bytearray((bundle / name).read_bytes())
    data[-1] ^= 1
    (bundle / name).write_bytes(data)

    with pytest.raises(MapError, match=name):
        load_map(bundle)


@pytest.mark.parametrize('name', RUN_TIME_FILES)
def test_rejects_a_missing_file(bundle: Path, name: str) -> None:
    (bundle / name).unlink()

    with pytest.raises(MapError, match=name):
        load_map(bundle)


@pytest.mark.parametrize('name', RUN_TIME_FILES)
def test_rejects_a_file_that_the_manifest_does_not_list(bundle: Path, name: str) -> None:
    edit_manifest(bundle, lambda manifest: manifest['files'].pop(name))

    with pytest.raises(MapError, match=name):
        load_map(bundle)


@pytest.mark.parametrize('version', [0, 1, '2', 3, None])
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
        lambda manifest: manifest.update(descriptor_bits=4),
        lambda manifest: manifest.pop('descriptor_bits'),
        lambda manifest: manifest.update(points_origin=[0.0, float('nan'), 0.0]),
        lambda manifest: manifest.update(points_origin=[0.0, 0.0]),
        lambda manifest: manifest.update(global_dimension=-1),
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


@pytest.mark.parametrize(
    'name', ['points.npy', 'descriptors.npy', 'codebook.npy', 'global_scales.npy']
)
@pytest.mark.parametrize('value', [np.nan, np.inf])
def test_rejects_numbers_that_are_not_finite(bundle: Path, name: str, value: float) -> None:
    array = np.load(bundle / name)
    array.flat[4] = value
    replace_array(bundle, name, array)

    with pytest.raises(MapError, match=name):
        load_map(bundle)


@pytest.mark.parametrize('first', [-2, -1, 31, 2**31 - 1])
def test_rejects_points_that_do_not_exist(bundle: Path, first: int) -> None:
    """Ten points are seen, so that the lowest is below 31."""
    lowest = np.load(bundle / 'observation_first.npy')
    lowest[3] = first
    replace_array(bundle, 'observation_first.npy', lowest)

    with pytest.raises(MapError, match=r'observation_gaps\.npy'):
        load_map(bundle)


@pytest.mark.parametrize('where', [3, 8, -1])
@pytest.mark.parametrize('gap', [40, 127, 128, 255])
def test_rejects_gaps_that_lead_out_of_the_map(bundle: Path, where: int, gap: int) -> None:
    gaps = np.load(bundle / 'observation_gaps.npy')
    gaps[where] = gap
    replace_array(bundle, 'observation_gaps.npy', gaps)

    with pytest.raises(MapError, match=r'observation_gaps\.npy'):
        load_map(bundle)


def test_rejects_another_number_of_observations(bundle: Path) -> None:
    edit_manifest(bundle, lambda manifest: manifest['counts'].update(observations=49))

    with pytest.raises(MapError, match=r'observation_gaps\.npy'):
        load_map(bundle)


@pytest.mark.parametrize('offsets', [[0, 18, 9, 27, 36, 45], [1, 9, 18, 27, 36, 45], [0] * 6])
def test_rejects_offsets_that_do_not_rise(bundle: Path, offsets: list[int]) -> None:
    assert np.load(bundle / 'observation_offsets.npy').tolist() == [0, 9, 18, 27, 36, 45]
    replace_array(bundle, 'observation_offsets.npy', np.array(offsets, np.int64))

    with pytest.raises(MapError, match='observation'):
        load_map(bundle)


@pytest.mark.parametrize('offsets', [[0, 4, 3, 9, 10, 10], [1, 4, 7, 9, 10, 10], [0] * 6])
def test_rejects_offsets_of_covisible_images_that_do_not_rise(
    bundle: Path, offsets: list[int]
) -> None:
    assert np.load(bundle / 'covisibility_offsets.npy').tolist() == [0, 4, 7, 9, 10, 10]
    replace_array(bundle, 'covisibility_offsets.npy', np.array(offsets, np.int32))

    with pytest.raises(MapError, match='covisibility'):
        load_map(bundle)


@pytest.mark.parametrize(
    ('where', 'image'),
    [(0, 0), (1, 1), (1, 5), (1, -1), (9, 3), (9, 2**31 - 1)],
)
def test_rejects_covisible_images_that_do_not_exist_or_rise(
    bundle: Path, where: int, image: int
) -> None:
    images = np.load(bundle / 'covisibility_images.npy')
    images[where] = image
    replace_array(bundle, 'covisibility_images.npy', images)

    with pytest.raises(MapError, match='covisibility'):
        load_map(bundle)


@pytest.mark.parametrize('count', [0, 11, 65535])
def test_rejects_more_shared_points_than_an_image_sees(bundle: Path, count: int) -> None:
    counts = np.load(bundle / 'covisibility_counts.npy')
    counts[2] = count
    replace_array(bundle, 'covisibility_counts.npy', counts)

    with pytest.raises(MapError, match='covisibility'):
        load_map(bundle)


@pytest.mark.parametrize('name', FILES)
def test_rejects_arrays_of_another_type(bundle: Path, name: str) -> None:
    replace_array(bundle, name, np.load(bundle / name).astype(np.complex128))

    with pytest.raises(MapError, match=name):
        load_map(bundle)


def test_rejects_an_array_that_claims_more_than_the_file_holds(bundle: Path) -> None:
    data = (bundle / 'observation_gaps.npy').read_bytes()
    length = len(np.load(bundle / 'observation_gaps.npy'))
    claim = f'({length},), }}'.encode()
    huge = data.replace(claim + 11 * b' ', b'(600000000000,), }'.ljust(len(claim) + 11))
    assert len(huge) == len(data)
    assert huge != data
    replace_file(bundle, 'observation_gaps.npy', huge)

    with pytest.raises(MapError, match=r'observation_gaps\.npy'):
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


def test_what_is_large_is_not_read_until_needed(bundle: Path) -> None:
    stored = load_map(bundle).stored

    for array in (stored.points, stored.descriptors, stored.observation_gaps, stored.global_):
        assert isinstance(array, np.memmap)


def test_nothing_stays_in_memory_of_what_a_query_looked_at(tmp_path: Path) -> None:
    content = random_content(points=20_000)
    save_map(tmp_path / 'map', content, MANIFEST_TO_BE, None)
    loaded = load_map(tmp_path / 'map')
    everything = np.arange(loaded.num_points)

    loaded.descriptors_of(everything)
    loaded.positions_of(everything)
    loaded.likeness(np.ones(7, np.float32))

    for name in ('points.npy', 'descriptors.npy', 'global.npy'):
        assert resident_bytes_of(tmp_path / 'map' / name) == 0


def resident_bytes_of(file: Path) -> int:
    """Of what this process has mapped of a file."""
    _, found, mapped = Path('/proc/self/smaps').read_text().partition(f'{file}\n')
    assert found
    (resident,) = [line for line in mapped.splitlines() if line.startswith('Rss:')][:1]
    return 1024 * int(resident.split()[1])


@pytest.fixture(scope='module', params=[16, 8])
def sound_bundle(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp('fuzz') / f'of {request.param} bits'
    manifest = replace(MANIFEST_TO_BE, descriptor_bits=request.param)
    save_map(path, random_content(), manifest, None)
    return path


@pytest.mark.parametrize('name', FILES)
@settings(max_examples=15, deadline=None)
@given(data=st.data())
def test_a_file_of_any_bytes_is_refused_or_harmless(
    sound_bundle: Path, name: str, data: st.DataObject
) -> None:
    """What is loaded answers, and never leads out of the map."""
    contents = bytearray((sound_bundle / name).read_bytes())
    # the numbers begin at 128; what is before says of which kind and how many they are
    begin = data.draw(st.sampled_from([0, 128]))
    places = st.integers(begin, len(contents) - 1)
    for place, byte in data.draw(st.lists(st.tuples(places, st.integers(0, 255)), max_size=6)):
        contents[place] = byte
    contents = contents[: data.draw(st.sampled_from([len(contents), len(contents) - 1]))]
    with TemporaryDirectory() as folder:
        spoilt = Path(folder, 'map')
        shutil.copytree(sound_bundle, spoilt)
        replace_file(spoilt, name, bytes(contents))
        try:
            loaded = load_map(spoilt)
        except MapError:
            return

    everything, everyone = np.arange(40), np.arange(5)
    assert np.isfinite(loaded.points).all()
    assert np.isfinite(all_descriptors(loaded)).all()
    assert loaded.likeness(np.ones(7, np.float32)).shape == (5,)
    for image in everyone:
        seen = loaded.points_seen_by(image)
        assert (np.diff(seen) > 0).all()
        assert len(seen) == loaded.num_points_seen[image]
        assert not len(seen) or (seen[0] >= 0 and seen[-1] < 40)
        assert set(loaded.covisible_with(np.array([image]))) <= set(everyone)
    assert loaded.observers_of(everything, everyone).sum() == 50
    assert (loaded.covisibility != loaded.covisibility.T).nnz == 0


@settings(max_examples=50, deadline=None)
@given(
    points=st.integers(1, 300),
    shares=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=8),
    seed=st.integers(0, 2**32 - 1),
)
def test_any_observations_come_back(points: int, shares: list[float], seed: int) -> None:
    rng = np.random.default_rng(seed)
    seen = [np.flatnonzero(rng.random(points) < share) for share in shares]
    content = replace(
        random_content(images=len(shares), points=max(points, 10)),
        points=rng.normal(size=(points, 3)),
        descriptors=np.eye(DIMENSION)[rng.integers(DIMENSION, size=points)],
        observation_offsets=np.cumsum([0, *map(len, seen)]),
        observation_points=np.concatenate(seen).astype(np.int32),
    )

    found = map_in_memory(Path('nowhere'), content, MANIFEST_TO_BE)

    for image, expected in enumerate(seen):
        np.testing.assert_array_equal(found.points_seen_by(image), expected)
    expected = covisibility_of(*found.observations(), points)
    assert (found.covisibility != expected).nnz == 0
