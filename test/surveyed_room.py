# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""A room of points whose place in the world is known, as a map that lies in a frame of its own."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from gam_relocalizer.geometry import pose_error, rigid3d_from_rotation
from gam_relocalizer.scene_map import (
    ExtractorIdentity,
    Manifest,
    MapContent,
    MapFrame,
    load_map,
    save_map,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

CAMERA = pycolmap.Camera(
    camera_id=1,
    model='OPENCV',
    width=640,
    height=480,
    params=[500.0, 505.0, 318.0, 243.0, -0.12, 0.05, 0.001, -0.0005],
)
WORLD_FROM_SFM = pycolmap.Sim3d(
    2.7,
    pycolmap.Rotation3d(Rotation.from_euler('xyz', [0.7, -1.1, 2.0]).as_quat()),
    np.array([12.0, -3.0, 1.5]),
)
OPTICAL_FROM_LEVEL = Rotation.from_matrix([[0, -1, 0], [0, 0, -1], [1, 0, 0]])


def looking(
    position: Sequence[float], yaw: float, pitch: float = 0.0, roll: float = 0.0
) -> pycolmap.Rigid3d:
    """camera_from_world; yaw from x to y, pitch downwards, roll about the optical axis."""
    level_from_world = Rotation.from_euler('ZYX', [yaw, pitch, roll]).inv()
    rotation = OPTICAL_FROM_LEVEL * level_from_world
    return rigid3d_from_rotation(rotation, -rotation.apply(position))


def walk(count: int = 20) -> dict[str, pycolmap.Rigid3d]:
    """A loop through the room, looking about, the camera 1.2 m up give or take."""
    rng = np.random.default_rng(3)
    steps = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    return {
        f'view {index:02d}.png': looking(
            [2.0 * np.cos(step), 1.4 * np.sin(step), 1.2 + 0.15 * np.sin(3 * step)],
            yaw=step + rng.normal(0.0, 0.3),
            pitch=0.35 + rng.normal(0.0, 0.1),
            roll=rng.normal(0.0, 0.02),
        )
        for index, step in enumerate(steps)
    }


def straight_drive(count: int = 20) -> dict[str, pycolmap.Rigid3d]:
    """A robot along a corridor: all on a line, all looking ahead."""
    return {
        f'view {index:02d}.png': looking([0.25 * index - 3.0, 0.3, 0.8], yaw=0.0, pitch=0.3)
        for index in range(count)
    }


def room_points(seed: int = 0) -> np.ndarray:
    """Floor at z = 0, table, walls; 8 x 6 x 2.5 m about the origin."""
    rng = np.random.default_rng(seed)
    floor = rng.uniform([-4, -3, 0], [4, 3, 0], (1500, 3))
    table = rng.uniform([2.5, 1.5, 0.75], [3.7, 2.7, 0.75], (300, 3))
    ends = rng.uniform([-4, -3, 0], [4, 3, 2.5], (800, 3))
    ends[:, 0] = rng.choice([-4.0, 4.0], 800)
    sides = rng.uniform([-4, -3, 0], [4, 3, 2.5], (800, 3))
    sides[:, 1] = rng.choice([-3.0, 3.0], 800)
    points = np.concatenate([floor, table, ends, sides])
    return points + rng.normal(0.0, 0.005, points.shape)


@dataclass(frozen=True)
class SurveyedRoom:
    """A saved map and the truth.

    Attributes:
        path: The bundle.
        camera_from_world: By image name; world is where the map should be laid.
        points: [N,3] world.
        world_from_sfm: The truth to be found.
    """

    path: Path
    camera_from_world: Mapping[str, pycolmap.Rigid3d]
    points: np.ndarray = field(repr=False)
    world_from_sfm: pycolmap.Sim3d

    @property
    def positions(self) -> dict[str, np.ndarray]:
        return {name: pose.tgt_origin_in_src() for name, pose in self.camera_from_world.items()}

    def errors(self) -> tuple[float, float]:
        """Largest error of the map's reference images: position [m], rotation [deg]."""
        scene_map = load_map(self.path)
        errors = [
            pose_error(pose, self.camera_from_world[name])
            for name, pose in zip(scene_map.image_names, scene_map.camera_from_map, strict=True)
        ]
        return max(one.position for one in errors), max(one.rotation_deg for one in errors)


def save_room(
    path: Path,
    camera_from_world: Mapping[str, pycolmap.Rigid3d],
    points: np.ndarray | None = None,
    camera: pycolmap.Camera = CAMERA,
    *,
    with_sfm: bool = False,
) -> SurveyedRoom:
    """Saves a map that a perfect structure from motion would have made."""
    points = room_points() if points is None else points
    sfm_from_world = WORLD_FROM_SFM.inverse()
    poses = [sfm_from_world.transform_camera_world(one) for one in camera_from_world.values()]
    sfm_points = np.asarray(sfm_from_world * points)
    views = [_seen(one, points, camera) for one in camera_from_world.values()]
    seen, pixels = [rows for rows, _ in views], [places for _, places in views]
    rng = np.random.default_rng(1)
    descriptors = rng.normal(size=(len(points), 8))
    global_descriptors = rng.normal(size=(len(poses), 6)).astype(np.float32)
    content = MapContent(
        image_names=tuple(camera_from_world),
        camera_from_sfm=tuple(poses),
        points=sfm_points,
        descriptors=descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True),
        observation_offsets=np.cumsum([0, *map(len, seen)]),
        observation_points=np.concatenate(seen).astype(np.int32),
        global_descriptors=global_descriptors
        / np.linalg.norm(global_descriptors, axis=1, keepdims=True),
        codebook=np.zeros((2, 8), np.float32),
    )
    manifest = Manifest(ExtractorIdentity('synthetic', 8, ''), 'vlad', frame=MapFrame(), counts={})
    model = None
    if with_sfm:
        model = _model(list(camera_from_world), poses, sfm_points, seen, pixels, camera)
    save_map(path, content, manifest, model)
    return SurveyedRoom(path, camera_from_world, points, WORLD_FROM_SFM)


