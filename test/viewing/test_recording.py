# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What rerun reads back of a recording."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pycolmap
import pytest

from gam_relocalizer.errors import UsageError
from gam_relocalizer.geometry import PoseError
from gam_relocalizer.localization.result import Status
from gam_relocalizer.scene_map import (
    ExtractorIdentity,
    Manifest,
    MapContent,
    MapFrame,
    load_map,
    save_map,
)
from gam_relocalizer.viewing import recording as recordings
from gam_relocalizer.viewing.drive import Drive, DriveAttempt
from gam_relocalizer.viewing.recording import write_recording

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from gam_relocalizer.scene_map import SceneMap

rrd = pytest.importorskip('rerun.chunk', reason='the extra `view` is not installed')

SECOND = 10**9
START_NS = 1_700_000_000 * SECOND + 123_456_789


@pytest.fixture(scope='module')
def model() -> pycolmap.Reconstruction:
    """Six images of two cameras, one of them a fisheye, that see 300 points."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs = 2
    options.num_frames_per_rig = 3
    options.num_points3D = 300
    options.camera_model_id = pycolmap.CameraModelId.OPENCV_FISHEYE
    options.camera_params = [640.0, 630.0, 512.0, 384.0, 0.01, 0.0, 0.0, 0.0]
    options.num_points2D_without_point3D = 0
    pycolmap.set_random_seed(0)
    return pycolmap.synthesize_dataset(options)


def save_model(path: Path, model: pycolmap.Reconstruction, *, with_sfm: bool = True) -> SceneMap:
    """A bundle of a model, twice as large in the map frame and moved."""
    ids = sorted(model.point3D_ids())
    images = [model.images[one] for one in sorted(model.reg_image_ids())]
    seen = [
        np.unique(
            np.searchsorted(
                ids,
                [image.point2D(int(i)).point3D_id for i in image.get_observation_point2D_idxs()],
            )
        )
        for image in images
    ]
    content = MapContent(
        image_names=tuple(image.name for image in images),
        camera_from_sfm=tuple(image.cam_from_world() for image in images),
        points=np.array([model.points3D[one].xyz for one in ids]),
        descriptors=np.ones((len(ids), 4)),
        observation_offsets=np.cumsum([0, *map(len, seen)], dtype=np.int64),
        observation_points=np.concatenate(seen).astype(np.int32),
        global_descriptors=np.ones((len(images), 4), np.float32),
        codebook=np.ones((1, 4), np.float32),
    )
    frame = MapFrame(2.0, translation=(10.0, 20.0, 30.0), metric=True, source='a test')
    manifest = Manifest(ExtractorIdentity('xfeat', 4, ''), 'vlad', frame, {})
    save_map(path, content, manifest, model if with_sfm else None)
    return load_map(path)


@pytest.fixture(scope='module')
def scene_map(model: pycolmap.Reconstruction, tmp_path_factory: pytest.TempPathFactory) -> SceneMap:
    return save_model(tmp_path_factory.mktemp('maps') / 'synthetic', model)


def columns_of(file: Path, entity: str, column: str) -> Iterator[Any]:
    """All values of a column of an entity, row by row, as rerun's own reader gives them."""
    for chunk in rrd.RrdReader(str(file)).stream():
        if chunk.entity_path == entity and chunk.num_rows:
            batch = chunk.to_record_batch()
            if column in batch.schema.names:
                values = batch.column(column)
                # Python's own times end at microseconds
                values = values.cast('int64') if column == recordings.TIMELINE else values
                yield from values.to_pylist()


def entities_of(file: Path) -> set[str]:
    return {chunk.entity_path for chunk in rrd.RrdReader(str(file)).stream()}


def test_holds_every_point_of_the_map(scene_map: SceneMap, tmp_path: Path) -> None:
    write_recording(tmp_path / 'map.rrd', scene_map)

    (points,) = columns_of(tmp_path / 'map.rrd', '/map/points', 'Points3D:positions')
    (colours,) = columns_of(tmp_path / 'map.rrd', '/map/points', 'Points3D:colors')
    assert len(points) == len(colours) == 300
    np.testing.assert_allclose(points, scene_map.points, rtol=1e-6)


