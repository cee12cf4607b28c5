# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Renders the demo world through a pinhole camera: exact geometry, photo-like light and sensor.

Each textured quad is a plane a, b -> origin + a*across + b*down in the camera's frame. With
M = [across down origin] and the ray d = (x, y, 1) of a pixel, the vector q = M^-1 d is
(a, b, 1) / z: the inverse depth and both texture coordinates are ratios of functions that are
linear in the pixel. So the z-buffer, the outline and the texture lookup are exact without any
clipping of polygons. A frame is the mean of several samples, each with its own sub-pixel offset
and its own pose within the exposure, which gives smooth edges and true motion blur.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from gam_relocalizer.errors import CameraError

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.demo.world import World

NEAR = 0.05
MIP_LEVELS = 6
ATLAS_WIDTH = 4096
LIGHT_NODES = 12
_WHITEST = 2.0
_TILE_STEP = 1 << (MIP_LEVELS - 1)

# Rotated grid: in x, in y and in time every sample has a value of its own, with mean zero.
SAMPLE_OFFSETS = ((-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375))
STILL_SAMPLES = len(SAMPLE_OFFSETS)


@dataclass(frozen=True)
class Light:
    """A small lamp.

    Attributes:
        position: Place in the map frame [m].
        colour: Linear red, green, blue.
        intensity: Irradiance it gives at one metre, face on (1 makes a white wall white).
    """

    position: tuple[float, float, float]
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)
    intensity: float = 1.0


@dataclass(frozen=True)
class Appearance:
    """How the world and the camera's sensor look during one recording.

    Attributes:
        lights: Lamps that are on.
        ambient: Linear red, green, blue light from everywhere.
        exposure: Factor on the linear image before the tone curve.
        white_balance: Gains of red, green, blue.
        exposure_time: Time the shutter is open [s]; 0 for no motion blur.
        noise: Deviation of the sensor noise at full white, as a share of full white.
        vignetting: Share of the light lost in the image's corners.
    """

    lights: tuple[Light, ...]
    ambient: tuple[float, float, float] = (0.3, 0.3, 0.3)
    exposure: float = 1.0
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    exposure_time: float = 0.0
    noise: float = 0.0
    vignetting: float = 0.15


@dataclass(frozen=True)
class _Sample:
    """What one pass over the quads leaves for every pixel.

    Attributes:
        quads: Indices [K] of the quads that may be seen.
        planes: M^-1 of each of them [K,3,3].
        shown: Position in `quads` of the one in front [H,W], -1 where there is none.
        inverse_depth: Of that quad [H,W], 0 where there is none.
    """

    quads: NDArray[np.intp]
    planes: NDArray[np.float64]
    shown: NDArray[np.int32]
    inverse_depth: NDArray[np.float32]


