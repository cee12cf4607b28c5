# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Queries and maps that try to make the localizer accept a wrong pose.

An adversary spoils a view and says what is true of the result: the pose that is still right, or
that no pose is. A wrong pose that is accepted is the one error that a robot cannot mend.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from gam_relocalizer.cameras import PIXEL_CENTRE
from gam_relocalizer.evaluation.metrics import Threshold
from gam_relocalizer.geometry import pose_error, rigid3d_from_rotation

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from gam_relocalizer.scene_map import SceneMap

    Image = NDArray[np.uint8]

FALSE_BEYOND = Threshold(1.0, 10.0)
"""An accepted pose further than this from the truth is a false accept [m, deg]."""
METRE_PER_DISTANCE = 0.2
"""Stands for a metre where a map has none, per median distance of what its cameras see."""

WINDOW_SHARE = 0.1
FOCAL_FACTOR = 1.2
BLACK, WHITE = 0, 255
NOISE_GRAINS_PX = (1, 2, 4, 8)
TEXTURE_CELLS_PX = (3, 8, 24, 72)
# A print seen straight on, and as large as it was taken, is the view itself: nobody could tell.
PHOTOGRAPH_TILT_DEG = (25.0, 40.0)
POSTER_TILT_DEG = (0.0, 30.0)
POSTER_SIZE = (0.45, 0.75)
_LARGEST_PRINT = 4.0
# Tangential and thin-prism terms are even in the image coordinates: half a turn flips their sign.
_EVEN_DISTORTION = ('p0', 'p1', 'p2', 's0', 's1', 's2', 's3', 'sx1', 'sy1')


@dataclass(frozen=True)
class View:
    """A query and what is true of it.

    Attributes:
        image: RGB [H,W,3] or grey [H,W].
        camera: What the localizer is told of the camera.
        camera_from_map: The truth; none where every pose is wrong.
    """

    image: Image
    camera: pycolmap.Camera
    camera_from_map: pycolmap.Rigid3d | None


def is_false_accept(
    accepted: pycolmap.Rigid3d, truth: pycolmap.Rigid3d | None, metre: float
) -> bool:
    """Whether an accepted `camera_from_map` is wrong: no pose is right, or it is too far off.

    Args:
        accepted: The pose that the localizer stands for.
        truth: The right one, if there is one.
        metre: `metre_of` the map.
    """
    if truth is None:
        return True
    error = pose_error(accepted, truth)
    return not FALSE_BEYOND.admits(replace(error, position=error.position / metre))


def metre_of(scene_map: SceneMap, *, metric: bool) -> float:
    """Length of a metre in map units, or of what stands for it in a map without scale.

    Rooms are seen from about five metres, so a fifth of the median distance stands for a metre.
    """
    if metric:
        return 1.0
    distances = [
        np.linalg.norm(pose * scene_map.positions_of(scene_map.points_seen_by(image)), axis=1)
        for image, pose in enumerate(scene_map.camera_from_map)
    ]
    return METRE_PER_DISTANCE * float(np.median(np.concatenate(distances)))


def black(view: View, _: np.random.Generator) -> View:
    """The lens cap is on."""
    return _of_nowhere(view, np.full_like(view.image, BLACK))


def white(view: View, _: np.random.Generator) -> View:
    """The sun shines into the lens."""
    return _of_nowhere(view, np.full_like(view.image, WHITE))


def noise(view: View, rng: np.random.Generator) -> View:
    """Independent grains of random values, from one to eight pixels wide."""
    return _of_nowhere(view, _grains(rng, view.image.shape, int(rng.choice(NOISE_GRAINS_PX))))


def mirrored(view: View, _: np.random.Generator) -> View:
    """Left and right exchanged, as in a looking glass: no camera pose shows that."""
    return _of_nowhere(view, np.ascontiguousarray(view.image[:, ::-1]))


