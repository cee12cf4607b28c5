# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Finds map_from_sfm for a map and writes it into the map's manifest.

Every alignment starts from the SfM frame. What it does not determine stays as it is: a scale keeps
orientation and origin, levelling keeps the scale.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from gam_relocalizer.alignment.constraints import (
    Constraint,
    Distances,
    GpsFixes,
    Level,
    Markers,
    Picks,
    Poses,
    Positions,
)
from gam_relocalizer.alignment.distances import describe_distance, scale_from_distances
from gam_relocalizer.alignment.geodesy import datum_of, enu_of
from gam_relocalizer.alignment.gravity import (
    Levelled,
    level_reference,
    roll_median_deg,
    stands_upright,
)
from gam_relocalizer.alignment.markers import correspondences, find_markers, scale_from_markers
from gam_relocalizer.alignment.reference import Reference, read_reference, rows_of
from gam_relocalizer.alignment.report import AlignmentReport, Findings, Residual
from gam_relocalizer.alignment.scale import ScaleFit, fit_scale
from gam_relocalizer.alignment.similarity import (
    MIN_PLACES,
    Fit,
    fit_similarity,
    fit_upright,
    fit_with_rotations,
)
from gam_relocalizer.errors import AlignmentError, UsageError
from gam_relocalizer.geometry import rotation_of
from gam_relocalizer.mapping.progress import Progress, ignore_progress
from gam_relocalizer.scene_map import MapFrame, frame_from_sim3d, save_frame

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

# A map whose scale is less certain misleads a planner more than one without.
MAX_SCALE_SIGMA = 0.05
# So large a share of what is given may disagree with a map before something must be said.
MAX_UNUSED = 0.1
_UP = np.array([0.0, 0.0, 1.0])


def align_map(
    path: Path,
    constraint: Constraint,
    *,
    dry_run: bool = False,
    progress: Progress = ignore_progress,
) -> AlignmentReport:
    """Lays a map into the frame that the constraint tells; rewrites its manifest and nothing else.

    Args:
        path: The bundle.
        constraint: What is known of the place; its class is the method.
        dry_run: Find out how well it fits, and write nothing.
        progress: Told of the step markers.

    Raises:
        MapError: The bundle cannot be read.
        UsageError: What is given names no images of the map, or cannot be what it claims to be.
        AlignmentError: It does not determine the frame, contradicts the map, or fits too badly;
            nothing was written.
    """
    reference = read_reference(path)
    report = _align(reference, constraint, progress)
    _refuse_bad(report)
    if dry_run:
        return report
    manifest = save_frame(path, report.frame, report.record())
    return replace(report, written=True, map_id=manifest.map_id)


def _align(  # noqa: PLR0911 - one per method
    reference: Reference, constraint: Constraint, progress: Progress
) -> AlignmentReport:
    match constraint:
        case Poses():
            return _by_poses(reference, constraint)
        case Positions():
            return _by_positions(reference, constraint)
        case GpsFixes():
            return _by_gps(reference, constraint)
        case Distances():
            return _by_distances(reference, constraint)
        case Markers():
            return _by_markers(reference, constraint, progress)
        case Level():
            return _by_level(reference, constraint)
        case Picks():
            return _by_picks(reference, constraint)


def _by_poses(reference: Reference, constraint: Poses) -> AlignmentReport:
    rows, poses, unknown = rows_of(reference, constraint.camera_from_world, MIN_PLACES)
    positions = np.array([pose.tgt_origin_in_src() for pose in poses])
    world_from_camera = Rotation.concatenate([rotation_of(pose).inv() for pose in poses])
    world_from_sfm = world_from_camera * reference.sfm_from_camera[rows].inv()
    fit = fit_with_rotations(reference.positions[rows], positions, world_from_sfm)
    return _fitted('poses', reference, fit, _names(reference, rows), unknown)


