# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Draws arrows into an image: shaded bodies with an outline, seen by the image's own camera.

Nothing of the scene hides an arrow: a map of points does not know what is opaque.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from gam_relocalizer.augmentation.projection import Field, clipped, in_image, project

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.augmentation.arrows import Arrow

# Shares of an arrow's length.
SHAFT_RADIUS = 0.055
HEAD_RADIUS = 0.14
HEAD_LENGTH = 0.36
NEAR = 0.02

# Faces are so small that their edges are straight in the image, whatever the distortion.
_SIDES = 16
_SHAFT_RINGS = 4
_HEAD_RINGS = 2

_OVERSAMPLING = 2
# Bits of a pixel that OpenCV takes for the corners of a polygon.
_SHIFT = 6
_OUTLINE_PX = 1.5
_OUTLINE_ALPHA = 0.55
_FACE_ALPHA = 0.94
_AMBIENT = 0.42


def draw_arrows(
    image: NDArray[np.uint8],
    camera: pycolmap.Camera,
    camera_from_map: pycolmap.Rigid3d,
    arrows: Sequence[Arrow],
    up: NDArray[np.float64],
) -> NDArray[np.uint8]:
    """A copy of an image with the arrows in it, the nearest on top.

    Args:
        image: RGB [H,W,3], of the size of the camera.
        camera: The camera that took it.
        camera_from_map: Where it was taken.
        arrows: What to draw, map frame.
        up: [3] of length one, map frame: where the light comes from.
    """
    drawn = image.copy()
    up_in_camera = _directions(camera_from_map, up[None])[0]
    field = Field.of(camera)

    def distance(arrow: Arrow) -> float:
        middle = camera_from_map * ((arrow.tail + arrow.tip) / 2.0)
        return float(np.linalg.norm(middle))

    for arrow in sorted(arrows, key=distance, reverse=True):
        faces = list(_visible_faces(arrow, camera, field, camera_from_map))
        if faces:
            _paint(drawn, faces, np.array(arrow.rgb, float), up_in_camera)
    return drawn


class _Face:
    """What is seen of a face: corners [V,2] px, outward normal and distance in the camera frame."""

    def __init__(
        self, pixels: NDArray[np.float64], normal: NDArray[np.float64], distance: float
    ) -> None:
        self.pixels = pixels
        self.normal = normal
        self.distance = distance


def _visible_faces(
    arrow: Arrow, camera: pycolmap.Camera, field: Field, camera_from_map: pycolmap.Rigid3d
) -> Iterator[_Face]:
    """Those that look at the camera, cut to what the image shows."""
    corners, normals = _in_camera(arrow, camera_from_map)
    facing = np.einsum('fk,fk->f', normals, corners.mean(axis=1)) < 0.0
    corners, normals = corners[facing], normals[facing]
    planes = field.planes(NEAR * arrow.length)
    sides = np.einsum('fvk,pk->fpv', corners, planes[:, :3]) + planes[:, 3, None]
    for corner, normal, side in zip(corners, normals, sides, strict=True):
        if (side < 0.0).all(axis=1).any():
            continue
        polygon = corner if (side >= 0.0).all() else clipped(corner, planes)
        places = project(camera, polygon)
        if len(places) >= 3 and np.isfinite(places).all():
            yield _Face(places, normal, float(np.linalg.norm(polygon.mean(axis=0))))


