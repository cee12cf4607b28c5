# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from gam_relocalizer.augmentation.drawing import arrow_ends
from gam_relocalizer.augmentation.placing import AIR_COLOUR, GROUND_COLOUR, place_arrows, up_of
from gam_relocalizer.augmentation.projection import in_image, project
from gam_relocalizer.demo.recording import mapping_camera
from gam_relocalizer.errors import UsageError
from gam_relocalizer.scene_map import MapFrame, SceneMap, load_content, load_map, map_in_memory

if TYPE_CHECKING:
    from tiny_place import TinyPlace

    from gam_relocalizer.augmentation.arrows import Arrow


@pytest.fixture(scope='module')
def tiny_map(tiny_place: TinyPlace) -> SceneMap:
    return load_map(tiny_place.map_path)


def of_colour(arrows: tuple[Arrow, ...], colour: str) -> list[Arrow]:
    return [arrow for arrow in arrows if arrow.colour == colour]


def in_frame(scene_map: SceneMap, frame: MapFrame) -> SceneMap:
    manifest, content = load_content(scene_map.path)
    return map_in_memory(scene_map.path, content, replace(manifest, frame=frame))


def test_most_reference_images_show_an_arrow(tiny_map: SceneMap) -> None:
    ends, camera = arrow_ends(place_arrows(tiny_map)), mapping_camera()
    shown = [
        in_image(camera, project(camera, np.asarray(pose * ends))).any()
        for pose in tiny_map.camera_from_map
    ]
    assert np.mean(shown) > 0.8


def test_green_ones_lie_below_the_cameras_and_orange_ones_point_down_in_the_air(
    tiny_map: SceneMap,
) -> None:
    arrows = place_arrows(tiny_map)
    on_ground, in_air = of_colour(arrows, GROUND_COLOUR), of_colour(arrows, AIR_COLOUR)
    assert len(on_ground) >= 2
    assert len(in_air) >= 2
    for arrow in on_ground:
        # as low as points are seen: the bare floor of this room shows none
        assert 0.0 < arrow.tail[2] < 0.6
        assert abs(arrow.direction[2]) < 1e-6
    for arrow in in_air:
        assert arrow.tip[2] > 0.5
        np.testing.assert_allclose(arrow.direction, [0.0, 0.0, -1.0], atol=1e-6)


def test_same_map_gives_the_same_arrows(tiny_place: TinyPlace, tiny_map: SceneMap) -> None:
    assert place_arrows(tiny_map) == place_arrows(load_map(tiny_place.map_path))


def test_arrows_grow_with_a_map_that_is_not_metric(tiny_map: SceneMap) -> None:
    tenfold = in_frame(tiny_map, replace(tiny_map.manifest.frame, scale=10.0, metric=False))
    for small, large in zip(place_arrows(tiny_map), place_arrows(tenfold), strict=True):
        assert large.length == pytest.approx(10.0 * small.length, rel=1e-3)
        np.testing.assert_allclose(large.tail, 10.0 * small.tail, atol=1e-2)


def test_up_is_that_of_the_cameras_where_z_is_not(tiny_map: SceneMap) -> None:
    half = float(np.sqrt(0.5))
    lying = in_frame(tiny_map, MapFrame(rotation_wxyz=(half, half, 0.0, 0.0)))
    np.testing.assert_allclose(up_of(tiny_map), [0.0, 0.0, 1.0], atol=1e-9)
    assert up_of(lying) @ [0.0, -1.0, 0.0] > 0.95
    for arrow in of_colour(place_arrows(lying), AIR_COLOUR):
        assert np.array(arrow.direction) @ up_of(lying) == pytest.approx(-1.0, abs=1e-4)


def test_map_whose_images_see_nothing_is_refused(tiny_map: SceneMap) -> None:
    manifest, content = load_content(tiny_map.path)
    blind = replace(
        content,
        observation_offsets=np.zeros(len(content.image_names) + 1, np.int64),
        observation_points=np.empty(0, np.int32),
    )
    with pytest.raises(UsageError, match='--arrows'):
        place_arrows(map_in_memory(tiny_map.path, blind, manifest))
