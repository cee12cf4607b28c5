# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import shutil
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pycolmap
import pytest
from corner_room import CAMERA, CornerRoom, looking_into_the_corner

from gam_relocalizer.cameras import parse_camera
from gam_relocalizer.errors import MapBuildError, MapError, UsageError
from gam_relocalizer.features import create_extractor
from gam_relocalizer.geometry import pose_error
from gam_relocalizer.image_set import ImageSet
from gam_relocalizer.mapping.build import MapBuildOptions, build_map
from gam_relocalizer.mapping.extend import ExtendReport, extend_map
from gam_relocalizer.scene_map import MANIFEST, load_map

if TYPE_CHECKING:
    from pathlib import Path

    from conftest import BuiltMap, Room

FIRST_PASS = 5


@dataclass(frozen=True)
class Extended:
    """A map of the first images of the room, and what came of adding the others."""

    before: Path
    after: Path
    added: Path
    report: ExtendReport


@pytest.fixture(scope='module')
def extended(room: Room, tmp_path_factory: pytest.TempPathFactory) -> Extended:
    folder = tmp_path_factory.mktemp('extend')
    first, added = folder / 'first', folder / 'day 2'
    names = sorted(room.poses)
    for target, chosen in ((first, names[:FIRST_PASS]), (added, names[FIRST_PASS:])):
        target.mkdir()
        for name in chosen:
            shutil.copy(room.images / name, target / name)
    build_map(
        ImageSet.of_folder(first, CAMERA, room.poses),
        folder / 'before',
        MapBuildOptions(max_keypoints=600),
    )
    report = extend_map(folder / 'before', ImageSet.of_folder(added, CAMERA), folder / 'after')
    return Extended(folder / 'before', folder / 'after', added, report)


def test_images_that_were_there_stay_where_they_were(extended: Extended) -> None:
    before, after = load_map(extended.before), load_map(extended.after)

    assert after.image_names[: before.num_images] == before.image_names
    for old, new in zip(before.camera_from_map, after.camera_from_map, strict=False):
        np.testing.assert_allclose(new.matrix(), old.matrix(), atol=1e-6)
    assert after.manifest.frame == before.manifest.frame


def test_added_images_come_to_where_they_were_taken(extended: Extended, room: Room) -> None:
    after = load_map(extended.after)

    assert set(after.image_names) == set(room.poses)
    for name in after.image_names[FIRST_PASS:]:
        error = pose_error(after.camera_from_map[after.image_names.index(name)], room.poses[name])
        assert error.position < 0.03
        assert error.rotation_deg < 0.5


def test_points_on_the_walls_are_added_and_old_ones_are_seen_again(extended: Extended) -> None:
    before, after = load_map(extended.before), load_map(extended.after)
    old = after.points_seen_by(0)
    new = after.points_seen_by(FIRST_PASS)

    assert len(after.points) > 1.1 * len(before.points)
    assert np.median(np.abs(after.points).min(axis=1)) < 0.02
    assert len(np.intersect1d(old, new)) > 50


def test_points_are_numbered_by_the_images_that_see_them(extended: Extended) -> None:
    model = pycolmap.Reconstruction(extended.after / 'sfm')
    points = load_map(extended.after).points
    first_images = [
        min(element.image_id for element in model.point3D(row + 1).track.elements)
        for row in range(len(points))
    ]

    assert sorted(model.point3D_ids()) == list(range(1, len(points) + 1))
    assert first_images == sorted(first_images)


def test_descriptor_is_the_mean_of_all_observations(extended: Extended, room: Room) -> None:
    after = load_map(extended.after)
    name = after.image_names[FIRST_PASS]
    image = cv2.cvtColor(cv2.imread(str(room.images / name)), cv2.COLOR_BGR2RGB)
    features = create_extractor('xfeat', 600).extract(image)
    seen = after.points_seen_by(FIRST_PASS)
    pixels = CAMERA.img_from_cam(room.poses[name] * after.points[seen])

    best = (after.descriptors_of(seen) @ features.descriptors.T).argmax(axis=1)

    distances = np.linalg.norm(features.keypoints[best] - pixels, axis=1)
    assert np.mean(distances < 4.0) > 0.9


def test_history_and_report_tell_what_was_added(extended: Extended, room: Room) -> None:
    after, added = load_map(extended.after), len(room.poses) - FIRST_PASS
    (change,) = after.manifest.build['changes']

    assert (extended.report.images_given, len(extended.report.registered)) == (added, added)
    assert extended.report.unregistered == ()
    assert extended.report.points == len(after.points)
    assert (change['what'], change['images']) == ('extend', 'day 2')
    assert change['images_registered'] == added
    assert after.manifest.build['report']['points'] == len(after.points)
    assert len(after.manifest.build['report']['cameras']) == 1


