# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from gam_relocalizer.geometry import rigid3d_from_rotation, rotation_of, write_poses

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

CAMERA = pycolmap.Camera(
    camera_id=1, model='SIMPLE_PINHOLE', width=384, height=288, params=[340.0, 192.0, 144.0]
)
TEXELS_PER_UNIT = 160
WALL_SIDE = 6.0


class CornerRoom:
    """Three textured planes that meet at right angles in the origin, seen from the inside."""

    def __init__(self, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self._walls = [_texture(rng) for _ in range(3)]

    def render(self, camera_from_room: pycolmap.Rigid3d) -> NDArray[np.uint8]:
        """RGB image with pixel centres at half-integers."""
        x, y = np.meshgrid(np.arange(CAMERA.width) + 0.5, np.arange(CAMERA.height) + 0.5)
        normalised = CAMERA.cam_from_img(np.stack([x.ravel(), y.ravel()], axis=1))
        rays = rotation_of(camera_from_room).inv().apply(np.c_[normalised, np.ones(x.size)])
        origin = camera_from_room.tgt_origin_in_src()
        with np.errstate(divide='ignore'):
            distances = np.where(rays < 0, -origin / rays, np.inf)
        nearest = distances.argmin(axis=1)
        hits = origin + rays * distances.min(axis=1, keepdims=True)
        image = np.zeros((x.size, 3), dtype=np.uint8)
        for axis, wall in enumerate(self._walls):
            texels = np.delete(hits, axis, axis=1).astype(np.float32) * TEXELS_PER_UNIT - 0.5
            seen = cv2.remap(
                wall, texels[:, 0].reshape(x.shape), texels[:, 1].reshape(x.shape), cv2.INTER_LINEAR
            )
            image[nearest == axis] = seen.reshape(-1, 3)[nearest == axis]
        return image.reshape(CAMERA.height, CAMERA.width, 3)


def looking_into_the_corner(step: float) -> pycolmap.Rigid3d:
    """Camera on an arc around the corner; step in [0, 1]."""
    angle = np.pi / 4 + 0.5 * (step - 0.5)
    position = np.array([3.4 * np.cos(angle), 3.4 * np.sin(angle), 1.6 + 0.5 * np.sin(9 * step)])
    forward = np.array([0.8, 0.8, 0.7 + 0.3 * step]) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return rigid3d_from_rotation(Rotation.from_matrix(rotation), -rotation @ position)


def write_room_images(folder: Path, count: int) -> dict[str, pycolmap.Rigid3d]:
    """Writes images `view 00.png`, ... and poses.txt beside the folder; returns the poses."""
    room = CornerRoom()
    folder.mkdir(parents=True)
    poses = {
        f'view {index:02d}.png': looking_into_the_corner(index / (count - 1))
        for index in range(count)
    }
    for name, camera_from_room in poses.items():
        image = cv2.cvtColor(room.render(camera_from_room), cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(folder / name), image)
    write_poses(folder.parent / 'poses.txt', poses)
    return poses


def _texture(rng: np.random.Generator) -> NDArray[np.uint8]:
    side = int(WALL_SIDE * TEXELS_PER_UNIT)
    wall = np.full((side, side, 3), 90, dtype=np.uint8)
    for _ in range(1500):
        x, y = (int(value) for value in rng.integers(0, side, 2))
        colour = tuple(int(value) for value in rng.integers(0, 256, 3))
        if rng.random() < 0.5:
            cv2.circle(wall, (x, y), int(rng.integers(4, 22)), colour, -1, cv2.LINE_AA)
        else:
            size = rng.integers(8, 50, 2)
            box = cv2.boxPoints(((x, y), size.tolist(), float(rng.uniform(0, 90))))
            cv2.fillConvexPoly(wall, box.astype(np.int32), colour, cv2.LINE_AA)
    return wall
