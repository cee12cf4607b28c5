# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from surveyed_room import OPTICAL_FROM_LEVEL, looking, save_room, walk

from gam_relocalizer.alignment.align import align_map
from gam_relocalizer.alignment.constraints import (
    Distance,
    Distances,
    GpsFixes,
    Level,
    Place,
    Poses,
    Positions,
)
from gam_relocalizer.alignment.geodesy import datum_of
from gam_relocalizer.errors import AlignmentError, UsageError
from gam_relocalizer.geometry import rigid3d_from_rotation, rotation_of
from gam_relocalizer.scene_map import MANIFEST, MapFrame, load_map, read_manifest, save_frame

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from surveyed_room import SurveyedRoom

DATUM = (48.1374, 11.5755, 519.0)


def triples(positions: Mapping[str, np.ndarray]) -> dict[str, tuple[float, float, float]]:
    return {name: (one[0], one[1], one[2]) for name, one in positions.items()}


def noisy_poses(
    room: SurveyedRoom, rng: np.random.Generator, metres: float = 0.02, radians: float = 0.01
) -> dict[str, pycolmap.Rigid3d]:
    poses = {}
    for name, pose in room.camera_from_world.items():
        rotation = Rotation.from_rotvec(rng.normal(0.0, radians, 3)) * rotation_of(pose)
        position = pose.tgt_origin_in_src() + rng.normal(0.0, metres, 3)
        poses[name] = rigid3d_from_rotation(rotation, -rotation.apply(position))
    return poses


def fixes_of(room: SurveyedRoom, noise: np.ndarray) -> dict[str, tuple[float, float, float]]:
    places = np.array(list(room.positions.values())) * 20.0 + noise
    wgs84 = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    fixes = np.asarray(wgs84.enu_to_ellipsoid(places, *DATUM))
    return triples(dict(zip(room.positions, fixes, strict=True)))


def distance(room: SurveyedRoom, first: int, second: int, factor: float = 1.0) -> Distance:
    names, places = list(room.positions), list(room.positions.values())
    metres = float(np.linalg.norm(places[first] - places[second])) * factor
    return Distance(Place(names[first]), Place(names[second]), metres)


def test_poses_lay_the_map_where_they_are(room: SurveyedRoom) -> None:
    report = align_map(room.path, Poses(noisy_poses(room, np.random.default_rng(0))))

    position, rotation = room.errors()
    assert position < 0.03
    assert rotation < 0.5
    assert report.frame.metric
    assert report.residual_median == pytest.approx(0.03, abs=0.015)
    assert report.residual_median_deg == pytest.approx(0.88, abs=0.4)
    assert report.findings.warnings == ()


def test_poses_of_a_straight_drive_settle_the_roll_too(corridor: SurveyedRoom) -> None:
    align_map(corridor.path, Poses(noisy_poses(corridor, np.random.default_rng(1))))

    position, rotation = corridor.errors()
    assert position < 0.04
    assert rotation < 0.7


def test_positions_of_a_straight_drive_need_the_cameras_for_the_roll(
    corridor: SurveyedRoom,
) -> None:
    rng = np.random.default_rng(2)
    positions = {name: one + rng.normal(0, 0.01, 3) for name, one in corridor.positions.items()}

    with pytest.raises(AlignmentError, match='--level'):
        align_map(corridor.path, Positions(triples(positions)))
    align_map(corridor.path, Positions(triples(positions), level=True))

    position, rotation = corridor.errors()
    assert position < 0.03
    assert rotation < 0.5


def test_positions_with_a_third_of_gross_errors_lay_the_map_right(room: SurveyedRoom) -> None:
    rng = np.random.default_rng(3)
    positions = {name: one + rng.normal(0, 0.01, 3) for name, one in room.positions.items()}
    wrong = list(positions)[::3][:6]
    for name in wrong:
        positions[name] = positions[name] + rng.uniform(1.0, 4.0, 3)

    report = align_map(room.path, Positions(triples(positions)))

    assert room.errors()[0] < 0.03
    assert {one.name for one in report.residuals if not one.inlier} == set(wrong)
    assert any('wrong place' in warning for warning in report.findings.warnings)


def test_aligning_again_starts_from_the_sfm_frame(room: SurveyedRoom) -> None:
    save_frame(room.path, MapFrame(), {})
    once = align_map(room.path, Positions(triples(room.positions)))
    twice = align_map(room.path, Positions(triples(room.positions)))

    assert room.errors()[0] < 1e-6
    assert twice.frame.scale == pytest.approx(once.frame.scale, rel=1e-9)
    assert np.allclose(twice.frame.translation, once.frame.translation)
    assert np.allclose(twice.frame.rotation_wxyz, once.frame.rotation_wxyz)


