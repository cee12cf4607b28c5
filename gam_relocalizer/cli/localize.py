# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`gam_relocalizer localize`: the poses of images in a map."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import track
from rich.table import Table

from gam_relocalizer.cameras import parse_camera
from gam_relocalizer.cli.options import (
    DEFAULT_MATCHER,
    GlobalWeightsOption,
    MatcherOption,
    WeightsOption,
)
from gam_relocalizer.errors import ImageError, UsageError
from gam_relocalizer.geometry import (
    pose_error,
    quaternion_wxyz,
    read_poses,
    write_poses,
    write_text,
)
from gam_relocalizer.images import list_images, read_image

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import pycolmap

    from gam_relocalizer.evaluation.metrics import Accuracy
    from gam_relocalizer.localization.localizer import Localizer
    from gam_relocalizer.localization.prior import Prior
    from gam_relocalizer.localization.result import LocalizationResult, Timings

STAGES = ('extraction', 'retrieval', 'matching', 'pose', 'verdict', 'total')


@dataclass(frozen=True)
class Query:
    """One image and what came of it."""

    name: str
    result: LocalizationResult


def localize(  # noqa: PLR0913 - the options of the command
    images: Annotated[
        list[Path],
        typer.Argument(help='Images, or folders of images.', metavar='IMAGES_OR_DIR...'),
    ],
    *,
    map_path: Annotated[Path, typer.Option('--map', help='Map bundle to localize in.')],
    camera: Annotated[
        str, typer.Option(help='File or text `MODEL WIDTH HEIGHT PARAMS...`, the form of COLMAP.')
    ],
    out: Annotated[Path, typer.Option(help='Accepted poses, lines `name qw qx qy qz tx ty tz`.')],
    jsonl: Annotated[
        Path | None, typer.Option(help='Every image with status, numbers and covariance.')
    ] = None,
    truth: Annotated[
        Path | None, typer.Option(help='True poses in the form of OUT; prints the errors.')
    ] = None,
    matcher: MatcherOption = DEFAULT_MATCHER,
    weights: WeightsOption = None,
    global_weights: GlobalWeightsOption = None,
    near: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            help='Where in the map the camera is thought to be. It is looked for there first, then '
            'everywhere.',
            metavar='X Y Z',
        ),
    ] = None,
    radius: Annotated[
        float | None, typer.Option(help='How far off that may be, in units of the map.')
    ] = None,
) -> None:
    """Localize images in a map; the poses are camera_from_map.

    An image of a folder is named by its path relative to the folder, a single image by its file
    name. Images that are refused are no failure of the command: their reasons are in JSONL.
    """
    from gam_relocalizer.localization.localizer import Localizer, LocalizerOptions

    parsed_camera, prior = parse_camera(camera), _prior(near, radius)
    files = _named_files(images)
    true_poses = None if truth is None else read_poses(truth)
    for output in filter(None, (out, jsonl)):
        _prepare_output(output)
    options = LocalizerOptions(matcher=matcher, weights=weights, global_weights=global_weights)
    localizer = Localizer.load(map_path, options)
    queries = [
        Query(name, _localize_file(localizer, file, parsed_camera, prior))
        for name, file in track(files.items(), description='localizing', transient=True)
    ]
    poses = _accepted_poses(queries)
    write_poses(out, poses)
    if jsonl is not None:
        write_text(jsonl, ''.join(f'{json.dumps(json_row(query))}\n' for query in queries))
    _print_summary(queries)
    if true_poses is not None:
        _print_accuracy(poses, {name: true_poses[name] for name in files if name in true_poses})


def json_row(query: Query) -> dict[str, Any]:
    """One image of the JSON lines file; `camera_from_map` is there when the pose was accepted."""
    result = query.result
    timings = {stage: round(float(getattr(result.timings, stage)), 3) for stage in STAGES}
    row: dict[str, Any] = {
        'name': query.name,
        'status': result.status.name,
        'reason': result.reason,
        'keypoints': result.keypoints,
        'matches': result.matches,
        'inliers': result.inliers,
        'scene': result.scene,
        'scenes_tried': result.scenes_tried,
        'confidence': result.confidence,
        'timings_ms': timings,
    }
    if result.estimate is not None:
        row |= {
            'inlier_ratio': result.estimate.inlier_ratio,
            'coverage': result.estimate.coverage,
            'reprojection_error': result.estimate.reprojection_error,
            'covariance': result.estimate.covariance.ravel().tolist(),
        }
        if result.accepted:
            camera_from_map = result.estimate.camera_from_map
            row['camera_from_map'] = [
                *quaternion_wxyz(camera_from_map).tolist(),
                *camera_from_map.translation.tolist(),
            ]
    return row