def _by_positions(reference: Reference, constraint: Positions) -> AlignmentReport:
    rows, positions, unknown = rows_of(reference, constraint.positions, MIN_PLACES)
    source, target = reference.positions[rows], np.array(positions)
    names = _names(reference, rows)
    if not constraint.level:
        return _fitted('positions', reference, fit_similarity(source, target), names, unknown)
    levelled = level_reference(reference)
    fit = _fit_levelled(levelled.level_from_sfm, source, target)
    report = _fitted('positions + level', reference, fit, names, unknown)
    return replace(report, findings=_with_floor(report.findings, levelled, wanted=False))


def _by_gps(reference: Reference, constraint: GpsFixes) -> AlignmentReport:
    rows, given, _ = rows_of(reference, constraint.fixes, MIN_PLACES)
    fixes = np.array(given)
    datum = constraint.datum or datum_of(fixes)
    places = dict(zip(_names(reference, rows), enu_of(fixes, datum).tolist(), strict=True))
    unknown = tuple(sorted(set(constraint.fixes).difference(places)))
    report = _by_positions(reference, Positions(places, constraint.level))
    method = report.method.replace('positions', 'gps')
    return replace(
        report,
        method=method,
        frame=replace(report.frame, source=_source(method)),
        unknown=unknown,
        findings=replace(report.findings, datum=datum),
    )


def _by_distances(reference: Reference, constraint: Distances) -> AlignmentReport:
    scale = scale_from_distances(reference, constraint.distances)
    names = [describe_distance(one) for one in constraint.distances]
    return _scaled('distances', reference, scale, names, level=constraint.level)


def _by_markers(reference: Reference, constraint: Markers, progress: Progress) -> AlignmentReport:
    if constraint.places is not None and constraint.level:
        msg = 'places of markers say what is up; leave out either them or the levelling'
        raise UsageError(msg)
    found = find_markers(reference, constraint, progress)
    if constraint.places is None:
        scale = scale_from_markers(found, constraint.size)
        names = [f'marker {one.marker} ({len(one.images)} images)' for one in found]
        return _scaled('markers', reference, scale, names, level=constraint.level)
    names, source, target = correspondences(found, constraint.places, constraint.size)
    fit = fit_similarity(source, target)
    missing = set(constraint.places).difference(one.marker for one in found)
    unknown = tuple(f'marker {marker}' for marker in sorted(missing))
    return _fitted('marker places', reference, fit, names, unknown)


def _by_level(reference: Reference, constraint: Level) -> AlignmentReport:
    levelled = level_reference(reference)
    if constraint.camera_height is None:
        frame = reference.scene_map.manifest.frame
        sim3d = _scaled_rigid(levelled.level_from_sfm, frame.scale)
        report = _report('level', reference, sim3d, (), metric=frame.metric)
    else:
        scale = _scale_from_height(levelled, constraint.camera_height)
        sim3d = _scaled_rigid(levelled.level_from_sfm, scale.scale)
        residuals = _residuals(list(reference.names), scale.residuals, None, scale.inliers)
        findings = Findings(scale_sigma=scale.sigma)
        report = _report('level, camera height', reference, sim3d, residuals, findings=findings)
    return replace(report, findings=_with_floor(report.findings, levelled))


def _by_picks(reference: Reference, constraint: Picks) -> AlignmentReport:
    outside = [
        name for name, one in constraint.pixels.items() if not constraint.occupancy.contains(one)
    ]
    if outside:
        height, width = constraint.occupancy.image.shape
        column, row = constraint.pixels[outside[0]]
        msg = (
            f'the pick of `{outside[0]}`, column {column:g} and row {row:g}, is outside of the '
            f'occupancy map, which has {width} columns and {height} rows'
        )
        raise UsageError(msg)
    rows, pixels, unknown = rows_of(reference, constraint.pixels, MIN_PLACES)
    levelled = level_reference(reference) if constraint.level else None
    level_from_sfm = _present_level(reference) if levelled is None else levelled.level_from_sfm
    places = np.c_[constraint.occupancy.map_from_pixels(pixels), np.zeros(len(pixels))]
    fit = _fit_levelled(level_from_sfm, reference.positions[rows], places)
    map_from_sfm = fit.target_from_source
    # picks know nothing of heights: what was z = 0 remains that
    ground = float(map_from_sfm.scale) * float(level_from_sfm.translation[2])
    map_from_sfm.translation = np.array([*map_from_sfm.translation[:2], ground])
    method = 'occupancy picks' if levelled is None else 'occupancy picks + level'
    report = _fitted(method, reference, fit, _names(reference, rows), unknown)
    if levelled is None:
        return report
    return replace(report, findings=_with_floor(report.findings, levelled))


