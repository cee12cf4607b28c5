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

from gam_relocalizer.errors import MapError, UsageError
from gam_relocalizer.geometry import pose_error
from gam_relocalizer.image_set import ImageSet
from gam_relocalizer.localization.localizer import Localizer
from gam_relocalizer.mapping.extend import extend_map
from gam_relocalizer.mapping.prune import PruneReport, prune_map
from gam_relocalizer.scene_map import SFM, load_content, load_map, save_map

if TYPE_CHECKING:
    from pathlib import Path

    from conftest import BuiltMap, Room

    from gam_relocalizer.scene_map import SceneMap


@dataclass(frozen=True)
class Pruned:
    """A small map and what its making reported."""

    path: Path
    report: PruneReport


@pytest.fixture(scope='module')
def pruned(posed_map: BuiltMap, room: Room, tmp_path_factory: pytest.TempPathFactory) -> Pruned:
    path = tmp_path_factory.mktemp('prune') / 'small'
    return Pruned(path, prune_map(posed_map.path, path, 0.4, folder=room.images))


def size_of(path: Path) -> int:
    return sum(
        file.stat().st_size
        for file in path.rglob('*')
        if file.is_file() and SFM not in file.parts and file.name != 'manifest.yaml'
    )


def points_by_place(scene_map: SceneMap) -> set[tuple[float, ...]]:
    return {tuple(np.round(point, 4).tolist()) for point in scene_map.points}


@pytest.mark.parametrize('keep', [0.3, 0.6])
@pytest.mark.parametrize('bits', [8, 16])
def test_the_size_is_the_share_asked_for(
    posed_map: BuiltMap, tmp_path: Path, keep: float, bits: int
) -> None:
    report = prune_map(posed_map.path, tmp_path / 'small', keep, descriptor_bits=bits)

    share = size_of(tmp_path / 'small') / size_of(posed_map.path)
    assert 0.9 * keep < share <= keep
    assert report.size == (size_of(posed_map.path), size_of(tmp_path / 'small'))
    assert load_map(tmp_path / 'small').manifest.descriptor_bits == bits


def test_what_stays_is_where_it_was(pruned: Pruned, posed_map: BuiltMap) -> None:
    whole, small = load_map(posed_map.path), load_map(pruned.path)
    poses = dict(zip(whole.image_names, whole.camera_from_map, strict=True))

    assert 0 < small.num_points < whole.num_points
    assert points_by_place(small) <= points_by_place(whole)
    for name, pose in zip(small.image_names, small.camera_from_map, strict=True):
        np.testing.assert_allclose(pose.matrix(), poses[name].matrix(), atol=1e-9)
    assert small.manifest.frame == whole.manifest.frame


def test_every_point_is_seen_by_two_images_that_stay(pruned: Pruned) -> None:
    small = load_map(pruned.path)
    seen = np.concatenate([small.points_seen_by(image) for image in range(small.num_images)])

    assert np.bincount(seen, minlength=small.num_points).min() >= 2


def test_descriptors_stay_with_their_points(pruned: Pruned, posed_map: BuiltMap) -> None:
    whole, small = load_map(posed_map.path), load_map(pruned.path)
    distances = np.linalg.norm(whole.points[:, None] - small.points[None], axis=2)
    same = distances.argmin(axis=0)

    cosines = np.einsum(
        'kd,kd->k',
        whole.descriptors_of(same),
        small.descriptors_of(np.arange(small.num_points)),
    )

    assert cosines.min() > 0.99


def test_a_small_map_still_localizes(pruned: Pruned) -> None:
    truth = looking_into_the_corner(0.45)

    result = Localizer.load(pruned.path).localize(CornerRoom().render(truth), CAMERA)

    assert result.accepted
    assert result.estimate is not None
    error = pose_error(result.estimate.camera_from_map, truth)
    assert error.position < 0.05
    assert error.rotation_deg < 0.5


def test_recall_is_measured_in_both_maps_and_kept(pruned: Pruned, room: Room) -> None:
    recall = pruned.report.recall
    (change,) = load_map(pruned.path).manifest.build['changes']

    assert recall is not None
    assert recall.queries == len(room.poses)
    assert recall.before == 1.0
    assert 0.5 < recall.after <= 1.0
    assert change['what'] == 'prune'
    assert change['recall'] == {
        'queries': recall.queries,
        'before': recall.before,
        'after': recall.after,
    }