def _seen(
    camera_from_world: pycolmap.Rigid3d, points: np.ndarray, camera: pycolmap.Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the visible points, and their pixels."""
    in_camera = np.asarray(camera_from_world * points)
    ahead = (in_camera[:, 2] > 0.3) & (
        np.linalg.norm(in_camera[:, :2], axis=1) < 0.8 * in_camera[:, 2]
    )
    rows = np.flatnonzero(ahead)
    pixels = np.asarray(camera.img_from_cam(in_camera[rows])).reshape(-1, 2)
    inside = ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1)
    return rows[inside], pixels[inside]


def _model(
    names: Sequence[str],
    poses: Sequence[pycolmap.Rigid3d],
    points: np.ndarray,
    seen: Sequence[np.ndarray],
    pixels: Sequence[np.ndarray],
    camera: pycolmap.Camera,
) -> pycolmap.Reconstruction:
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    tracks: dict[int, pycolmap.Track] = {}
    for number, (name, pose) in enumerate(zip(names, poses, strict=True), start=1):
        image = pycolmap.Image(name=name, camera_id=camera.camera_id, image_id=number)
        image.points2D = pycolmap.Point2DList(
            [pycolmap.Point2D(pixel) for pixel in pixels[number - 1]]
        )
        model.add_image_with_trivial_frame(image, pose)
        for index, row in enumerate(seen[number - 1]):
            tracks.setdefault(int(row), pycolmap.Track()).add_element(number, index)
    for row in sorted(tracks):
        model.add_point3D(points[row], tracks[row], np.zeros(3, np.uint8))
    return model


MARKER_BITS = 40
FINE = 3


def draw_marker_images(
    folder: Path,
    camera_from_world: Mapping[str, pycolmap.Rigid3d],
    prints: Sequence[tuple[int, pycolmap.Rigid3d, float]],
) -> None:
    """Draws what `CAMERA` sees of printed markers before a grey nothing, distortion included.

    Args:
        folder: Where to.
        camera_from_world: By name.
        prints: Id, world_from_marker (x right, y top, z out of the print) and side.
    """
    folder.mkdir(parents=True)
    for name, pose in camera_from_world.items():
        image = np.full((FINE * CAMERA.height, FINE * CAMERA.width), 128, np.uint8)
        for marker, world_from_marker, side in prints:
            _draw_print(image, pose * world_from_marker, side, marker)
        small = cv2.resize(image, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(folder / name), small)


def _draw_print(
    image: np.ndarray, camera_from_marker: pycolmap.Rigid3d, side: float, marker: int
) -> None:
    """Draws the print, with a white margin of a sixth of its side."""
    half = side * 4 / 6
    outline = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
    in_camera = np.asarray(camera_from_marker * outline)
    marker_from_camera = camera_from_marker.inverse()
    origin = np.asarray(marker_from_camera.translation)
    if origin[2] <= 0.0 or (in_camera[:, 2] < 0.3).any():
        return
    outer = FINE * np.asarray(CAMERA.img_from_cam(in_camera))
    left, top = np.maximum(outer.min(axis=0).astype(int) - 8, 0)
    right, bottom = np.minimum(outer.max(axis=0).astype(int) + 8, image.shape[::-1])
    if left >= right or top >= bottom:
        return
    x, y = np.meshgrid(np.arange(left, right) + 0.5, np.arange(top, bottom) + 0.5)
    plane = np.asarray(CAMERA.cam_from_img(np.stack([x.ravel(), y.ravel()], axis=1) / FINE))
    directions = np.c_[plane, np.ones(len(plane))] @ marker_from_camera.rotation.matrix().T
    hits = origin - directions * (origin[2] / directions[:, 2])[:, None]
    inside = np.abs(hits[:, :2]).max(axis=1).reshape(x.shape) < half
    inner = 6 * MARKER_BITS
    texture = np.full((8 * MARKER_BITS, 8 * MARKER_BITS), 255, np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    texture[MARKER_BITS:-MARKER_BITS, MARKER_BITS:-MARKER_BITS] = dictionary.generateImageMarker(
        marker, inner
    )
    columns, rows = (
        (sign * hits[:, axis] / side * inner + 4 * MARKER_BITS - 0.5)
        .astype(np.float32)
        .reshape(x.shape)
        for axis, sign in ((0, 1.0), (1, -1.0))
    )
    drawn = cv2.remap(texture, columns, rows, cv2.INTER_LINEAR)
    image[top:bottom, left:right][inside] = drawn[inside]