def _scaled(
    method: str,
    reference: Reference,
    scale: ScaleFit,
    names: Sequence[str],
    *,
    level: bool,
) -> AlignmentReport:
    """The report of a method that finds the scale alone."""
    manifest = reference.scene_map.manifest
    warnings: tuple[str, ...] = ()
    if scale.sigma is None:
        warnings = ('a single length checks nothing: measure a second one',)
    findings = Findings(scale_sigma=scale.sigma, warnings=warnings)
    residuals = _residuals(names, scale.residuals, None, scale.inliers)
    if level:
        levelled = level_reference(reference)
        sim3d = _scaled_rigid(levelled.level_from_sfm, scale.scale)
        report = _report(f'{method} + level', reference, sim3d, residuals, findings=findings)
        return replace(report, findings=_with_floor(report.findings, levelled))
    datum = manifest.alignment.get('datum')
    if datum is not None:
        latitude, longitude, altitude = datum
        findings = replace(findings, datum=(latitude, longitude, altitude))
    sim3d = _scaled_rigid(_present_rigid(manifest.frame), scale.scale)
    return _report(method, reference, sim3d, residuals, findings=findings)


def _fitted(
    method: str, reference: Reference, fit: Fit, names: Sequence[str], unknown: tuple[str, ...]
) -> AlignmentReport:
    """The report of a method that finds all of the frame."""
    findings = Findings(scale_sigma=fit.scale_sigma, rotation_sigma_deg=fit.rotation_sigma_deg)
    residuals = _residuals(names, fit.residuals, fit.degrees, fit.inliers)
    report = _report(method, reference, fit.target_from_source, residuals, findings=findings)
    return replace(report, unknown=unknown)


def _report(
    method: str,
    reference: Reference,
    map_from_sfm: pycolmap.Sim3d,
    residuals: tuple[Residual, ...],
    *,
    findings: Findings | None = None,
    metric: bool = True,
) -> AlignmentReport:
    findings = findings or Findings()
    frame = frame_from_sim3d(map_from_sfm, metric=metric, source=_source(method))
    map_from_camera = Rotation.from_quat(np.asarray(map_from_sfm.rotation.quat))
    axes = (map_from_camera * reference.sfm_from_camera).as_matrix()
    warnings = findings.warnings
    if not stands_upright(axes, _UP):
        note = (
            'the cameras are not upright in this frame, and a robot needs z up (REP-103); '
            'levelling afterwards (--level) turns the map and keeps its scale'
        )
        if stands_upright(axes, -_UP):
            note = (
                'the cameras stand on their heads in this frame: its z points down, or it is '
                'left-handed; a robot needs z up (REP-103)'
            )
        warnings = (*warnings, note)
    unused = [one.metres for one in residuals if not one.inlier]
    if len(unused) > MAX_UNUSED * len(residuals):
        note = (
            f'{len(unused)} of {len(residuals)} do not agree with the map, by up to '
            f'{max(unused):.3g} m: either they are wrong, or a part of the map is in a wrong '
            f'place, as where two places look the same; do not run a robot by it before '
            f'`map check` and the pictures of the build have told which'
        )
        warnings = (*warnings, note)
    findings = replace(findings, roll_median_deg=roll_median_deg(axes, _UP), warnings=warnings)
    return AlignmentReport(method, frame, residuals, findings=findings)


def _source(method: str) -> str:
    return f'aligned by {method}'


def _residuals(
    names: Sequence[str],
    metres: NDArray[np.float64],
    degrees: NDArray[np.float64] | None,
    inliers: NDArray[np.bool_],
) -> tuple[Residual, ...]:
    """The worst first."""
    return tuple(
        Residual(
            name=names[row],
            metres=float(metres[row]),
            degrees=None if degrees is None else float(degrees[row]),
            inlier=bool(inliers[row]),
        )
        for row in np.argsort(-metres, kind='stable')
    )


