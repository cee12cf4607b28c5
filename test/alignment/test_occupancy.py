# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gam_relocalizer.alignment.align import align_map
from gam_relocalizer.alignment.constraints import Picks, Poses
from gam_relocalizer.alignment.occupancy import OccupancyMap, read_occupancy_map
from gam_relocalizer.alignment.picture import draw_over_occupancy
from gam_relocalizer.errors import AlignmentError, ImageError, UsageError
from gam_relocalizer.images import read_image
from gam_relocalizer.scene_map import MapFrame, save_frame

if TYPE_CHECKING:
    from pathlib import Path

    from surveyed_room import SurveyedRoom

GRID = OccupancyMap(np.full((220, 300), 90, np.uint8), 0.05, (-7.0, -6.0, 0.25))


def picks_of(room: SurveyedRoom, noise_px: float = 0.0) -> dict[str, tuple[float, float]]:
    rng = np.random.default_rng(4)
    places = np.array(list(room.positions.values()))[:, :2]
    pixels = GRID.pixels_from_map(places) + rng.normal(0.0, noise_px, places.shape)
    return {name: (one[0], one[1]) for name, one in zip(room.positions, pixels, strict=True)}


def write_map(folder: Path, **changes: object) -> Path:
    fields = {'image': 'plan.pgm', 'resolution': 0.05, 'origin': [-7.0, -6.0, 0.25], **changes}
    text = ''.join(f'{name}: {value}\n' for name, value in fields.items() if value is not None)
    (folder / 'map.yaml').write_text(f'{text}negate: 0\noccupied_thresh: 0.65\n')
    cv2.imwrite(str(folder / 'plan.pgm'), GRID.image)
    return folder / 'map.yaml'


def test_the_origin_is_the_lower_left_corner_of_the_image() -> None:
    grid = OccupancyMap(np.zeros((40, 60), np.uint8), 0.1, (2.0, -1.0, 0.0))

    corners = grid.map_from_pixels([[0, 40], [60, 40], [0, 0]])

    assert np.allclose(corners, [[2.0, -1.0], [8.0, -1.0], [2.0, 3.0]])


def test_the_yaw_of_the_origin_turns_the_image_about_its_lower_left_corner() -> None:
    grid = OccupancyMap(np.zeros((40, 60), np.uint8), 0.1, (2.0, -1.0, np.pi / 2))

    corners = grid.map_from_pixels([[0, 40], [60, 40], [0, 0]])

    assert np.allclose(corners, [[2.0, -1.0], [2.0, 5.0], [-2.0, -1.0]])


@given(
    pixel=st.tuples(st.floats(0, 60), st.floats(0, 40)),
    origin=st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-3, 3)),
)
def test_pixels_and_places_are_inverse(
    pixel: tuple[float, float], origin: tuple[float, float, float]
) -> None:
    grid = OccupancyMap(np.zeros((40, 60), np.uint8), 0.05, origin)

    assert np.allclose(grid.pixels_from_map(grid.map_from_pixels([pixel])), [pixel], atol=1e-6)


def test_picks_lay_the_map_into_the_frame_of_the_plan(room: SurveyedRoom) -> None:
    report = align_map(room.path, Picks(GRID, picks_of(room, noise_px=0.5), level=True))

    position, rotation = room.errors()
    assert position < 0.04
    assert rotation < 0.5
    assert report.frame.metric


def test_a_third_of_wrong_picks_does_not_matter(room: SurveyedRoom) -> None:
    rng = np.random.default_rng(5)
    picks = picks_of(room, noise_px=0.5)
    for name in list(picks)[::3]:
        picks[name] = tuple(rng.uniform([0, 0], [300, 220]))

    report = align_map(room.path, Picks(GRID, picks, level=True))

    position, _ = room.errors()
    assert position < 0.05
    assert report.inliers <= len(picks) - len(list(picks)[::3])


def test_a_level_map_needs_no_levelling(room: SurveyedRoom) -> None:
    align_map(room.path, Poses(room.camera_from_world))

    align_map(room.path, Picks(GRID, picks_of(room)))

    position, rotation = room.errors()
    assert position < 1e-6
    assert rotation < 1e-6


def test_a_map_that_is_not_level_is_refused(room: SurveyedRoom) -> None:
    save_frame(room.path, MapFrame(), {})

    with pytest.raises(AlignmentError, match='--level'):
        align_map(room.path, Picks(GRID, picks_of(room)))


def test_rows_counted_from_the_bottom_are_found_out(room: SurveyedRoom) -> None:
    picks = {name: (column, 220 - row) for name, (column, row) in picks_of(room).items()}

    with pytest.raises(AlignmentError, match='mirrored'):
        align_map(room.path, Picks(GRID, picks, level=True))


def test_a_pick_outside_of_the_plan_is_refused(room: SurveyedRoom) -> None:
    picks = {**picks_of(room), next(iter(room.positions)): (301.0, 5.0)}

    with pytest.raises(UsageError, match='outside'):
        align_map(room.path, Picks(GRID, picks, level=True))


def test_reads_what_map_server_reads(tmp_path: Path) -> None:
    grid = read_occupancy_map(write_map(tmp_path))

    assert grid.resolution == GRID.resolution
    assert grid.origin == GRID.origin
    assert (grid.image == GRID.image).all()


@pytest.mark.parametrize(
    'changes',
    [
        {'resolution': 0.0},
        {'resolution': 'nan'},
        {'resolution': None},
        {'origin': '[1.0, 2.0]'},
        {'origin': 'here'},
        {'image': None},
        {'origin': '!!python/object/apply:os.getcwd []'},
    ],
)
def test_a_malformed_map_is_refused(changes: dict[str, object], tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r'map\.yaml'):
        read_occupancy_map(write_map(tmp_path, **changes))


def test_missing_and_huge_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError):
        read_occupancy_map(tmp_path / 'map.yaml')
    with pytest.raises(ImageError):
        read_occupancy_map(write_map(tmp_path, image='other.pgm'))
    (tmp_path / 'map.yaml').write_text('#' * 100_000)
    with pytest.raises(UsageError):
        read_occupancy_map(tmp_path / 'map.yaml')


def test_the_picture_shows_points_where_the_walls_are(room: SurveyedRoom, tmp_path: Path) -> None:
    picks = Picks(GRID, picks_of(room), level=True)
    report = align_map(room.path, picks, dry_run=True)

    draw_over_occupancy(room.path, report.frame, picks, tmp_path / 'plan.png')

    picture = read_image(tmp_path / 'plan.png').astype(int)
    plan = (abs(picture - 90) <= 1).all(axis=2)
    rows, columns = (np.flatnonzero(plan.mean(axis=axis) > 0.3) for axis in (1, 0))
    picture = picture[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    blue = np.argwhere(picture[:, :, 2] - picture[:, :, 0] > 60)[:, ::-1]
    drawn = blue / picture.shape[1::-1] * (300, 220)
    truth = GRID.pixels_from_map(room.points[:, :2])
    ends = [0.02, 0.98]
    assert np.allclose(np.quantile(drawn, ends, axis=0), np.quantile(truth, ends, axis=0), atol=4)
