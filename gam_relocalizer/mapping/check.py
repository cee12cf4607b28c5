# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Checks a map bundle: is it whole, does it hold together, and does it find its own images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from gam_relocalizer.errors import MapError
from gam_relocalizer.mapping.consistency import has_model, inconsistencies
from gam_relocalizer.mapping.coverage import Standing
from gam_relocalizer.mapping.facts import bytes_per_point, mapping_in, number_in, text_of
from gam_relocalizer.plots import MAX_TILT_DEG, tilt_of, upward_direction
from gam_relocalizer.scene_map import MANIFEST, SFM, load_map

if TYPE_CHECKING:
    from pathlib import Path

    from scipy.sparse import csr_matrix

    from gam_relocalizer.mapping.coverage import Coverage
    from gam_relocalizer.scene_map import Manifest, SceneMap

# Two parts of a map that share fewer points than a pose estimate needs may lie anywhere.
WEAK_BRIDGE = 20
FEW_POINTS = 50
# A map whose scale is known no better puts a robot off by a tenth of the way it went.
UNCERTAIN_SCALE = 0.03

NOT_LOCALIZED = (
    'whether the map finds its own images; give the folder that they are in: --images DIR'
)
NO_MODEL = f'whether {SFM}/ is the model that the map was made of; the map comes without it'


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
        bytes_per_point: Of what is needed at run time (`run time`), and of the COLMAP model.
        not_checked: What was left out, each with how to have it checked.
        coverage: How the map does at its own images, when they were tried.
    """

    map_id: str
    counts: Mapping[str, int]
    problems: tuple[str, ...]
    warnings: tuple[str, ...] = ()
    components: tuple[int, ...] = ()
    weak_bridges: tuple[Bridge, ...] = ()
    points_per_image: tuple[int, int, int] = (0, 0, 0)
    bytes_per_point: Mapping[str, float] = field(default_factory=dict)
    not_checked: tuple[str, ...] = ()
    coverage: Coverage | None = None

    @property
    def loadable(self) -> bool:
        """Whether there is a map to try images in."""
        return bool(self.components)

    def with_coverage(self, coverage: Coverage) -> CheckReport:
        """The same report, and what became of the images that were left out.

        A pose that is accepted in a wrong place is a problem, all other weak spots are warnings.
        """
        spots = [(spot.standing, spot.text(coverage.unit)) for spot in coverage.weak_spots]
        wrong = [text for standing, text in spots if standing is Standing.WRONG]
        weak = [text for standing, text in spots if standing is not Standing.WRONG]
        return replace(
            self,
            problems=(*self.problems, *wrong),
            warnings=(*self.warnings, *weak),
            not_checked=tuple(one for one in self.not_checked if one != NOT_LOCALIZED),
            coverage=coverage,
        )

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        content = asdict(self)
        if self.coverage is not None:
            content['coverage']['recall'] = self.coverage.recall
            content['coverage']['counts'] = {
                standing.name.lower(): self.coverage.count(standing) for standing in Standing
            }
            for one in (*content['coverage']['images'], *content['coverage']['weak_spots']):
                one['standing'] = one['standing'].name.lower()
        return content


def check_map(path: Path) -> CheckReport:
    """Checks every file of a bundle and how well its images are tied together.

    Never raises for a bad map: what is wrong with it is in `problems`.
    """
    try:
        scene_map = load_map(path)
    except MapError as err:
        return CheckReport('', {}, (str(err),))
    manifest = scene_map.manifest
    if not scene_map.num_images or not scene_map.num_points:
        return CheckReport(manifest.map_id, manifest.counts, (f'{path}: the map is empty',))
    components = _component_sizes(scene_map.covisibility)
    bridges = _weak_bridges(scene_map)
    seen = scene_map.num_points_seen
    apart = _component_problems(components)
    harmless, harmful = (apart, []) if _poses_were_given(manifest) else ([], apart)
    return CheckReport(
        map_id=manifest.map_id,
        counts=manifest.counts,
        problems=(*inconsistencies(scene_map), *harmful),
        warnings=(
            *harmless,
            *_warnings(scene_map, bridges),
            *_build_warnings(manifest),
            *_frame_warnings(scene_map),
        ),
        components=components,
        weak_bridges=bridges,
        points_per_image=(int(seen.min()), int(np.median(seen)), int(seen.max())),
        bytes_per_point=bytes_per_point(manifest),
        not_checked=(NOT_LOCALIZED, *(() if has_model(scene_map) else (NO_MODEL,))),
    )


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
    _, seen = scene_map.observations()
    if unseen := scene_map.num_points - len(np.unique(seen)):
        warnings.append(f'no image sees {unseen} of {scene_map.num_points} points')
    poor = int((scene_map.num_points_seen < FEW_POINTS).sum())
    if poor:
        warnings.append(f'{poor} reference images see fewer than {FEW_POINTS} points')
    unlisted = sorted(
        file.relative_to(scene_map.path).as_posix()
        for file in scene_map.path.rglob('*')
        if file.is_file()
    )
    listed = {MANIFEST, *scene_map.manifest.files}
    warnings.extend(f'{name}: not part of the map' for name in unlisted if name not in listed)
    return warnings


def _frame_warnings(scene_map: SceneMap) -> list[str]:
    """What speaks against using the positions of a map as they are."""
    manifest = scene_map.manifest
    warnings = []
    if not manifest.frame.metric:
        warnings.append(
            'the scale is not metric: positions are not in metres; give it a scale with `map align`'
        )
    up = upward_direction(scene_map)
    if up is not None and tilt_of(up) > MAX_TILT_DEG:
        warnings.append(
            f'the map does not stand upright: the tops of its images point {tilt_of(up):.0f} '
            f'degrees away from its z axis; level it with `map align`'
        )
    scale_sigma = number_in(manifest.alignment, 'scale_sigma')
    if scale_sigma is not None and not scale_sigma <= UNCERTAIN_SCALE:
        warnings.append(
            f'the scale of the map is known to {scale_sigma:.1%} only; align it with references '
            f'that lie further apart'
        )
    warnings.extend(f'alignment: {remark}' for remark in _remarks(manifest.alignment))
    return warnings


def _build_warnings(manifest: Manifest) -> list[str]:
    """What the build, and what was done to the map since, warned of."""
    changes = manifest.build.get('changes')
    warnings = [f'build: {text_of(one)}' for one in _remarks(mapping_in(manifest.build, 'report'))]
    for change in changes if isinstance(changes, list) else []:
        warnings.extend(f'change: {text_of(one)}' for one in _remarks(change))
    return warnings


def _remarks(record: object) -> list[str]:
    """The texts under `warnings` of a mapping that came from a file."""
    remarks = record.get('warnings') if isinstance(record, Mapping) else None
    if not isinstance(remarks, (list, tuple)):
        return []
    return [remark for remark in remarks if isinstance(remark, str)]