def _with_floor(findings: Findings, levelled: Levelled, *, wanted: bool = True) -> Findings:
    """Tells of the floor; it is wanted where the heights start from it."""
    warnings = findings.warnings
    if wanted and levelled.camera_heights is None:
        note = 'no floor was found: z = 0 is the height of the first camera'
        warnings = (*warnings, note)
    return replace(findings, floor_points=levelled.floor_points, warnings=warnings)


def _scale_from_height(levelled: Levelled, camera_height: float) -> ScaleFit:
    if not (np.isfinite(camera_height) and camera_height > 0.0):
        msg = f'the height of the cameras is {camera_height:g} m; it has to be positive'
        raise UsageError(msg)
    heights = levelled.camera_heights
    if heights is None:
        msg = (
            'no floor was found below the cameras, so their height tells no scale; give a '
            'distance (--distances) with --level'
        )
        raise AlignmentError(msg)
    scale = fit_scale(heights, np.full(len(heights), camera_height))
    # all heights share the error of the floor, which may be all of its roughness
    of_floor = levelled.floor_roughness / float(np.median(heights))
    return replace(scale, sigma=math.hypot(scale.sigma or 0.0, of_floor))


def _fit_levelled(
    level_from_sfm: pycolmap.Rigid3d, source: NDArray[np.float64], target: NDArray[np.float64]
) -> Fit:
    """As `fit_upright`, from the SfM frame."""
    fit = fit_upright(np.asarray(level_from_sfm * source), target)
    target_from_sfm = fit.target_from_source * _scaled_rigid(level_from_sfm, 1.0)
    return replace(fit, target_from_source=target_from_sfm)


def _present_level(reference: Reference) -> pycolmap.Rigid3d:
    """The present frame, when the cameras are upright in it.

    Raises:
        AlignmentError: They are not.
    """
    rigid = _present_rigid(reference.scene_map.manifest.frame)
    if not stands_upright((rotation_of(rigid) * reference.sfm_from_camera).as_matrix(), _UP):
        msg = (
            'the map is not level, which picks in an occupancy map cannot mend: add --level, or '
            'align the map by --poses first'
        )
        raise AlignmentError(msg)
    return rigid


def _present_rigid(frame: MapFrame) -> pycolmap.Rigid3d:
    """The present frame in SfM units."""
    map_from_sfm = frame.map_from_sfm
    return pycolmap.Rigid3d(map_from_sfm.rotation, map_from_sfm.translation / frame.scale)


def _scaled_rigid(level_from_sfm: pycolmap.Rigid3d, scale: float) -> pycolmap.Sim3d:
    """Turns and shifts, then enlarges about the origin."""
    return pycolmap.Sim3d(
        float(scale), level_from_sfm.rotation, float(scale) * level_from_sfm.translation
    )


def _names(reference: Reference, rows: Sequence[int]) -> list[str]:
    return [reference.names[row] for row in rows]


def _refuse_bad(report: AlignmentReport) -> None:
    """Refuses a frame that would mislead whoever uses the map.

    Raises:
        AlignmentError: What is wrong, and what to do.
    """
    worst = ', '.join(f'`{one.name}` {one.metres:.3g} m' for one in report.residuals[:3])
    if 2 * report.inliers < len(report.residuals):
        msg = (
            f'only {report.inliers} of {len(report.residuals)} agree with each other; worst are '
            f'{worst}: check that they belong to this map, and that names are right'
        )
        raise AlignmentError(msg)
    sigma = report.findings.scale_sigma
    if sigma is not None and sigma > MAX_SCALE_SIGMA:
        msg = (
            f'the scale is uncertain by {100 * sigma:.1f} %, more than {100 * MAX_SCALE_SIGMA:.0f} '
            f'%; worst are {worst}: give more of them, more precise ones, or such that lie further '
            f'apart'
        )
        raise AlignmentError(msg)