def upside_down(view: View, _: np.random.Generator) -> View:
    """The camera hangs upside down: what it sees is true, rolled by half a turn."""
    camera = view.camera
    names = camera.params_info.split(', ')
    params = np.where(np.isin(names, _EVEN_DISTORTION), -camera.params, camera.params)
    centre = list(camera.principal_point_idxs())
    params[centre] = np.array([camera.width, camera.height]) - params[centre]
    half_turn = rigid3d_from_rotation(Rotation.from_euler('z', 180.0, degrees=True), np.zeros(3))
    truth = None if view.camera_from_map is None else half_turn * view.camera_from_map
    return View(np.ascontiguousarray(view.image[::-1, ::-1]), _with_params(camera, params), truth)


def scrambled(view: View, rng: np.random.Generator) -> View:
    """Tiles of the image, three to eight along each side, none of them at its place."""
    rows, columns = (int(count) for count in rng.integers(3, 9, 2))
    height, width = view.image.shape[0] // rows, view.image.shape[1] // columns
    corners = [(height * row, width * column) for row in range(rows) for column in range(columns)]
    image = np.zeros_like(view.image)
    order = rng.permutation(len(corners))
    for to, of in pairwise([*order, order[0]]):
        (y, x), (from_y, from_x) = corners[to], corners[of]
        tile = view.image[from_y : from_y + height, from_x : from_x + width]
        image[y : y + height, x : x + width] = tile
    return _of_nowhere(view, image)


def occluded(view: View, rng: np.random.Generator) -> View:
    """A textured thing covers 90 % of the view; the truth can be seen through one window."""
    height, width = view.image.shape[:2]
    stretch = np.sqrt(rng.uniform(0.4, 2.5))
    tall = round(height * np.sqrt(WINDOW_SHARE) / stretch)
    wide = round(width * np.sqrt(WINDOW_SHARE) * stretch)
    y, x = int(rng.integers(height - tall + 1)), int(rng.integers(width - wide + 1))
    image = _texture(rng, view.image.shape)
    image[y : y + tall, x : x + wide] = view.image[y : y + tall, x : x + wide]
    return replace(view, image=image)


def photograph(view: View, rng: np.random.Generator) -> View:
    """Somebody holds a photograph of the place in front of the camera, tilted; it fills the view.

    What the picture shows is where the photographer stood, not the camera.
    """
    tilt = _tilt(rng, PHOTOGRAPH_TILT_DEG)
    # The homography is that of a plane, so its corners decide whether the print fills the view.
    sizes = np.linspace(1.0, _LARGEST_PRINT, 61)
    size = next((s for s in sizes if _fills_view(view, tilt, s)), _LARGEST_PRINT)
    return _of_nowhere(view, _print_of(view, tilt, size))


def poster(view: View, rng: np.random.Generator) -> View:
    """A print of the place hangs on a bare wall somewhere, and is all there is to see."""
    return _of_nowhere(
        view, _print_of(view, _tilt(rng, POSTER_TILT_DEG), rng.uniform(*POSTER_SIZE))
    )


def focal_length_too_long(view: View, _: np.random.Generator) -> View:
    """The calibration is that of a lens with a focal length 20 % longer."""
    return replace(view, camera=_zoomed(view.camera, FOCAL_FACTOR))


def focal_length_too_short(view: View, _: np.random.Generator) -> View:
    """The calibration is that of a lens with a focal length shorter by the same factor."""
    return replace(view, camera=_zoomed(view.camera, 1.0 / FOCAL_FACTOR))


ADVERSARIES: Mapping[str, Callable[[View, np.random.Generator], View]] = {
    'black': black,
    'white': white,
    'noise': noise,
    'mirrored': mirrored,
    'upside-down': upside_down,
    'scrambled': scrambled,
    'occluded': occluded,
    'photograph': photograph,
    'poster': poster,
    'focal-length-too-long': focal_length_too_long,
    'focal-length-too-short': focal_length_too_short,
}
"""What can be done to any view, by name."""


def another_building(view: View) -> View:
    """The view as a query to the map of another place: there is no right pose."""
    return replace(view, camera_from_map=None)


