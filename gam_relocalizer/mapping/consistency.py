# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Whether what a map bundle says twice is the same both times.

Sums vouch for the bytes that somebody wrote. That they fit together, only a comparison tells: of
the arrays with the COLMAP model beside them, of the stored covisibility with the observations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.errors import MapError
from gam_relocalizer.geometry import pose_error
from gam_relocalizer.mapping.colmap_model import NO_POINT
from gam_relocalizer.mapping.mapped_images import read_model_of
from gam_relocalizer.scene_map import SFM, covisibility_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from gam_relocalizer.mapping.colmap_model import ColmapModel, ModelImage
    from gam_relocalizer.scene_map import SceneMap

# Points are stored in single precision and poses with twelve digits; both leave an error of less
# than this share of their distance from where they count from.
_POSITION_TOLERANCE = 1e-6
_ROTATION_TOLERANCE_DEG = 1e-4
_ROWS_AT_ONCE = 50_000
_MOST_COUNTED = np.iinfo(np.uint16).max
_ADVICE = 'copy the map again, or build it again'


def inconsistencies(scene_map: SceneMap) -> list[str]:
    """What does not fit together in a map that could be loaded, a sentence each."""
    return [*_covisibility(scene_map), *_blank_points(scene_map), *_sfm(scene_map)]


def has_model(scene_map: SceneMap) -> bool:
    """Whether there is a COLMAP model beside the arrays."""
    return any(name.startswith(f'{SFM}/') for name in scene_map.manifest.files)


def _covisibility(scene_map: SceneMap) -> Iterator[str]:
    shared = covisibility_of(*scene_map.observations(), scene_map.num_points)
    off_diagonal = shared.tocoo()
    off_diagonal.data = np.where(
        off_diagonal.row == off_diagonal.col,
        off_diagonal.data,
        np.minimum(off_diagonal.data, _MOST_COUNTED),
    )
    rows, columns = (off_diagonal.tocsr() != scene_map.covisibility).nonzero()
    if len(rows):
        names = scene_map.image_names
        yield (
            f'{scene_map.path}: the stored covisibility is not that of the observations for '
            f'{len(rows)} pairs of images, the first is `{names[rows[0]]}` and '
            f'`{names[columns[0]]}`; {_ADVICE}'
        )


def _blank_points(scene_map: SceneMap) -> Iterator[str]:
    """Points that nothing can be matched with."""
    rows = np.arange(scene_map.num_points)
    blank = sum(
        int(np.count_nonzero(~np.any(scene_map.descriptors_of(some), axis=1)))
        for some in np.array_split(rows, len(rows) // _ROWS_AT_ONCE + 1)
    )
    if blank:
        yield (
            f'{scene_map.path}: the descriptors of {blank} of {scene_map.num_points} points are '
            f'zero; {_ADVICE}'
        )


def _sfm(scene_map: SceneMap) -> Iterator[str]:
    """How the COLMAP model beside the arrays differs from them."""
    if not has_model(scene_map):
        return
    try:
        model = read_model_of(scene_map.path, scene_map.manifest)
    except MapError as err:
        yield str(err)
        return
    if len(model.points) != scene_map.num_points:
        yield (
            f'{model.folder}: {len(model.points)} points, the map has {scene_map.num_points}; '
            f'{_ADVICE}'
        )
        return
    comparison = _Comparison.of(scene_map, model)
    yield from comparison.points()
    yield from comparison.images()


@dataclass(frozen=True)
class _Comparison:
    """A map and the model beside it, in the frame of the map.

    Attributes:
        scene_map: The map.
        model: The model, in its own frame; its points are in the order of the map.
        origin: [3] what the map's numbers count from.
    """

    scene_map: SceneMap
    model: ColmapModel
    origin: NDArray[np.float64]

    @staticmethod
    def of(scene_map: SceneMap, model: ColmapModel) -> _Comparison:
        manifest = scene_map.manifest
        return _Comparison(
            scene_map,
            model,
            np.asarray(manifest.frame.map_from_sfm * np.array(manifest.points_origin)),
        )

    def points(self) -> Iterator[str]:
        map_from_sfm = self.scene_map.manifest.frame.map_from_sfm
        expected = np.asarray(map_from_sfm * self.model.points)
        away = np.linalg.norm(self.scene_map.points - expected, axis=1)
        elsewhere = np.flatnonzero(~(away <= self._tolerance(expected)))
        if len(elsewhere):
            yield (
                f'{self._folder}: {len(elsewhere)} of {len(away)} points lie elsewhere than in '
                f'points.npy, the first is row {elsewhere[0]}, {away[elsewhere[0]]:.3g} map units '
                f'away; {_ADVICE}'
            )

    def images(self) -> Iterator[str]:
        by_name = {one.name: one for one in self.model.images}
        names = self.scene_map.image_names
        missing = [name for name in names if name not in by_name]
        if missing:
            yield (
                f'{self._folder}: lacks {len(missing)} of {len(names)} images of the map, the '
                f'first is `{missing[0]}`; {_ADVICE}'
            )
            return
        moved = [row for row, name in enumerate(names) if not self._same_pose(row, by_name[name])]
        if moved:
            yield (
                f'{self._folder}: {len(moved)} of {len(names)} images have another pose than in '
                f'images.txt, the first is `{names[moved[0]]}`; {_ADVICE}'
            )
        other = [row for row, name in enumerate(names) if not self._same_points(row, by_name[name])]
        if other:
            yield (
                f'{self._folder}: {len(other)} of {len(names)} images see other points than the '
                f'map says, the first is `{names[other[0]]}`; {_ADVICE}'
            )

    def _same_pose(self, row: int, image: ModelImage) -> bool:
        map_from_sfm = self.scene_map.manifest.frame.map_from_sfm
        expected = map_from_sfm.transform_camera_world(image.camera_from_world)
        error = pose_error(self.scene_map.camera_from_map[row], expected)
        near = error.position <= self._tolerance(self.scene_map.camera_positions[row])
        return bool(near) and error.rotation_deg <= _ROTATION_TOLERANCE_DEG

    def _same_points(self, row: int, image: ModelImage) -> bool:
        rows = np.unique(image.points[image.points != NO_POINT])
        return np.array_equal(rows, self.scene_map.points_seen_by(row))

    def _tolerance(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """For each place [..,3]; a share of its distance, at least of the map's own size."""
        size = np.linalg.norm(self.scene_map.camera_positions - self.origin, axis=1).max()
        scale = max(float(size), self.scene_map.manifest.frame.scale)
        away = np.linalg.norm(places - self.origin, axis=-1)
        absolute = np.linalg.norm(places, axis=-1)  # what double precision leaves far from zero
        return np.asarray(_POSITION_TOLERANCE * (away + scale) + 1e-11 * absolute)

    @property
    def _folder(self) -> str:
        return str(self.model.folder)