def test_holds_each_camera_where_it_is_and_how_it_looks(
    scene_map: SceneMap, model: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    write_recording(tmp_path / 'map.rrd', scene_map)

    for row, name in enumerate(scene_map.image_names):
        entity = next(
            one
            for one in entities_of(tmp_path / 'map.rrd')
            if one.startswith('/map/images/') and one.replace('\\', '').endswith(f'/{name}')
        )
        ((position,),) = columns_of(tmp_path / 'map.rrd', entity, 'Transform3D:translation')
        ((turned,),) = columns_of(tmp_path / 'map.rrd', entity, 'Transform3D:mat3x3')
        ((projected,),) = columns_of(tmp_path / 'map.rrd', entity, 'Pinhole:image_from_camera')
        map_from_camera = scene_map.camera_from_map[row].inverse()
        np.testing.assert_allclose(position, scene_map.camera_positions[row], rtol=1e-6)
        # rerun writes matrices column by column
        np.testing.assert_allclose(
            np.reshape(turned, (3, 3)).T, map_from_camera.rotation.matrix(), atol=1e-6
        )
        camera = next(one for one in model.images.values() if one.name == name).camera
        np.testing.assert_allclose(
            np.reshape(projected, (3, 3)).T, camera.calibration_matrix(), rtol=1e-6
        )


def test_covisibility_ties_the_images_that_share_points(
    scene_map: SceneMap, tmp_path: Path
) -> None:
    write_recording(tmp_path / 'map.rrd', scene_map)

    (strips,) = columns_of(tmp_path / 'map.rrd', '/map/covisibility', 'LineStrips3D:strips')
    pairs = np.argwhere(np.triu(scene_map.covisibility.toarray() >= 20, k=1))
    found = {tuple(np.round(np.ravel(strip), 3)) for strip in strips}
    expected = {tuple(np.round(scene_map.camera_positions[pair].ravel(), 3)) for pair in pairs}
    assert len(strips) == len(pairs)
    np.testing.assert_allclose(sorted(found), sorted(expected), atol=2e-3)


def test_large_maps_are_thinned(
    scene_map: SceneMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recordings, 'MAX_POINTS', 100)
    monkeypatch.setattr(recordings, 'MAX_IMAGES', 3)
    monkeypatch.setattr(recordings, 'MAX_EDGES', 4)

    write_recording(tmp_path / 'map.rrd', scene_map)

    (points,) = columns_of(tmp_path / 'map.rrd', '/map/points', 'Points3D:positions')
    (strips,) = columns_of(tmp_path / 'map.rrd', '/map/covisibility', 'LineStrips3D:strips')
    images = [one for one in entities_of(tmp_path / 'map.rrd') if one.startswith('/map/images/')]
    assert (len(points), len(strips), len(images)) == (100, 4, 3)


def test_a_map_without_its_model_shows_the_way_cameras_look(
    model: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    scene_map = save_model(tmp_path / 'map', model, with_sfm=False)

    write_recording(tmp_path / 'map.rrd', scene_map)

    (origins,) = columns_of(tmp_path / 'map.rrd', '/map/images', 'Arrows3D:origins')
    np.testing.assert_allclose(origins, scene_map.camera_positions, rtol=1e-6)


def drive_of(scene_map: SceneMap) -> Drive:
    """Two fixes, one refusal half-way in time between them, and one after."""
    fixes = [pose.inverse() for pose in scene_map.camera_from_map[:2]]
    return Drive(
        scene_map.manifest.map_id,
        (
            DriveAttempt(START_NS, Status.ACCEPTED, 'fine', 90, fixes[0]),
            DriveAttempt(START_NS + SECOND, Status.AMBIGUOUS, 'two places', 30, None),
            DriveAttempt(START_NS + 2 * SECOND, Status.ACCEPTED, 'fine', 80, fixes[1]),
            DriveAttempt(START_NS + 3 * SECOND, Status.NO_POSE, 'nothing fits', 0, None),
        ),
    )


def test_fixes_of_a_drive_are_where_and_when_they_were(scene_map: SceneMap, tmp_path: Path) -> None:
    write_recording(tmp_path / 'map.rrd', scene_map, drive_of(scene_map))

    file = tmp_path / 'map.rrd'
    places = [row[0] for row in columns_of(file, '/drive/fix', 'Transform3D:translation')]
    stamps = list(columns_of(file, '/drive/fix', 'stamp'))
    np.testing.assert_allclose(places, scene_map.camera_positions[:2], rtol=1e-6)
    assert stamps == [START_NS, START_NS + 2 * SECOND]
    ((trajectory,),) = columns_of(file, '/drive/trajectory', 'LineStrips3D:strips')
    np.testing.assert_allclose(trajectory, scene_map.camera_positions[:2], rtol=1e-6)


def test_refused_attempts_lie_between_the_fixes_around_them(
    scene_map: SceneMap, tmp_path: Path
) -> None:
    write_recording(tmp_path / 'map.rrd', scene_map, drive_of(scene_map))

    file = tmp_path / 'map.rrd'
    refused = [row[0] for row in columns_of(file, '/drive/refused', 'Points3D:positions') if row]
    first, last = scene_map.camera_positions[:2]
    np.testing.assert_allclose(refused, [(first + last) / 2.0, last], rtol=1e-5)
    texts = [row[0] for row in columns_of(file, '/drive/verdict', 'TextLog:text')]
    inliers = [row[0] for row in columns_of(file, '/drive/inliers', 'Scalars:scalars')]
    assert [text.split(':')[0] for text in texts] == [
        'ACCEPTED',
        'AMBIGUOUS',
        'ACCEPTED',
        'NO_POSE',
    ]
    assert inliers == [90, 30, 80, 0]


def test_errors_are_shown_over_time_where_they_are_known(
    scene_map: SceneMap, tmp_path: Path
) -> None:
    first, *others = drive_of(scene_map).attempts
    known = replace(first, error=PoseError(0.25, 1.5))

    write_recording(tmp_path / 'map.rrd', scene_map, Drive('abc', (known, *others)))

    file = tmp_path / 'map.rrd'
    for name, value in (('position', 0.25), ('rotation_deg', 1.5)):
        (error,) = columns_of(file, f'/drive/error/{name}', 'Scalars:scalars')
        assert error == [value]


def test_a_drive_without_any_fix_has_verdicts_alone(scene_map: SceneMap, tmp_path: Path) -> None:
    drive = Drive('abc', drive_of(scene_map).attempts[1::2])

    write_recording(tmp_path / 'map.rrd', scene_map, drive)

    drawn = {one for one in entities_of(tmp_path / 'map.rrd') if one.startswith('/drive/')}
    assert drawn == {'/drive/verdict', '/drive/inliers'}


def test_a_file_that_cannot_be_written_is_a_usage_error(
    scene_map: SceneMap, tmp_path: Path
) -> None:
    (tmp_path / 'file').touch()

    with pytest.raises(UsageError):
        write_recording(tmp_path / 'file' / 'map.rrd', scene_map)


def test_a_failed_recording_leaves_nothing(
    scene_map: SceneMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, 'rerun', None)

    with pytest.raises(UsageError, match=r'gam_relocalizer\[view\]'):
        write_recording(tmp_path / 'map.rrd', scene_map)

    assert list(tmp_path.iterdir()) == []


def test_the_library_is_imported_on_demand() -> None:
    code = 'import sys, gam_relocalizer.viewing.recording as r; sys.exit("rerun" in sys.modules)'

    assert subprocess.run([sys.executable, '-c', code], check=False).returncode == 0


def test_a_recording_that_is_not_finished_leaves_nothing_behind(
    model: pycolmap.Reconstruction, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene_map = save_model(tmp_path / 'map', model)

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(recordings, '_record_map', interrupt)

    with pytest.raises(KeyboardInterrupt):
        write_recording(tmp_path / 'map.rrd', scene_map)

    assert [file.name for file in tmp_path.iterdir()] == ['map']
