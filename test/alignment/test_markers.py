# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from surveyed_room import CAMERA, SurveyedRoom, draw_marker_images, looking, save_room

from gam_relocalizer.alignment.align import align_map
from gam_relocalizer.alignment.constraints import MarkerPlace, Markers
from gam_relocalizer.errors import AlignmentError, ImageError, UsageError
from gam_relocalizer.geometry import quaternion_wxyz, rigid3d_from_rotation
from gam_relocalizer.scene_map import MANIFEST

if TYPE_CHECKING:
    from pathlib import Path

    import pycolmap

SIDE = 0.5
DICTIONARY = 'DICT_4X4_50'
# On the wall y = 3, facing the room: x to the right, the print's top up, out of it -y.
ON_THE_WALL = Rotation.from_matrix(np.stack([[1, 0, 0], [0, 0, 1], [0, -1, 0]], axis=1))


def hanging(x: float, y: float, z: float) -> pycolmap.Rigid3d:
    return rigid3d_from_rotation(ON_THE_WALL, np.array([x, y, z]))


PRINTS = [
    (3, hanging(-0.8, 3.0, 1.4), SIDE),
    (7, hanging(0.8, 2.8, 1.0), SIDE),
    (9, hanging(0.0, 2.4, 1.9), SIDE),
]
VIEWS = {
    f'{index}.png': looking(
        [-1.2 + 0.6 * index, -0.4 + 0.2 * (index % 2), 1.1 + 0.1 * index],
        yaw=np.pi / 2 + 0.3 - 0.15 * index,
        pitch=-0.05,
    )
    for index in range(5)
}


@pytest.fixture(scope='module')
def place(tmp_path_factory: pytest.TempPathFactory) -> SurveyedRoom:
    return save_room(tmp_path_factory.mktemp('markers') / 'map', VIEWS, with_sfm=True)


@pytest.fixture(scope='module')
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('markers') / 'images'
    draw_marker_images(folder, VIEWS, PRINTS)
    return folder


def test_the_side_of_markers_gives_the_scale(place: SurveyedRoom, images: Path) -> None:
    report = align_map(place.path, Markers(SIDE, DICTIONARY, images))

    assert report.frame.scale == pytest.approx(place.world_from_sfm.scale, rel=0.005)
    assert report.frame.metric
    assert report.inliers == 3
    sigma = report.findings.scale_sigma
    assert sigma is not None
    assert abs(report.frame.scale / place.world_from_sfm.scale - 1.0) < 3.0 * sigma < 0.05


@pytest.mark.parametrize('oriented', [True, False])
def test_known_places_of_markers_give_the_whole_frame(
    place: SurveyedRoom, images: Path, *, oriented: bool
) -> None:
    places = {
        marker: MarkerPlace(
            tuple(world_from_marker.translation),
            tuple(quaternion_wxyz(world_from_marker)) if oriented else None,
        )
        for marker, world_from_marker, _ in PRINTS
    }

    report = align_map(place.path, Markers(SIDE, DICTIONARY, images, places))

    position, rotation = place.errors()
    assert position < 0.03
    assert rotation < 0.6
    assert len(report.residuals) == (12 if oriented else 3)


def test_a_size_that_is_wrong_for_one_marker_is_named_and_left_out(
    place: SurveyedRoom, tmp_path: Path
) -> None:
    prints = [*PRINTS[:2], (9, PRINTS[2][1], 0.3)]
    draw_marker_images(tmp_path / 'images', VIEWS, prints)

    report = align_map(place.path, Markers(SIDE, DICTIONARY, tmp_path / 'images'))

    assert report.frame.scale == pytest.approx(place.world_from_sfm.scale, rel=0.005)
    assert report.residuals[0].name.startswith('marker 9 ')
    assert not report.residuals[0].inlier


def test_an_id_printed_twice_is_refused_by_name(place: SurveyedRoom, tmp_path: Path) -> None:
    names = list(VIEWS)
    folder = tmp_path / 'images'
    draw_marker_images(folder, {name: VIEWS[name] for name in names[:3]}, PRINTS[:1])
    elsewhere = [(3, PRINTS[1][1], SIDE)]
    draw_marker_images(tmp_path / 'rest', {name: VIEWS[name] for name in names[3:]}, elsewhere)
    for file in (tmp_path / 'rest').iterdir():
        file.rename(folder / file.name)

    with pytest.raises(AlignmentError, match='marker 3 is at two places'):
        align_map(place.path, Markers(SIDE, DICTIONARY, folder))


def test_an_id_twice_in_one_image_is_refused_by_name(place: SurveyedRoom, tmp_path: Path) -> None:
    twins = [PRINTS[0], (3, hanging(0.5, 2.8, 1.2), SIDE)]
    draw_marker_images(tmp_path / 'images', VIEWS, twins)

    with pytest.raises(AlignmentError, match='marker 3 twice'):
        align_map(place.path, Markers(SIDE, DICTIONARY, tmp_path / 'images'))


def test_a_marker_that_one_image_shows_is_no_scale(place: SurveyedRoom, tmp_path: Path) -> None:
    draw_marker_images(tmp_path / 'images', VIEWS, [])
    (tmp_path / 'images' / '2.png').unlink()
    draw_marker_images(tmp_path / 'one', {'2.png': VIEWS['2.png']}, PRINTS[:1])
    (tmp_path / 'one' / '2.png').rename(tmp_path / 'images' / '2.png')
    before = (place.path / MANIFEST).read_bytes()

    with pytest.raises(AlignmentError, match='no marker'):
        align_map(place.path, Markers(SIDE, DICTIONARY, tmp_path / 'images'))

    assert (place.path / MANIFEST).read_bytes() == before


def test_what_cannot_be_used_is_refused(place: SurveyedRoom, images: Path, tmp_path: Path) -> None:
    (tmp_path / 'empty').mkdir()
    for constraint, error in [
        (Markers(SIDE, 'DICT_3X3_50', images), UsageError),
        (Markers(0.0, DICTIONARY, images), UsageError),
        (Markers(SIDE, DICTIONARY, tmp_path / 'nowhere'), UsageError),
        (Markers(SIDE, DICTIONARY, tmp_path / 'empty'), ImageError),
        (Markers(SIDE, DICTIONARY, images, {5: MarkerPlace((0.0, 0.0, 0.0))}), UsageError),
        (Markers(SIDE, DICTIONARY, images, {}, level=True), UsageError),
    ]:
        with pytest.raises(error):
            align_map(place.path, constraint)


def test_a_map_without_its_model_is_refused(images: Path, tmp_path: Path) -> None:
    bare = save_room(tmp_path / 'map', VIEWS, camera=CAMERA)

    with pytest.raises(AlignmentError, match='sfm/'):
        align_map(bare.path, Markers(SIDE, DICTIONARY, images))
