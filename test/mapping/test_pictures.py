# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of a map and of how well it works."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from gam_relocalizer.errors import UsageError
from gam_relocalizer.mapping.check import check_map
from gam_relocalizer.mapping.coverage import (
    Coverage,
    LeftOut,
    Standing,
    Surroundings,
    Tolerance,
    weak_spots,
)
from gam_relocalizer.mapping.pictures import (
    BUILD_REPORT,
    GRAPH,
    SIDE,
    TOP,
    coverage_figure,
    covisibility_figure,
    write_build_report,
)
from gam_relocalizer.plots import View, png
from gam_relocalizer.scene_map import load_map

if TYPE_CHECKING:
    from pathlib import Path

    from conftest import BuiltMap
    from matplotlib.figure import Figure

    from gam_relocalizer.scene_map import SceneMap


@pytest.fixture(scope='module')
def scene_map(posed_map: BuiltMap) -> SceneMap:
    return load_map(posed_map.path)


def coverage_of(scene_map: SceneMap, standings: dict[int, Standing]) -> Coverage:
    """All images found with 200 inliers, but for some."""
    surroundings = Surroundings.of(scene_map)
    images = [
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
    spots = weak_spots(images, range(len(images)), surroundings)
    return Coverage(tuple(images), Tolerance(0.25), 'm', spots, 1.0)


def heat_at(figure: Figure, place: np.ndarray) -> np.ndarray:
    """Colour [4] of the heat map at a place of the picture."""
    axes = figure.axes[0]
    (image,) = axes.images
    colours, (left, right, bottom, top) = np.asarray(image.get_array()), image.get_extent()
    rows, columns = colours.shape[:2]
    row = int((place[1] - bottom) / (top - bottom) * rows)
    return colours[row, int((place[0] - left) / (right - left) * columns)]


def test_build_report_holds_the_pictures_and_the_numbers(
    posed_map: BuiltMap, tmp_path: Path
) -> None:
    write_build_report(posed_map.path, posed_map.report, tmp_path / 'report')

    assert sorted(file.name for file in (tmp_path / 'report').iterdir()) == sorted(
        [TOP, SIDE, GRAPH, BUILD_REPORT]
    )
    for name in (TOP, SIDE, GRAPH):
        image = cv2.imread(str(tmp_path / 'report' / name))
        height, width = image.shape[:2]
        assert min(height, width) > 500
        assert image.std() > 5
    written = json.loads((tmp_path / 'report' / BUILD_REPORT).read_text())
    assert written['points'] == posed_map.report.points
    assert written['map_id'] == load_map(posed_map.path).manifest.map_id


def test_build_report_leaves_the_map_as_it_is(posed_map: BuiltMap, tmp_path: Path) -> None:
    before = {file: file.read_bytes() for file in posed_map.path.rglob('*') if file.is_file()}

    write_build_report(posed_map.path, posed_map.report, tmp_path / 'report')

    assert before == {
        file: file.read_bytes() for file in posed_map.path.rglob('*') if file.is_file()
    }
    assert check_map(posed_map.path).warnings == ()


def test_build_report_replaces_an_earlier_one_with_the_same(
    posed_map: BuiltMap, tmp_path: Path
) -> None:
    write_build_report(posed_map.path, posed_map.report, tmp_path)
    first = {file.name: file.read_bytes() for file in tmp_path.iterdir()}

    write_build_report(posed_map.path, posed_map.report, tmp_path)

    assert first == {file.name: file.read_bytes() for file in tmp_path.iterdir()}


@pytest.mark.parametrize('name', ['holiday.txt', BUILD_REPORT])
def test_build_report_touches_no_folder_of_somebody_else(
    posed_map: BuiltMap, tmp_path: Path, name: str
) -> None:
    (tmp_path / name).write_text('{}')

    with pytest.raises(UsageError):
        write_build_report(posed_map.path, posed_map.report, tmp_path)

    assert [file.name for file in tmp_path.iterdir()] == [name]


def test_covisibility_has_a_line_for_each_pair_and_a_dot_for_each_image(
    scene_map: SceneMap,
) -> None:
    axes = covisibility_figure(scene_map).axes[0]

    shared = scene_map.covisibility.toarray()
    pairs = np.argwhere(np.triu(shared >= 20, k=1))
    lines = next(one for one in axes.collections if hasattr(one, 'get_segments')).get_segments()
    cameras = View.from_above(scene_map).of(scene_map.camera_positions)
    expected = {tuple(np.round(cameras[pair].ravel(), 6)) for pair in pairs}
    assert {tuple(np.round(np.ravel(line), 6)) for line in lines} == expected
    sizes = [one.get_array() for one in axes.collections if one.get_array() is not None]
    assert any(np.array_equal(size, scene_map.num_points_seen) for size in sizes)


def test_heat_is_red_where_images_were_not_found_and_blue_where_they_were(
    scene_map: SceneMap,
) -> None:
    figure = coverage_figure(scene_map, coverage_of(scene_map, {7: Standing.REFUSED}))

    cameras = View.from_above(scene_map).of(scene_map.camera_positions)
    (red, _, blue, alpha) = heat_at(figure, cameras[7])
    assert red > blue
    assert alpha > 0.4
    (red, _, blue, alpha) = heat_at(figure, cameras[0])
    assert blue > red
    assert alpha > 0.4


def test_heat_is_nothing_where_no_image_was_taken(scene_map: SceneMap) -> None:
    figure = coverage_figure(scene_map, coverage_of(scene_map, {}))

    assert heat_at(figure, np.array([0.1, 0.1]))[3] < 0.05


def test_numbers_of_weak_spots_do_not_lie_upon_each_other(scene_map: SceneMap) -> None:
    standings = {2: Standing.REFUSED, 3: Standing.WRONG, 4: Standing.WEAK, 5: Standing.REFUSED}

    figure = coverage_figure(scene_map, coverage_of(scene_map, standings))

    figure.canvas.draw()
    boxes = [text.get_window_extent() for text in figure.axes[0].texts]
    assert len(boxes) == len(coverage_of(scene_map, standings).weak_spots) >= 3
    for index, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[:index])


def test_pictures_of_the_same_are_the_same_bytes(scene_map: SceneMap) -> None:
    coverage = coverage_of(scene_map, {1: Standing.REFUSED})

    assert png(coverage_figure(scene_map, coverage)) == png(coverage_figure(scene_map, coverage))


def test_a_map_without_metres_is_drawn_in_map_units(scene_map: SceneMap) -> None:
    frame = replace(scene_map.manifest.frame, metric=False)
    unscaled = replace(scene_map, manifest=replace(scene_map.manifest, frame=frame))

    assert covisibility_figure(unscaled).axes[0].get_xlabel() == 'x [map units]'
    assert covisibility_figure(scene_map).axes[0].get_xlabel() == 'x [m]'