def test_gps_lays_the_map_east_north_up_of_the_datum(tmp_path: Path) -> None:
    room = save_room(tmp_path / 'map', walk(40))
    rng = np.random.default_rng(4)
    noise = rng.normal(0.0, 1.0, (40, 3)) * [0.5, 0.5, 3.0]

    report = align_map(room.path, GpsFixes(fixes_of(room, noise), DATUM, level=True))

    truth = np.array(list(room.positions.values())) * 20.0
    found = load_map(room.path).camera_positions
    assert np.abs(found - truth)[:, :2].max() < 0.8
    assert np.abs(found - truth)[:, 2].max() < 2.0
    assert report.findings.datum == DATUM
    assert read_manifest(room.path).alignment['datum'] == list(DATUM)


def test_without_a_datum_the_middle_of_the_fixes_is_the_origin(room: SurveyedRoom) -> None:
    fixes = fixes_of(room, np.zeros((len(room.positions), 3)))

    report = align_map(room.path, GpsFixes(fixes))

    middle = np.median(np.array(list(room.positions.values())) * 20.0, axis=0)
    found = load_map(room.path).camera_positions
    truth = np.array(list(room.positions.values())) * 20.0 - middle
    assert np.abs(found - truth).max() < 0.05
    assert report.findings.datum is not None


def test_the_datum_is_found_across_the_antimeridian() -> None:
    fixes = np.array([[10.0, 179.9999, 5.0], [10.0, -179.9999, 7.0], [10.0, -179.9998, 6.0]])

    _, longitude, altitude = datum_of(fixes)

    assert longitude == pytest.approx(-179.9999, abs=1e-6)
    assert altitude == 6.0


def test_distances_give_the_scale_and_leave_the_rest(room: SurveyedRoom) -> None:
    align_map(room.path, Level())
    before = load_map(room.path)

    report = align_map(room.path, Distances([distance(room, 0, 9, 1.004), distance(room, 3, 12)]))

    grown = report.frame.scale / before.manifest.frame.scale
    assert report.frame.scale == pytest.approx(room.world_from_sfm.scale, rel=0.005)
    assert np.allclose(load_map(room.path).camera_positions, grown * before.camera_positions)


def test_a_third_of_wrong_distances_does_not_change_the_scale(room: SurveyedRoom) -> None:
    good = [distance(room, first, first + 7, 1.0 + 0.002 * (first - 3)) for first in range(7)]
    bad = [distance(room, first, first + 9, 2.0) for first in range(3)]

    report = align_map(room.path, Distances([*bad, *good]))

    assert report.frame.scale == pytest.approx(room.world_from_sfm.scale, rel=0.004)
    assert report.inliers == 7