class Renderer:
    """Renders one world under one appearance; keeps its textures and its baked light."""

    def __init__(self, world: World, appearance: Appearance) -> None:
        self._appearance = appearance
        corners = np.stack([quad.corners for quad in world.quads])
        self._origin = corners[:, 0]
        self._across = corners[:, 1] - corners[:, 0]
        self._down = corners[:, 3] - corners[:, 0]
        self._atlas, self._levels, tiles = _texture_atlas(world.textures)
        self._tiles = tiles[[quad.texture for quad in world.quads]]
        emission = np.array([quad.emission for quad in world.quads])
        self._light = self._baked_light(appearance, emission)

    def render(
        self,
        camera: pycolmap.Camera,
        exposure: Sequence[pycolmap.Rigid3d],
        noise_seed: int = 0,
    ) -> NDArray[np.uint8]:
        """The image of a camera.

        Args:
            camera: A pinhole camera.
            exposure: `camera_from_map` at moments spread evenly over the exposure; one pose when
                the camera stands still.
            noise_seed: Seed of the sensor noise of this image.

        Returns:
            RGB [H,W,3].

        Raises:
            CameraError: The camera has distortion.
        """
        poses = list(exposure) * STILL_SAMPLES if len(exposure) == 1 else list(exposure)
        total = np.zeros((camera.height, camera.width, 3), np.float32)
        for index, camera_from_map in enumerate(poses):
            offset = SAMPLE_OFFSETS[index % STILL_SAMPLES]
            sample = self._rasterised(camera, camera_from_map, offset)
            # Rounding a shifted level of detail blends two mip levels over the samples.
            level_shift = (index % STILL_SAMPLES + 0.5) / STILL_SAMPLES - 0.5
            total += self._shaded(camera, sample, offset, level_shift)
        return self._developed(total / np.float32(len(poses)), noise_seed)

    def depth(
        self, camera: pycolmap.Camera, camera_from_map: pycolmap.Rigid3d
    ) -> NDArray[np.float32]:
        """Depth (z in the camera's frame) at the pixel centres [H,W], inf where there is nothing.

        Raises:
            CameraError: The camera has distortion.
        """
        sample = self._rasterised(camera, camera_from_map, (0.0, 0.0))
        with np.errstate(divide='ignore'):
            result: NDArray[np.float32] = np.float32(1.0) / sample.inverse_depth
        return result

    def _baked_light(
        self, appearance: Appearance, emission: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Light arriving on a grid of nodes of every quad, [Q * nodes, nodes, 3]."""
        steps = np.linspace(0.0, 1.0, LIGHT_NODES)
        down, across = np.meshgrid(steps, steps, indexing='ij')
        points = (
            self._origin[:, None, None]
            + across[..., None] * self._across[:, None, None]
            + down[..., None] * self._down[:, None, None]
        )
        normals = np.cross(self._down, self._across)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        light = np.tile(np.array(appearance.ambient), (*points.shape[:3], 1))
        # Surfaces that face up catch a little more of the ambient light of a room.
        light *= (1.0 + 0.15 * normals[:, 2])[:, None, None, None]
        for lamp in appearance.lights:
            towards = np.array(lamp.position) - points
            distance = np.linalg.norm(towards, axis=-1)
            facing = np.einsum('qijc,qc->qij', towards, normals) / distance
            received = lamp.intensity * np.maximum(facing, 0.0) / (0.25 + distance**2)
            light += received[..., None] * np.array(lamp.colour)
        light += emission[:, None, None, None]
        result: NDArray[np.float32] = light.reshape(-1, LIGHT_NODES, 3).astype(np.float32)
        return result

    def _rasterised(
        self,
        camera: pycolmap.Camera,
        camera_from_map: pycolmap.Rigid3d,
        offset: tuple[float, float],
    ) -> _Sample:
        """Finds the nearest quad of every pixel."""
        rotation = np.asarray(camera_from_map.rotation.matrix())
        origin = self._origin @ rotation.T + camera_from_map.translation
        across, down = self._across @ rotation.T, self._down @ rotation.T
        quads = _seen_quads(camera, origin, across, down)
        planes = np.linalg.inv(np.stack([across[quads], down[quads], origin[quads]], axis=2))
        xs, ys = _pixel_rays(camera, offset)
        first, last = _row_spans(planes, xs, ys)
        shown = np.full((camera.height, camera.width), -1, np.int32)
        inverse_depth = np.zeros((camera.height, camera.width), np.float32)
        columns = np.arange(camera.width)
        for index, (start, stop) in enumerate(zip(first, last, strict=True)):
            rows = np.flatnonzero(start < stop)
            if not len(rows):
                continue
            y = slice(int(rows[0]), int(rows[-1]) + 1)
            x = slice(int(start[rows].min()), int(stop[rows].max()))
            slope_x, slope_y, constant = planes[index, 2]
            along_row = (slope_x * xs[x] + constant).astype(np.float32)
            own = along_row + (slope_y * ys[y, None]).astype(np.float32)
            front = own > inverse_depth[y, x]
            front &= columns[x] >= start[y, None]
            front &= columns[x] < stop[y, None]
            np.copyto(inverse_depth[y, x], own, where=front)
            np.copyto(shown[y, x], np.int32(index), where=front)
        return _Sample(quads, planes, shown, inverse_depth)

    def _shaded(
        self,
        camera: pycolmap.Camera,
        sample: _Sample,
        offset: tuple[float, float],
        level_shift: float,
    ) -> NDArray[np.float32]:
        """Linear colour of every pixel of one sample [H,W,3]."""
        if not len(sample.quads):
            return np.zeros((*sample.shown.shape, 3), np.float32)
        xs, ys = (axis.astype(np.float32) for axis in _pixel_rays(camera, offset))
        (
            a_x, a_y, a_1, b_x, b_y, b_1, left, top, width, height, light_row, area,
        ) = np.take(self._lookup_table(camera, sample), sample.shown, axis=1)  # fmt: skip
        depth = 1.0 / np.maximum(sample.inverse_depth, np.float32(1e-6))
        a = (a_x * xs + a_y * ys[:, None] + a_1) * depth
        b = (b_x * xs + b_y * ys[:, None] + b_1) * depth
        # The area of a pixel on the texture, from the determinant of the homography's Jacobian.
        level = 0.5 * np.log2(area * depth**3) + np.float32(level_shift)
        level = np.clip(np.rint(level), 0, MIP_LEVELS - 1)
        scale = np.exp2(-level)
        corner = self._levels[level.astype(np.intp)]
        texture_x = (left + a * width) * scale - 0.5 + corner[..., 0]
        texture_y = (top + b * height) * scale - 0.5 + corner[..., 1]
        texels = cv2.remap(self._atlas, texture_x, texture_y, cv2.INTER_LINEAR)
        light = cv2.remap(
            self._light,
            a * np.float32(LIGHT_NODES - 1),
            light_row + b * np.float32(LIGHT_NODES - 1),
            cv2.INTER_LINEAR,
        )
        colour: NDArray[np.float32] = cv2.LUT(texels, _LINEAR) * light
        colour[sample.shown < 0] = 0.0
        return colour

    def _lookup_table(self, camera: pycolmap.Camera, sample: _Sample) -> NDArray[np.float32]:
        """What the texture and light lookups need of every quad that may be seen [12,K]."""
        focal, _ = _pinhole(camera)
        tiles = self._tiles[sample.quads]
        area = np.abs(np.linalg.det(sample.planes)) * tiles[:, 2] * tiles[:, 3]
        # A frame has one sample per quarter of a pixel's area.
        area = np.maximum(area / (focal[0] * focal[1] * STILL_SAMPLES), 1e-12)
        coefficients = sample.planes[:, :2].reshape(-1, 6).T
        rows = [coefficients, tiles.T, sample.quads * LIGHT_NODES, area]
        return np.vstack(rows).astype(np.float32)

    def _developed(self, linear: NDArray[np.float32], noise_seed: int) -> NDArray[np.uint8]:
        """Lens and sensor: vignetting, exposure, white balance, noise, tone curve."""
        look = self._appearance
        height, width = linear.shape[:2]
        y = (np.arange(height) + 0.5) / height - 0.5
        x = (np.arange(width) + 0.5) / width - 0.5
        falloff = 1.0 - look.vignetting * 2.0 * (x**2 + y[:, None] ** 2)
        gain = look.exposure * falloff[..., None] * np.array(look.white_balance)
        linear = linear * gain.astype(np.float32)
        if look.noise:
            rng = np.random.default_rng(noise_seed)
            grain = rng.standard_normal(linear.shape, dtype=np.float32)
            # Photon noise grows with the root of the light; a floor is left by the electronics.
            linear += grain * (look.noise * np.sqrt(np.maximum(linear, 0.0) + 0.02))
        index = np.clip(linear * ((len(_TONES) - 1) / _WHITEST), 0, len(_TONES) - 1)
        image: NDArray[np.uint8] = _TONES[index.astype(np.uint16)]
        return image


def _pinhole(camera: pycolmap.Camera) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Focal lengths and principal point [px]."""
    if camera.model_name not in {'PINHOLE', 'SIMPLE_PINHOLE'}:
        msg = f'the demo renderer needs a PINHOLE or SIMPLE_PINHOLE camera, not {camera.model_name}'
        raise CameraError(msg)
    focal = np.array([camera.focal_length_x, camera.focal_length_y])
    principal = np.array([camera.principal_point_x, camera.principal_point_y])
    return focal, principal


def _pixel_rays(
    camera: pycolmap.Camera, offset: tuple[float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The x of every column and the y of every row on the plane z = 1; centres are at +0.5."""
    focal, principal = _pinhole(camera)
    x = (np.arange(camera.width) + 0.5 + offset[0] - principal[0]) / focal[0]
    y = (np.arange(camera.height) + 0.5 + offset[1] - principal[1]) / focal[1]
    return x, y


def _seen_quads(
    camera: pycolmap.Camera,
    origin: NDArray[np.float64],
    across: NDArray[np.float64],
    down: NDArray[np.float64],
) -> NDArray[np.intp]:
    """Indices of the quads that face the camera and are not wholly outside its field of view."""
    focal, principal = _pinhole(camera)
    facing = np.einsum('qc,qc->q', np.cross(across, down), origin) > 1e-9
    corners = np.stack([origin, origin + across, origin + across + down, origin + down], axis=1)
    x, y, z = np.moveaxis(corners, 2, 0)
    # One pixel of margin for the sub-pixel offsets.
    right, left = (camera.width + 1 - principal[0]) / focal[0], (-1 - principal[0]) / focal[0]
    low, high = (camera.height + 1 - principal[1]) / focal[1], (-1 - principal[1]) / focal[1]
    outside = [z < NEAR, x > right * z, x < left * z, y > low * z, y < high * z]
    seen = facing & ~np.any([np.all(side, axis=1) for side in outside], axis=0)
    return np.flatnonzero(seen)


def _row_spans(
    planes: NDArray[np.float64], xs: NDArray[np.float64], ys: NDArray[np.float64]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First and past-the-last pixel of every quad in every image row, each [Q,H].

    A pixel belongs to a quad when q_a >= 0, q_b >= 0, q_a <= q_z, q_b <= q_z and
    0 < q_z <= 1 / NEAR: half-planes in the image, so a span in each row.
    """
    a, b, z = planes[:, 0], planes[:, 1], planes[:, 2]
    nearest = np.zeros_like(z)
    nearest[:, 2] = 1.0 / NEAR
    step = xs[1] - xs[0]
    low = np.full((len(planes), len(ys)), -np.inf)
    high = np.full((len(planes), len(ys)), np.inf)
    for side in (a, b, z - a, z - b, z, nearest - z):
        slope = side[:, 0, None]
        rest = side[:, 1, None] * ys + side[:, 2, None]
        with np.errstate(divide='ignore', invalid='ignore'):
            crossing = -rest / slope
        low = np.where(slope > 0, np.maximum(low, crossing), low)
        high = np.where(slope < 0, np.minimum(high, crossing), high)
        high = np.where((slope == 0) & (rest < 0), -np.inf, high)
    first = np.ceil(np.clip((low - xs[0]) / step, 0, len(xs)))
    last = np.floor(np.clip((high - xs[0]) / step, -1, len(xs) - 1)) + 1
    return first.astype(np.intp), last.astype(np.intp)


def _texture_atlas(
    textures: Sequence[NDArray[np.uint8]],
) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float64]]:
    """All textures with all their mip levels in one image.

    Tiles lie on multiples of the coarsest texel, with a replicated border, so that the levels
    are plain halvings of the whole and none bleeds into its neighbour.

    Returns:
        The image, the corner x, y of each level in it [L,2], and x, y, width, height of each
        texture in level 0 [T,4].
    """
    sizes = [
        tuple(-(-side // _TILE_STEP) * _TILE_STEP + 2 * _TILE_STEP for side in image.shape[:2])
        for image in textures
    ]
    tiles = np.zeros((len(textures), 4))
    x = y = shelf = 0
    # Shelves of tiles of about the same height.
    for index in sorted(range(len(textures)), key=lambda i: sizes[i], reverse=True):
        height, width = sizes[index]
        if x + width > ATLAS_WIDTH:
            x, y, shelf = 0, y + shelf, 0
        image = textures[index]
        tiles[index] = (x + _TILE_STEP, y + _TILE_STEP, image.shape[1], image.shape[0])
        x, shelf = x + width, max(shelf, height)
    rows = -(-(y + shelf) // _TILE_STEP) * _TILE_STEP
    level = np.zeros((rows, ATLAS_WIDTH, 3), np.uint8)
    for image, (left, top, *_), (height, width) in zip(textures, tiles, sizes, strict=True):
        x, y = int(left) - _TILE_STEP, int(top) - _TILE_STEP
        level[y : y + height, x : x + width] = cv2.copyMakeBorder(
            image,
            _TILE_STEP,
            height - image.shape[0] - _TILE_STEP,
            _TILE_STEP,
            width - image.shape[1] - _TILE_STEP,
            cv2.BORDER_REPLICATE,
        )
    # Level 0 on the left; the others, ever smaller, below each other on its right.
    atlas = np.zeros((rows, ATLAS_WIDTH + ATLAS_WIDTH // 2, 3), np.uint8)
    corners = np.zeros((MIP_LEVELS, 2), np.float32)
    corners[1:, 0] = ATLAS_WIDTH
    corners[1:, 1] = rows * (1.0 - 0.5 ** np.arange(MIP_LEVELS - 1))
    for x, y in corners.astype(int):
        atlas[y : y + level.shape[0], x : x + level.shape[1]] = level
        half = (level.shape[1] // 2, level.shape[0] // 2)
        level = np.asarray(cv2.resize(level, half, interpolation=cv2.INTER_AREA), np.uint8)
    return atlas, corners, tiles


def _tone_curve() -> NDArray[np.uint8]:
    """Display values (sRGB) after a soft shoulder, so that bright light does not clip hard."""
    linear = np.linspace(0.0, _WHITEST, 4096)
    soft = np.where(linear < 0.7, linear, 0.7 + 0.3 * np.tanh((linear - 0.7) / 0.3 * 0.8))
    display = np.where(soft < 0.0031308, 12.92 * soft, 1.055 * soft ** (1 / 2.4) - 0.055)
    result: NDArray[np.uint8] = np.rint(np.clip(display, 0, 1) * 255).astype(np.uint8)
    return result


def _linear_values() -> NDArray[np.float32]:
    """Linear light of the 256 sRGB values."""
    display = np.arange(256) / 255.0
    linear = np.where(display < 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)
    result: NDArray[np.float32] = linear.astype(np.float32)
    return result


_LINEAR = _linear_values()
_TONES = _tone_curve()