def test_a_map_that_is_extended_twice_in_place_remembers_both(
    extended: Extended, tmp_path: Path
) -> None:
    path = tmp_path / 'map'
    shutil.copytree(extended.after, path)

    extend_map(path, ImageSet.of_folder(extended.added, CAMERA), path, prefix='again/')

    scene_map = load_map(path)
    assert len(scene_map.manifest.build['changes']) == 2
    assert scene_map.num_images == load_map(extended.after).num_images + 3
    assert 'again/view 07.png' in scene_map.image_names


def test_camera_of_the_map_is_used_for_images_of_its_size(
    extended: Extended, room: Room, tmp_path: Path
) -> None:
    extend_map(extended.before, ImageSet.of_folder(extended.added), tmp_path / 'map')

    after = load_map(tmp_path / 'map')
    (camera,) = {parse_camera(one).params[0] for one in after.manifest.build['report']['cameras']}
    assert camera == pytest.approx(340.0)
    error = pose_error(after.camera_from_map[-1], room.poses[after.image_names[-1]])
    assert error.position < 0.03


def test_images_that_find_no_place_are_named(extended: Extended, tmp_path: Path) -> None:
    images = tmp_path / 'images'
    shutil.copytree(extended.added, images)
    elsewhere = CornerRoom(seed=7).render(looking_into_the_corner(0.5))
    cv2.imwrite(str(images / 'elsewhere.png'), elsewhere)
    (images / 'broken.png').write_bytes(b'no image')

    report = extend_map(extended.before, ImageSet.of_folder(images, CAMERA), tmp_path / 'map')

    assert report.unregistered == ('elsewhere.png',)
    assert list(report.unreadable) == ['broken.png']
    assert len(report.registered) == 3


def test_images_of_elsewhere_are_refused_and_nothing_is_written(
    extended: Extended, tmp_path: Path
) -> None:
    (tmp_path / 'images').mkdir()
    for step in range(3):
        image = CornerRoom(seed=7).render(looking_into_the_corner(0.3 + 0.1 * step))
        cv2.imwrite(str(tmp_path / 'images' / f'{step}.png'), image)

    with pytest.raises(MapBuildError, match='none of the 3 images'):
        extend_map(
            extended.before, ImageSet.of_folder(tmp_path / 'images', CAMERA), tmp_path / 'map'
        )
    assert [one.name for one in tmp_path.iterdir()] == ['images']


def test_same_images_same_map(extended: Extended, tmp_path: Path) -> None:
    images = ImageSet.of_folder(extended.added, CAMERA)

    extend_map(extended.before, images, tmp_path / 'again')

    assert load_map(tmp_path / 'again').manifest.map_id == load_map(extended.after).manifest.map_id


def test_names_of_the_map_are_refused_before_any_work(
    extended: Extended, posed_map: BuiltMap, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match='--prefix'):
        extend_map(posed_map.path, ImageSet.of_folder(extended.added, CAMERA), tmp_path / 'map')
    assert not (tmp_path / 'map').exists()


def test_output_that_is_no_map_is_refused(extended: Extended, tmp_path: Path) -> None:
    (tmp_path / 'photos').mkdir()

    with pytest.raises(MapError):
        extend_map(extended.before, ImageSet.of_folder(extended.added, CAMERA), tmp_path / 'photos')


def test_map_without_its_colmap_model_is_refused(extended: Extended, tmp_path: Path) -> None:
    path = tmp_path / 'map'
    shutil.copytree(extended.before, path)
    (path / 'sfm' / 'points3D.bin').unlink()

    with pytest.raises(MapError, match=r'points3D\.bin'):
        extend_map(path, ImageSet.of_folder(extended.added, CAMERA), tmp_path / 'new')


def test_map_of_other_weights_is_refused(extended: Extended, tmp_path: Path) -> None:
    path = tmp_path / 'map'
    shutil.copytree(extended.before, path)
    manifest = (path / MANIFEST).read_text()
    sha256 = load_map(path).manifest.extractor.weights_sha256
    (path / MANIFEST).write_text(manifest.replace(sha256, 64 * '0'))

    with pytest.raises(MapError, match='extractor'):
        extend_map(path, ImageSet.of_folder(extended.added, CAMERA), tmp_path / 'new')


def test_names_that_lead_out_of_the_folder_are_refused(
    posed_map: BuiltMap, room: Room, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match='leads out'):
        extend_map(
            posed_map.path,
            ImageSet.of_folder(room.images, CAMERA),
            tmp_path / 'map',
            prefix='../x/',
        )
