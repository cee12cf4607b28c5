# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest

from gam_relocalizer.demo.recording import mapping_appearance
from gam_relocalizer.demo.renderer import Renderer
from gam_relocalizer.demo.trajectories import mapping_views
from gam_relocalizer.demo.world import tiny_world
from gam_relocalizer.errors import MapBuildError
from gam_relocalizer.evaluation.exact_map import KnownImage, save_exact_map
from gam_relocalizer.features.registry import create_extractor
from gam_relocalizer.geometry import pose_error
from gam_relocalizer.localization.localizer import Localizer
from gam_relocalizer.matching.registry import create_matcher
from gam_relocalizer.scene_map import load_map

if TYPE_CHECKING:
    from pathlib import Path

    from gam_relocalizer.features.local import LocalExtractor
    from gam_relocalizer.scene_map import SceneMap

CAMERA = pycolmap.Camera(
    camera_id=1, model='PINHOLE', width=480, height=360, params=[322.0, 322.0, 241.0, 178.5]
)


@pytest.fixture(scope='module')
def extractor() -> LocalExtractor:
    return create_extractor('xfeat', 1024)


@pytest.fixture(scope='module')
def images() -> list[KnownImage]:
    world = tiny_world()
    renderer = Renderer(world, mapping_appearance(world))
    views = mapping_views(world.mapping_route, spacing=0.6)[:12]
    return [
        KnownImage(renderer.render(CAMERA, [view], seed), renderer.depth(CAMERA, view), view)
        for seed, view in enumerate(views)
    ]


@pytest.fixture(scope='module')
def scene_map(
    images: list[KnownImage], extractor: LocalExtractor, tmp_path_factory: pytest.TempPathFactory
) -> SceneMap:
    path = tmp_path_factory.mktemp('exact') / 'map'
    save_exact_map(path, images, CAMERA, extractor)
    return load_map(path)


def test_points_lie_on_the_surfaces_that_their_images_see(
    scene_map: SceneMap, images: list[KnownImage]
) -> None:
    for index, name in enumerate(scene_map.image_names):
        one = images[int(name[:4])]
        in_camera = one.camera_from_map * scene_map.points[scene_map.points_seen_by(index)]
        pixels = np.floor(CAMERA.img_from_cam(in_camera)).astype(int)
        inside = np.all((pixels >= 0) & (pixels < (480, 360)), axis=1)
        assert inside.mean() > 0.95
        depth = one.depth[pixels[inside, 1], pixels[inside, 0]]
        assert np.quantile(np.abs(depth - in_camera[inside, 2]), 0.9) < 0.03


def test_every_point_is_seen_by_two_images_or_more(scene_map: SceneMap) -> None:
    assert len(scene_map.points) > 300
    seen = np.bincount(scene_map.observations()[1], minlength=scene_map.num_points)
    assert seen.min() >= 2


def test_poses_are_those_given(scene_map: SceneMap, images: list[KnownImage]) -> None:
    assert scene_map.manifest.frame.metric
    assert scene_map.num_images > 5
    for pose, name in zip(scene_map.camera_from_map, scene_map.image_names, strict=True):
        assert pose_error(pose, images[int(name[:4])].camera_from_map).position < 1e-9


def test_its_own_images_are_localized(
    scene_map: SceneMap, images: list[KnownImage], extractor: LocalExtractor
) -> None:
    localizer = Localizer(scene_map, extractor, create_matcher('gam', extractor='xfeat'))
    errors = []
    for name in scene_map.image_names[::3]:
        one = images[int(name[:4])]
        result = localizer.localize(one.image, CAMERA)
        assert result.estimate is not None
        errors.append(pose_error(result.estimate.camera_from_map, one.camera_from_map))
    assert max(error.position for error in errors) < 0.05


def test_images_that_share_nothing_make_no_map(
    images: list[KnownImage], extractor: LocalExtractor, tmp_path: Path
) -> None:
    nowhere = replace(images[0], depth=np.full_like(images[0].depth, np.inf))
    for given in ([images[0]], [images[0], nowhere]):
        with pytest.raises(MapBuildError):
            save_exact_map(tmp_path / 'map', given, CAMERA, extractor)
