# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Maps from images of strongly distorted cameras, and queries to them: all of it on pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from gam_relocalizer.cameras import PIXEL_CENTRE, have_known_rays, undistort
from gam_relocalizer.demo import trajectories
from gam_relocalizer.demo.recording import drive_appearance, mapping_appearance
from gam_relocalizer.demo.renderer import Renderer
from gam_relocalizer.demo.world import tiny_world
from gam_relocalizer.geometry import pose_error, rigid3d_from_rotation
from gam_relocalizer.image_set import ImageSet
from gam_relocalizer.localization.localizer import Localizer, LocalizerOptions
from gam_relocalizer.mapping.build import MapBuildOptions, build_map

if TYPE_CHECKING:
    from pathlib import Path

    from gam_relocalizer.demo.world import World

# 150 degrees from left to right; its corners are dark, for they are beyond what `undistort` knows.
FISHEYE = pycolmap.Camera(
    camera_id=1,
    model='OPENCV_FISHEYE',
    width=640,
    height=400,
    params=[240, 241, 322, 198, 0.03, -0.012, 0.004, -0.001],
)
BARREL = pycolmap.Camera(
    camera_id=1,
    model='OPENCV',
    width=640,
    height=480,
    params=[440, 442, 317, 243, -0.25, 0.05, 0.0005, -0.0003],
)
KEYPOINTS = 1500
QUERY_TIMES = (1.0, 4.0, 7.0, 10.0)


@dataclass(frozen=True)
class Room:
    """A world, and its renderers without vignetting: sides have no dark corners of their own."""

    world: World
    by_day: Renderer
    in_the_evening: Renderer


@pytest.fixture(scope='module')
def room() -> Room:
    world = tiny_world()
    looks = (mapping_appearance(world), drive_appearance(world))
    return Room(world, *(Renderer(world, replace(look, vignetting=0.0)) for look in looks))


@dataclass(frozen=True)
class Side:
    """A pinhole, which pixels [H,W] of the distorted image it shows, and where it sees them."""

    pinhole: pycolmap.Camera
    pinhole_from_camera: pycolmap.Rigid3d
    shown: np.ndarray
    places: np.ndarray


def side_of(
    turn: Rotation, in_pinhole: np.ndarray, shown: np.ndarray, camera: pycolmap.Camera
) -> Side:
    """A pinhole just large enough for the rays [H*W,3] that it is to show."""
    focal = camera.mean_focal_length()
    pixels = np.full((len(in_pinhole), 2), -1.0)
    pixels[shown] = focal * in_pinhole[shown, :2] / in_pinhole[shown, 2:]
    corner = np.floor(pixels[shown].min(axis=0)) - 1.0
    width, height = np.ceil(pixels[shown].max(axis=0) - corner).astype(int) + 1
    pinhole = pycolmap.Camera(
        camera_id=1, model='PINHOLE', width=width, height=height, params=[focal, focal, *-corner]
    )
    shape = (camera.height, camera.width)
    places = np.where(shown[:, None], pixels - corner - PIXEL_CENTRE, -1.0).astype(np.float32)
    return Side(
        pinhole,
        rigid3d_from_rotation(turn, np.zeros(3)),
        shown.reshape(shape),
        places.reshape(*shape, 2),
    )


class DistortingRenderer:
    """Looks through a distorted camera: warps what pinholes see, each turned to another side."""

    def __init__(
        self, renderer: Renderer, camera: pycolmap.Camera, yaws: tuple[float, ...]
    ) -> None:
        self._renderer, self._camera = renderer, camera
        width, height = camera.width, camera.height
        columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        rays = undistort(np.column_stack([columns.ravel(), rows.ravel()]), camera)
        rays = np.column_stack([rays, np.ones(len(rays))])
        turns = Rotation.from_euler('y', np.reshape(yaws, (-1, 1)), degrees=True).inv()
        in_pinholes = np.stack([turn.apply(rays) for turn in turns])
        nearest_side = np.argmax(in_pinholes[..., 2], axis=0)
        known = np.isfinite(rays).all(axis=1)
        self._sides = [
            side_of(turn, in_pinhole, known & (nearest_side == index), camera)
            for index, (turn, in_pinhole) in enumerate(zip(turns, in_pinholes, strict=True))
        ]

    def render(self, camera_from_map: pycolmap.Rigid3d, seed: int) -> np.ndarray:
        image = np.zeros((self._camera.height, self._camera.width, 3), np.uint8)
        for side in self._sides:
            pose = side.pinhole_from_camera * camera_from_map
            seen = self._renderer.render(side.pinhole, [pose], seed)
            warped = cv2.remap(seen, side.places, None, cv2.INTER_LINEAR)
            image[side.shown] = warped[side.shown]
        return image


@pytest.mark.parametrize(
    ('camera', 'yaws'),
    [(FISHEYE, (-55.0, 0.0, 55.0)), (BARREL, (0.0,))],
    ids=['fisheye', 'barrel'],
)
def test_a_map_by_a_distorted_camera_localizes_its_images(
    camera: pycolmap.Camera, yaws: tuple[float, ...], room: Room, tmp_path: Path
) -> None:
    mapping = DistortingRenderer(room.by_day, camera, yaws)
    views = trajectories.mapping_views(room.world.mapping_route, spacing=1.0)
    poses = {f'{index:02}.png': view for index, view in enumerate(views)}
    (tmp_path / 'images').mkdir()
    for index, (name, view) in enumerate(poses.items()):
        image = mapping.render(view, index)
        cv2.imwrite(str(tmp_path / 'images' / name), image[..., ::-1])
    images = ImageSet.of_folder(tmp_path / 'images', camera, poses)
    report = build_map(images, tmp_path / 'map', MapBuildOptions(max_keypoints=KEYPOINTS))
    assert report.images_registered >= 0.8 * len(views)

    driving = DistortingRenderer(room.in_the_evening, camera, yaws)
    drive = trajectories.drive(room.world.drive_route)
    localizer = Localizer.load(tmp_path / 'map', LocalizerOptions(max_keypoints=KEYPOINTS))
    for seed, t in enumerate(QUERY_TIMES):
        truth = drive.camera_from_map(t)
        result = localizer.localize(driving.render(truth, seed), camera)
        assert result.accepted, result.reason
        error = pose_error(result.estimate.camera_from_map, truth)
        assert error.position < 0.05
        assert error.rotation_deg < 1.0
        assert have_known_rays(result.estimate.inlier_keypoints, camera).all()