def with_mixed_up_descriptors(scene_map: SceneMap, rng: np.random.Generator) -> SceneMap:
    """The map with its descriptors handed out to the wrong points; retrieval still works."""
    order, stored = rng.permutation(scene_map.num_points), scene_map.stored
    return replace(scene_map, stored=replace(stored, descriptors=stored.descriptors[order]))


def _of_nowhere(view: View, image: Image) -> View:
    return View(image, view.camera, None)


def _zoomed(camera: pycolmap.Camera, factor: float) -> pycolmap.Camera:
    params = np.array(camera.params)
    params[list(camera.focal_length_idxs())] *= factor
    return _with_params(camera, params)


def _with_params(camera: pycolmap.Camera, params: NDArray[np.float64]) -> pycolmap.Camera:
    return pycolmap.Camera(
        camera_id=camera.camera_id,
        model=camera.model_name,
        width=camera.width,
        height=camera.height,
        params=params,
    )


def _grains(rng: np.random.Generator, shape: tuple[int, ...], grain: int) -> Image:
    """Random values, each on a square of `grain` pixels."""
    height, width = (-(-side // grain) for side in shape[:2])
    values = rng.integers(0, 256, (height, width, *shape[2:]), dtype=np.uint8)
    large = values.repeat(grain, axis=0).repeat(grain, axis=1)
    return np.ascontiguousarray(large[: shape[0], : shape[1]])


def _texture(rng: np.random.Generator, shape: tuple[int, ...]) -> Image:
    """Blotches of all sizes with hard edges: full of corners that are in no map."""
    total = np.zeros(shape, np.float32)
    for cell in TEXTURE_CELLS_PX:
        total += _grains(rng, shape, cell)
    return (total / len(TEXTURE_CELLS_PX)).astype(np.uint8)


def _tilt(rng: np.random.Generator, degrees: tuple[float, float]) -> Rotation:
    """A rotation about a random axis in the image plane."""
    direction, angle = rng.uniform(0.0, 2.0 * np.pi), np.radians(rng.uniform(*degrees))
    return Rotation.from_rotvec(angle * np.array([np.cos(direction), np.sin(direction), 0.0]))


def _image_from_print(camera: pycolmap.Camera, tilt: Rotation, size: float) -> NDArray[np.float64]:
    """Homography [3,3] between pixels of a print and of the camera in front of it.

    The print's centre is on the optical axis. At size 1 and without tilt it looks as what it shows.
    Distortion is left out: no print is so exact.
    """
    matrix = np.array(camera.calibration_matrix())
    matrix[:2, 2] -= PIXEL_CENTRE
    across, down, _ = tilt.as_matrix().T
    plane = np.stack([size * across, size * down, np.array([0.0, 0.0, 1.0])], axis=1)
    homography: NDArray[np.float64] = matrix @ plane @ np.linalg.inv(matrix)
    return homography


def _fills_view(view: View, tilt: Rotation, size: float) -> bool:
    height, width = view.image.shape[:2]
    corners = np.array(
        [(0, 0, 1), (width - 1, 0, 1), (width - 1, height - 1, 1), (0, height - 1, 1)]
    )
    on_print = corners @ np.linalg.inv(_image_from_print(view.camera, tilt, size)).T
    pixels = on_print[:, :2] / on_print[:, 2:]
    inside = (pixels >= 0) & (pixels <= (width - 1, height - 1))
    return bool(np.all(on_print[:, 2] > 0) and np.all(inside))


def _print_of(view: View, tilt: Rotation, size: float) -> Image:
    """The view as a print in front of the camera, on a bare wall."""
    height, width = view.image.shape[:2]
    wall = tuple(float(value) for value in np.atleast_1d(view.image.mean(axis=(0, 1))))
    return np.asarray(
        cv2.warpPerspective(
            view.image,
            _image_from_print(view.camera, tilt, size),
            (width, height),
            flags=cv2.INTER_AREA if size < 1.0 else cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=wall,
        ),
        np.uint8,
    )