def _in_camera(
    arrow: Arrow, camera_from_map: pycolmap.Rigid3d
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners [F,4,3] and outward normals [F,3] of an arrow's faces, in the camera's frame."""
    corners, normals = _mesh()
    along = (arrow.tip - arrow.tail) / arrow.length
    turned = Rotation.align_vectors(along[None], np.array([[0.0, 0.0, 1.0]]))[0]
    in_map = arrow.tail + arrow.length * turned.apply(corners.reshape(-1, 3))
    in_camera = np.asarray(camera_from_map * in_map).reshape(corners.shape)
    return in_camera, _directions(camera_from_map, turned.apply(normals))


def _directions(
    camera_from_map: pycolmap.Rigid3d, directions: NDArray[np.float64]
) -> NDArray[np.float64]:
    return np.asarray(directions @ camera_from_map.rotation.matrix().T, np.float64)


@lru_cache(maxsize=1)
def _mesh() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """An arrow from the origin to (0, 0, 1): corners [F,4,3] and outward normals [F,3].

    Triangles repeat a corner.
    """
    neck = 1.0 - HEAD_LENGTH
    shaft = [(SHAFT_RADIUS, neck * ring / _SHAFT_RINGS) for ring in range(_SHAFT_RINGS + 1)]
    head = [
        (HEAD_RADIUS * (1.0 - ring / _HEAD_RINGS), neck + HEAD_LENGTH * ring / _HEAD_RINGS)
        for ring in range(_HEAD_RINGS + 1)
    ]
    outline = np.array([(0.0, 0.0), *shaft, *head])
    angles = np.linspace(0.0, 2.0 * np.pi, _SIDES + 1)
    spokes = np.column_stack([np.cos(angles), np.sin(angles)])
    middles = (angles[:-1] + angles[1:]) / 2.0
    outwards = np.column_stack([np.cos(middles), np.sin(middles)])
    corners, normals = [], []
    for (low_radius, low), (high_radius, high) in pairwise(outline):
        slope = np.array([high - low, low_radius - high_radius])
        slope /= np.linalg.norm(slope)
        for side in range(_SIDES):
            first, second = spokes[side], spokes[side + 1]
            corners.append(
                [
                    (*(low_radius * first), low),
                    (*(low_radius * second), low),
                    (*(high_radius * second), high),
                    (*(high_radius * first), high),
                ]
            )
            normals.append((*(slope[0] * outwards[side]), slope[1]))
    return np.array(corners), np.array(normals)


def _paint(
    image: NDArray[np.uint8],
    faces: Sequence[_Face],
    rgb: NDArray[np.float64],
    up_in_camera: NDArray[np.float64],
) -> None:
    """Paints the faces of one arrow into the image, from far to near."""
    height, width = image.shape[:2]
    pixels = np.concatenate([face.pixels for face in faces])
    pad = np.ceil(_OUTLINE_PX) + 1
    low = np.maximum(np.floor(pixels.min(axis=0)) - pad, 0).astype(int)
    high = np.minimum(np.ceil(pixels.max(axis=0)) + pad, (width, height)).astype(int)
    if (high <= low).any():
        return
    shape = (high - low)[::-1] * _OVERSAMPLING
    colours = np.zeros((*shape, 3), np.uint8)
    covered = np.zeros(shape, np.uint8)
    for face in sorted(faces, key=lambda one: one.distance, reverse=True):
        # the light comes from above, and all around from the sky
        light = _AMBIENT + (1.0 - _AMBIENT) * (0.5 + 0.5 * float(face.normal @ up_in_camera))
        corners = ((face.pixels - low) * _OVERSAMPLING - 0.5) * 2**_SHIFT
        polygon = [np.round(corners).astype(np.int32)]
        cv2.fillPoly(colours, polygon, (rgb * light).tolist(), shift=_SHIFT)
        cv2.fillPoly(covered, polygon, 255, shift=_SHIFT)
    part = image[low[1] : high[1], low[0] : high[0]]
    part[:] = _blended(part, colours, covered)


def _blended(
    part: NDArray[np.uint8], colours: NDArray[np.uint8], covered: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """A part of an image with the painted faces over it, and a dark outline around them."""
    reach = round(2 * _OUTLINE_PX * _OVERSAMPLING) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))
    outline = cv2.dilate(covered, kernel)
    inside = (covered > 0)[..., None]
    alpha = np.where(inside, _FACE_ALPHA, _OUTLINE_ALPHA * (outline > 0)[..., None])
    painted = (np.where(inside, colours, 0) * alpha).astype(np.float32)
    size = (part.shape[1], part.shape[0])
    painted = np.asarray(cv2.resize(painted, size, interpolation=cv2.INTER_AREA), np.float32)
    shown = cv2.resize(alpha.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    mixed = part * (1.0 - np.asarray(shown)[..., None]) + painted
    return np.clip(np.round(mixed), 0, 255).astype(np.uint8)


def arrow_ends(arrows: Sequence[Arrow]) -> NDArray[np.float64]:
    """[2 A,3] the tails and tips, map frame: what jitter is measured at."""
    return np.array([end for arrow in arrows for end in (arrow.tail, arrow.tip)]).reshape(-1, 3)


def is_in_view(
    camera: pycolmap.Camera, camera_from_map: pycolmap.Rigid3d, arrows: Sequence[Arrow]
) -> bool:
    """Whether any tail or tip of an arrow lies in the image."""
    ends = np.asarray(camera_from_map * arrow_ends(arrows))
    return bool(in_image(camera, project(camera, ends)).any())