def test_colmap_model_is_that_of_the_small_map(pruned: Pruned) -> None:
    model, small = pycolmap.Reconstruction(pruned.path / SFM), load_map(pruned.path)

    assert {image.name for image in model.images.values()} == set(small.image_names)
    for row in (0, small.num_points - 1):
        np.testing.assert_allclose(model.point3D(row + 1).xyz, small.points[row], atol=1e-5)
    by_name = {image.name: image for image in model.images.values()}
    for index, name in enumerate(small.image_names):
        image = by_name[name]
        seen = {image.point2D(one).point3D_id - 1 for one in image.get_observation_point2D_idxs()}
        assert seen == set(small.points_seen_by(index).tolist())


def test_a_small_map_can_be_extended(pruned: Pruned, tmp_path: Path) -> None:
    (tmp_path / 'images').mkdir()
    truth = looking_into_the_corner(0.37)
    image = cv2.cvtColor(CornerRoom().render(truth), cv2.COLOR_RGB2BGR)
    cv2.imwrite(str(tmp_path / 'images' / 'new.png'), image)

    extend_map(pruned.path, ImageSet.of_folder(tmp_path / 'images', CAMERA), tmp_path / 'map')

    extended = load_map(tmp_path / 'map')
    error = pose_error(extended.camera_from_map[extended.image_names.index('new.png')], truth)
    assert error.position < 0.03


def test_everything_stays_when_everything_is_kept(posed_map: BuiltMap, tmp_path: Path) -> None:
    prune_map(posed_map.path, tmp_path / 'same', 1.0, descriptor_bits=16)

    whole, same = load_map(posed_map.path), load_map(tmp_path / 'same')
    assert same.image_names == whole.image_names
    np.testing.assert_array_equal(same.points, whole.points)


def test_same_map_same_result(posed_map: BuiltMap, pruned: Pruned, tmp_path: Path) -> None:
    prune_map(posed_map.path, tmp_path / 'again', 0.4)

    again = load_map(tmp_path / 'again').manifest
    assert again.map_id == load_map(pruned.path).manifest.map_id


def test_the_map_itself_is_not_changed(posed_map: BuiltMap, pruned: Pruned) -> None:
    assert pruned.path != posed_map.path
    assert 'changes' not in load_map(posed_map.path).manifest.build


def test_a_map_can_be_pruned_in_place(posed_map: BuiltMap, tmp_path: Path) -> None:
    path = tmp_path / 'map'
    shutil.copytree(posed_map.path, path)

    prune_map(path, path, 0.5)

    assert size_of(path) <= 0.5 * size_of(posed_map.path)


@pytest.mark.parametrize('keep', [0.0, -0.5, 1.01, float('nan')])
def test_impossible_shares_are_refused(posed_map: BuiltMap, tmp_path: Path, keep: float) -> None:
    with pytest.raises(UsageError, match='--keep'):
        prune_map(posed_map.path, tmp_path / 'small', keep)


def test_a_share_that_holds_no_map_is_refused(posed_map: BuiltMap, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match='keep more'):
        prune_map(posed_map.path, tmp_path / 'small', 0.01)
    assert list(tmp_path.iterdir()) == []


def test_bits_that_no_map_has_are_refused(posed_map: BuiltMap, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match='--descriptor-bits'):
        prune_map(posed_map.path, tmp_path / 'small', 0.5, descriptor_bits=4)


def test_a_map_without_its_colmap_model_is_refused(posed_map: BuiltMap, tmp_path: Path) -> None:
    manifest, content = load_content(posed_map.path)
    save_map(tmp_path / 'bare', content, manifest, None)

    with pytest.raises(MapError, match='sfm'):
        prune_map(tmp_path / 'bare', tmp_path / 'small', 0.5)


def test_images_of_another_folder_are_refused(posed_map: BuiltMap, tmp_path: Path) -> None:
    with pytest.raises(UsageError):
        prune_map(posed_map.path, tmp_path / 'small', 0.5, folder=tmp_path / 'nowhere')
    assert not (tmp_path / 'small').exists()
