# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Checks a map bundle: is it whole, and does it hold together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from gam_relocalizer.errors import MapError
from gam_relocalizer.mapping.sfm import quiet_colmap
from gam_relocalizer.scene_map import MANIFEST, SFM, load_map, verify_files

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from scipy.sparse import csr_matrix

    from gam_relocalizer.scene_map import Manifest, SceneMap

# Two parts of a map that share fewer points than a pose estimate needs may lie anywhere.
WEAK_BRIDGE = 20
FEW_POINTS = 50


@dataclass(frozen=True)
class Bridge:
    """The strongest link between two parts of a map.

    Attributes:
        first: Name of a reference image of one part.
        second: Name of a reference image of the other part.
        shared_points: Points that both images see.
    """

    first: str
    second: str
    shared_points: int


@dataclass(frozen=True)
class CheckReport:
    """What a check found.

    Attributes:
        map_id: Of the manifest; empty when there is none.
        counts: Images, points and observations.
        problems: Reasons not to use the map.
        warnings: Reasons to look closer.
        components: Sizes in images of the parts that share no point at all, largest first.
        weak_bridges: Links that alone hold two parts together.
        points_per_image: Least, median and greatest number of points seen by a reference image.
    """

    map_id: str
    counts: Mapping[str, int]
    problems: tuple[str, ...]
    warnings: tuple[str, ...] = ()
    components: tuple[int, ...] = ()
    weak_bridges: tuple[Bridge, ...] = ()
    points_per_image: tuple[int, int, int] = (0, 0, 0)


def check_map(path: Path) -> CheckReport:
    """Checks every file of a bundle and how well its images are tied together.

    Never raises for a bad map: what is wrong with it is in `problems`.
    """
    try:
        scene_map = load_map(path)
    except MapError as err:
        return CheckReport('', {}, (str(err),))
    manifest = scene_map.manifest
    if not scene_map.num_images or not len(scene_map.points):
        return CheckReport(manifest.map_id, manifest.counts, (f'{path}: the map is empty',))
    components = _component_sizes(scene_map.covisibility)
    bridges = _weak_bridges(scene_map)
    seen = np.diff(scene_map.observation_offsets)
    apart = _component_problems(components)
    harmless, harmful = (apart, []) if _poses_were_given(manifest) else ([], apart)
    return CheckReport(
        map_id=manifest.map_id,
        counts=manifest.counts,
        problems=(*_sfm_problems(path, manifest), *harmful),
        warnings=(*harmless, *_warnings(scene_map, bridges)),
        components=components,
        weak_bridges=bridges,
        points_per_image=(int(seen.min()), int(np.median(seen)), int(seen.max())),
    )


def _sfm_problems(path: Path, manifest: Manifest) -> list[str]:
    """Whether the COLMAP model beside the arrays is the one they were made of."""
    names = [name for name in manifest.files if name.startswith(f'{SFM}/')]
    if not names:
        return []
    try:
        verify_files(path, manifest, iter(names))
        with quiet_colmap():
            model = pycolmap.Reconstruction(path / SFM)
    except (MapError, ValueError, RuntimeError) as err:
        return [str(err)]
    if model.num_points3D() != manifest.counts['points']:
        return [
            f'{path / SFM}: {model.num_points3D()} points, the manifest says '
            f'{manifest.counts["points"]}'
        ]
    return []


def _poses_were_given(manifest: Manifest) -> bool:
    """Whether the parts of the map lie to each other as the poses say, whatever they share."""
    options = manifest.build.get('options')
    return isinstance(options, dict) and options.get('poses') is not None


def _component_sizes(covisibility: csr_matrix) -> tuple[int, ...]:
    _, labels = connected_components(covisibility, directed=False)
    return tuple(sorted(np.bincount(labels).tolist(), reverse=True))


def _component_problems(components: tuple[int, ...]) -> list[str]:
    if len(components) == 1:
        return []
    return [
        f'the map falls into {len(components)} parts of {", ".join(map(str, components))} images '
        f'that share no point: only camera poses from elsewhere tell how they lie to each other'
    ]


def _weak_bridges(scene_map: SceneMap) -> tuple[Bridge, ...]:
    """Links of the strongest spanning tree that share few points."""
    strongest = minimum_spanning_tree(-scene_map.covisibility.astype(np.float64)).tocoo()
    weak = [
        Bridge(scene_map.image_names[first], scene_map.image_names[second], int(-negated))
        for first, second, negated in zip(strongest.row, strongest.col, strongest.data, strict=True)
        if first != second and -negated < WEAK_BRIDGE
    ]
    return tuple(sorted(weak, key=lambda bridge: (bridge.shared_points, bridge.first)))


def _warnings(scene_map: SceneMap, bridges: tuple[Bridge, ...]) -> list[str]:
    warnings = [
        f'only {bridge.shared_points} shared points tie `{bridge.first}` and `{bridge.second}` '
        f'together, and with them two parts of the map: add images between the two'
        for bridge in bridges
    ]
    poor = int((np.diff(scene_map.observation_offsets) < FEW_POINTS).sum())
    if poor:
        warnings.append(f'{poor} reference images see fewer than {FEW_POINTS} points')
    if not scene_map.manifest.frame.metric:
        warnings.append('the scale is not metric: positions are not in metres')
    unlisted = sorted(
        file.relative_to(scene_map.path).as_posix()
        for file in scene_map.path.rglob('*')
        if file.is_file()
    )
    listed = {MANIFEST, *scene_map.manifest.files}
    warnings.extend(f'{name}: not part of the map' for name in unlisted if name not in listed)
    return warnings
