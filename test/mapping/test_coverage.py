# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What became of images that were left out, and where the weak spots are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gam_relocalizer.geometry import PoseError, rigid3d_from_rotation
from gam_relocalizer.localization.result import LocalizationResult, Status
from gam_relocalizer.mapping.coverage import (
    Coverage,
    LeftOut,
    Standing,
    Surroundings,
    Tolerance,
    standing_of,
    tolerance_of,
    weak_spots,
)
from gam_relocalizer.scene_map import (
    ExtractorIdentity,
    Manifest,
    MapContent,
    MapFrame,
    SceneMap,
    map_in_memory,
)

MANIFEST = Manifest(ExtractorIdentity('xfeat', 4, ''), 'vlad', MapFrame(metric=True), {})
ALONG_X, ALONG_Y = 0.0, 90.0


def map_of(places: list[tuple[float, float, float]], *, scale: float = 1.0) -> SceneMap:
    """Images at x, y that look into a direction [deg], each at a wall of 40 points 5 m ahead."""
    poses, points = [], []
    rng = np.random.default_rng(0)
    for x, y, heading in places:
        ahead = Rotation.from_euler('z', heading, degrees=True)
        map_from_camera = ahead * Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
        position = scale * np.array([x, y, 1.0])
        poses.append(rigid3d_from_rotation(map_from_camera, position).inverse())
        wall = np.c_[np.full(40, 5.0), rng.uniform(-2, 2, (40, 2))]
        points.append(position + scale * ahead.apply(wall))
    content = MapContent(
        image_names=tuple(f'{index}.png' for index in range(len(places))),
        camera_from_sfm=tuple(poses),
        points=np.concatenate(points),
        descriptors=np.ones((40 * len(places), 4)),
        observation_offsets=40 * np.arange(len(places) + 1),
        observation_points=np.arange(40 * len(places), dtype=np.int32),
        global_descriptors=np.ones((len(places), 4), np.float32),
        codebook=np.ones((1, 4), np.float32),
    )
    return map_in_memory(Path('map'), content, MANIFEST)


def left_out(scene_map: SceneMap, standings: dict[int, Standing]) -> list[LeftOut]:
    """Images of a map, all found but for some."""
    surroundings = Surroundings.of(scene_map)
    return [
        LeftOut(
            name=name,
            standing=standings.get(image, Standing.FOUND),
            status='ACCEPTED',
            reason='',
            position=tuple(surroundings.positions[image].tolist()),
            direction=tuple(surroundings.directions[image].tolist()),
            position_error=0.0,
            rotation_error_deg=0.0,
            inliers=200,
            confidence=1.0,
            neighbours=5,
            nearest=surroundings.nearest(image),
        )
        for image, name in enumerate(scene_map.image_names)
    ]


def spots_of(scene_map: SceneMap, standings: dict[int, Standing]) -> list[tuple[str, ...]]:
    images = left_out(scene_map, standings)
    spots = weak_spots(images, range(len(images)), Surroundings.of(scene_map))
    return [spot.images for spot in spots]


CORRIDOR = [(0.5 * step, 0.0, ALONG_X) for step in range(20)]


def test_a_map_that_does_has_no_weak_spots() -> None:
    assert spots_of(map_of(CORRIDOR), {}) == []


def test_neighbours_make_one_spot_and_others_another() -> None:
    lost = dict.fromkeys([2, 3, 4, 15], Standing.REFUSED)

    assert spots_of(map_of(CORRIDOR), lost) == [('2.png', '3.png', '4.png'), ('15.png',)]


def test_what_is_worst_comes_first() -> None:
    standings = {1: Standing.WEAK, 2: Standing.WEAK, 9: Standing.REFUSED, 18: Standing.WRONG}

    assert spots_of(map_of(CORRIDOR), standings) == [('18.png',), ('9.png',), ('1.png', '2.png')]


def test_images_at_one_place_that_look_elsewhere_are_another_spot() -> None:
    places = [*CORRIDOR, *((x, y, ALONG_Y) for x, y, _ in CORRIDOR)]
    lost = dict.fromkeys([5, 25], Standing.REFUSED)

    assert spots_of(map_of(places), lost) == [('5.png',), ('25.png',)]


def test_a_spot_is_named_by_its_middle_and_knows_the_next_image_beyond() -> None:
    scene_map = map_of(CORRIDOR)
    images = left_out(scene_map, dict.fromkeys([0, 1, 2], Standing.REFUSED))

    (spot,) = weak_spots(images, range(len(images)), Surroundings.of(scene_map))

    assert spot.around == '1.png'
    assert spot.position == pytest.approx((0.5, 0.0, 1.0))
    assert spot.nearest == pytest.approx(0.5)
    assert '3 images around `1.png` at (0.5, 0.0, 1.0): not found' in spot.text('m')


def test_an_image_that_looks_like_no_other_has_no_nearest() -> None:
    surroundings = Surroundings.of(map_of([*CORRIDOR, (2.0, 0.0, ALONG_Y)]))

    assert surroundings.nearest(20) is None
    assert surroundings.nearest(4) == pytest.approx(0.5)


def test_images_that_share_too_few_points_are_no_neighbours() -> None:
    assert Surroundings.of(map_of(CORRIDOR)).neighbours.tolist() == [0] * 20


def test_places_are_those_of_the_map_when_some_images_were_tried() -> None:
    scene_map = map_of(CORRIDOR)
    images = left_out(scene_map, {18: Standing.REFUSED})[::3]

    spots = weak_spots(images, range(0, 20, 3), Surroundings.of(scene_map))

    assert [spot.images for spot in spots] == [('18.png',)]
    assert spots[0].nearest == pytest.approx(0.5)


ACCEPTED = LocalizationResult(Status.ACCEPTED)


@pytest.mark.parametrize(
    ('result', 'error', 'expected'),
    [
        (ACCEPTED, PoseError(0.3, 0.0), Standing.WRONG),
        (ACCEPTED, PoseError(0.0, 2.1), Standing.WRONG),
        (ACCEPTED, PoseError(0.2, 1.9), Standing.WEAK),  # without any inlier
        (LocalizationResult(Status.AMBIGUOUS), PoseError(0.0, 0.0), Standing.REFUSED),
        (LocalizationResult(Status.NO_POSE), None, Standing.REFUSED),
    ],
)
def test_standing_follows_the_verdict_and_the_error(
    result: LocalizationResult, error: PoseError | None, expected: Standing
) -> None:
    assert standing_of(result, error, Tolerance(0.25), neighbours=9) is expected


@given(st.floats(1e-3, 1e3))
def test_tolerance_of_a_map_without_metres_goes_with_its_scale(scale: float) -> None:
    scaled = map_of(CORRIDOR, scale=scale)
    unscaled = replace(scaled, manifest=replace(scaled.manifest, frame=MapFrame()))

    assert tolerance_of(unscaled).position == pytest.approx(0.25 * scale, rel=1e-3)
    assert tolerance_of(scaled).position == 0.25


def test_recall_counts_what_was_found_however_barely() -> None:
    scene_map = map_of(CORRIDOR)
    standings = {0: Standing.WEAK, 1: Standing.REFUSED, 2: Standing.WRONG}
    coverage = Coverage(tuple(left_out(scene_map, standings)), Tolerance(0.25), 'm', (), 1.0)

    assert coverage.recall == pytest.approx(18 / 20)