def test_distances_between_points_seen_at_pixels(room: SurveyedRoom) -> None:
    model = pycolmap.Reconstruction(room.path / 'sfm')
    image = model.image(1)
    seen = image.get_observation_points2D()
    chosen = [seen[0], seen[len(seen) // 2], seen[-1]]
    places = [Place(image.name, (one.xy[0] + 0.05, one.xy[1])) for one in chosen]
    # ids of the model rise with the rows of those points that some image sees
    rows = np.unique(load_map(room.path).observations()[1])
    points = [room.points[rows[one.point3D_id - 1]] for one in chosen]
    given = [
        Distance(places[a], places[b], float(np.linalg.norm(points[a] - points[b])))
        for a, b in ((0, 1), (1, 2), (0, 2))
    ]

    report = align_map(room.path, Distances(given))

    assert report.frame.scale == pytest.approx(room.world_from_sfm.scale, rel=1e-3)


def test_a_single_distance_is_taken_with_a_warning(room: SurveyedRoom) -> None:
    report = align_map(room.path, Distances([distance(room, 0, 9)], level=True))

    assert report.frame.scale == pytest.approx(room.world_from_sfm.scale, rel=1e-6)
    assert report.findings.scale_sigma is None
    assert any('single' in warning for warning in report.findings.warnings)


def test_a_dry_run_writes_nothing_and_finds_the_same(room: SurveyedRoom) -> None:
    save_frame(room.path, MapFrame(), {})
    before = (room.path / MANIFEST).read_bytes()

    dry = align_map(room.path, Positions(triples(room.positions)), dry_run=True)
    unchanged = (room.path / MANIFEST).read_bytes()
    wet = align_map(room.path, Positions(triples(room.positions)))

    assert unchanged == before
    assert not dry.written
    assert wet.written
    assert wet.frame == dry.frame


def test_nothing_but_the_manifest_changes(room: SurveyedRoom) -> None:
    def others() -> dict[str, bytes]:
        files = (file for file in room.path.rglob('*') if file.is_file())
        return {file.name: file.read_bytes() for file in files if file.name != MANIFEST}

    before = others()

    report = align_map(room.path, Positions(triples(room.positions)))

    assert others() == before
    assert report.map_id == read_manifest(room.path).map_id


def test_the_record_in_the_manifest_tells_how_well_it_fits(room: SurveyedRoom) -> None:
    report = align_map(room.path, Poses(noisy_poses(room, np.random.default_rng(6))))

    record = read_manifest(room.path).alignment
    assert record['method'] == 'poses'
    assert record['inliers'] == report.inliers
    assert record['residual_median'] == pytest.approx(report.residual_median)
    assert record['scale_sigma'] == pytest.approx(report.findings.scale_sigma)
    assert record['worst'][0]['name'] == report.residuals[0].name


def world_from_camera(room: SurveyedRoom) -> dict[str, pycolmap.Rigid3d]:
    return {name: pose.inverse() for name, pose in room.camera_from_world.items()}


def of_the_robot(room: SurveyedRoom) -> dict[str, pycolmap.Rigid3d]:
    turn = rigid3d_from_rotation(OPTICAL_FROM_LEVEL.inv(), np.zeros(3))
    return {name: turn * pose for name, pose in room.camera_from_world.items()}


@pytest.mark.parametrize('misunderstood', [world_from_camera, of_the_robot])
@pytest.mark.parametrize('place', ['room', 'corridor'])
def test_poses_of_another_convention_are_refused_and_nothing_is_written(
    misunderstood: object, place: str, request: pytest.FixtureRequest
) -> None:
    assert callable(misunderstood)
    given: SurveyedRoom = request.getfixturevalue(place)
    before = (given.path / MANIFEST).read_bytes()

    with pytest.raises(AlignmentError, match='orientations'):
        align_map(given.path, Poses(misunderstood(given)))

    assert (given.path / MANIFEST).read_bytes() == before


def test_left_handed_positions_in_a_plane_are_told_by_the_cameras(tmp_path: Path) -> None:
    level = {
        name: looking(pose.tgt_origin_in_src() * [1, 1, 0], yaw=index, pitch=0.2)
        for index, (name, pose) in enumerate(walk().items())
    }
    room = save_room(tmp_path / 'map', level)
    mirrored = {name: one * [1, -1, 1] for name, one in room.positions.items()}

    report = align_map(room.path, Positions(triples(mirrored)))

    assert any('left-handed' in warning for warning in report.findings.warnings)
    with pytest.raises(AlignmentError, match='mirrored'):
        align_map(room.path, Positions(triples(mirrored), level=True))


def test_names_that_are_no_images_are_told_with_examples(room: SurveyedRoom) -> None:
    others = {f'{index}.jpg': (0.0, 0.0, float(index)) for index in range(9)}

    with pytest.raises(UsageError, match=r'`0\.jpg`.*`view 00\.png`'):
        align_map(room.path, Positions(others))


def test_names_beyond_those_of_the_map_are_reported(room: SurveyedRoom) -> None:
    given = {**triples(room.positions), 'other.png': (0.0, 0.0, 0.0)}

    report = align_map(room.path, Positions(given))

    assert report.unknown == ('other.png',)
    assert room.errors()[0] < 1e-6


def test_what_does_not_fit_is_refused_and_nothing_is_written(room: SurveyedRoom) -> None:
    rng = np.random.default_rng(7)
    noise = {name: tuple(rng.uniform(-3, 3, 3)) for name in room.positions}
    disagreeing = [distance(room, 0, 9), distance(room, 3, 12, 1.3)]
    before = (room.path / MANIFEST).read_bytes()

    for constraint in (Positions(noise), Distances(disagreeing)):
        with pytest.raises(AlignmentError):
            align_map(room.path, constraint)

    assert (room.path / MANIFEST).read_bytes() == before


def test_distances_that_point_nowhere_are_refused(
    room: SurveyedRoom, corridor: SurveyedRoom
) -> None:
    known = Place('view 00.png')

    with pytest.raises(UsageError, match='no reference image'):
        align_map(room.path, Distances([Distance(known, Place('cat.png'), 1.0)]))
    with pytest.raises(UsageError, match='pixels'):
        align_map(room.path, Distances([Distance(known, Place('view 01.png', (-99, 0)), 1.0)]))
    with pytest.raises(AlignmentError, match='sfm/'):
        align_map(corridor.path, Distances([Distance(known, Place('view 01.png', (9, 9)), 1.0)]))