def _named_files(images: Sequence[Path]) -> dict[str, Path]:
    """Files to read by the name they are reported under, in the order given."""
    files: dict[str, Path] = {}
    for path in images:
        if not path.exists():
            msg = f'{path}: no such image or folder'
            raise UsageError(msg)
        found = (
            {name: path / name for name in list_images(path)}
            if path.is_dir()
            else {path.name: path}
        )
        repeated = sorted(files.keys() & found.keys())
        if repeated:
            msg = (
                f'{path}: image `{repeated[0]}` would be reported under the same name as '
                f'{files[repeated[0]]}; localize them in separate runs'
            )
            raise UsageError(msg)
        files |= found
    return files


def _prepare_output(path: Path) -> None:
    if path.is_dir():
        msg = f'{path}: is a folder; expected the name of a file to write'
        raise UsageError(msg)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as err:
        msg = f'{path}: its folder cannot be made: {err.strerror}'
        raise UsageError(msg) from err


def _prior(near: tuple[float, float, float] | None, radius: float | None) -> Prior:
    from gam_relocalizer.localization.prior import PositionHint, Prior

    if near is None and radius is None:
        return Prior()
    if near is None or radius is None:
        msg = '--near and --radius go together; give both, for example `--near 1 2 0 --radius 3`'
        raise UsageError(msg)
    return Prior(hint=PositionHint(np.array(near), radius))


def _localize_file(
    localizer: Localizer, file: Path, camera: pycolmap.Camera, prior: Prior
) -> LocalizationResult:
    from gam_relocalizer.localization.result import LocalizationResult, Status

    try:
        image = read_image(file)
    except ImageError as err:
        return LocalizationResult(Status.UNDECODABLE_IMAGE, str(err))
    return localizer.localize(image, camera, prior)


def _accepted_poses(queries: Sequence[Query]) -> dict[str, pycolmap.Rigid3d]:
    return {
        query.name: query.result.estimate.camera_from_map
        for query in queries
        if query.result.accepted and query.result.estimate is not None
    }


def _print_summary(queries: Sequence[Query]) -> None:
    table = Table(title='Localization', show_header=False)
    statuses = Counter(query.result.status for query in queries)
    for status, count in sorted(statuses.items(), key=lambda item: item[0].value):
        table.add_row(status.name, f'{count} of {len(queries)}')
    table.add_section()
    timings = [query.result.timings for query in queries]
    for stage in STAGES:
        table.add_row(f'{stage}, median', f'{_median_ms(timings, stage):.1f} ms')
    Console().print(table)


def _median_ms(timings: Sequence[Timings], stage: str) -> float:
    return float(np.median([getattr(timing, stage) for timing in timings]))


def _print_accuracy(
    poses: Mapping[str, pycolmap.Rigid3d], truth: Mapping[str, pycolmap.Rigid3d]
) -> None:
    from gam_relocalizer.evaluation.metrics import accuracy

    errors = [pose_error(poses[name], truth[name]) for name in truth if name in poses]
    Console().print(_accuracy_table(accuracy(errors, queries=len(truth))))


def _accuracy_table(found: Accuracy) -> Table:
    table = Table(title='Errors against the truth (units of the map)', show_header=False)
    table.add_row('localized', f'{found.localized} of {found.queries} with known truth')
    table.add_row('median position', f'{found.median_position:.4f}')
    table.add_row('median rotation', f'{found.median_rotation_deg:.3f} deg')
    for threshold, share in found.recall.items():
        within = f'{threshold.position:g} / {threshold.rotation_deg:g} deg'
        table.add_row(f'recall within {within}', f'{share:.1%}')
    return table
