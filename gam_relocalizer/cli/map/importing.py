# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`map import`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gam_relocalizer.cli.map.printing import print_table, progress_bars, some_of
from gam_relocalizer.cli.options import GlobalWeightsOption
from gam_relocalizer.datasets.layout import Layout, Split
from gam_relocalizer.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Mapping

    import pycolmap

    from gam_relocalizer.mapping.build import MapBuildOptions
    from gam_relocalizer.mapping.foreign_features import ForeignFeatures
    from gam_relocalizer.mapping.importing import ModelSummary
    from gam_relocalizer.mapping.report import BuildReport


def import_map(  # noqa: PLR0913 - one argument per option
    source: Annotated[
        Path, typer.Argument(help='A folder: a dataset, a COLMAP model or the sfm of hloc.')
    ],
    out: Annotated[Path, typer.Option(help='The map bundle to write; replaced if it is one.')],
    *,
    images: Annotated[
        Path | None,
        typer.Option(help='Of a model: the folder of its images; points are triangulated anew.'),
    ] = None,
    database: Annotated[
        Path | None,
        typer.Option(help='Of a model without images: its database.db with SIFT features.'),
    ] = None,
    features: Annotated[
        Path | None,
        typer.Option(help='Of a model of hloc without images: its .h5 of local features.'),
    ] = None,
    layout: Annotated[
        Layout | None, typer.Option(help='Of a dataset; by default found by its files.')
    ] = None,
    split: Annotated[
        Split | None, typer.Option(help='Of a dataset that has test images; train by default.')
    ] = None,
    spacing: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar='METRES DEGREES',
            help='Of a dataset: an image is taken when the camera moved or turned so much since '
            'the last one; 0 0 takes all. By default it depends on the layout.',
        ),
    ] = None,
    camera: Annotated[
        str,
        typer.Option(
            help="Of a dataset: the camera, instead of the dataset's: `MODEL WIDTH HEIGHT "
            'PARAMS...`, or a file with that line.'
        ),
    ] = '',
    extractor: Annotated[
        str | None,
        typer.Option(help='Local features: xfeat or sift; with --features, what they are.'),
    ] = None,
    max_keypoints: Annotated[
        int, typer.Option(min=1, help='Features per image, where images are read.')
    ] = 2048,
    global_descriptor: Annotated[
        str,
        typer.Option(
            '--global', help='What images are retrieved by: vlad, or netvlad with its weights.'
        ),
    ] = 'vlad',
    global_weights: GlobalWeightsOption = None,
    refine_camera: Annotated[
        bool, typer.Option('--refine-camera', help='Refine the cameras as well.')
    ] = False,
    metric: Annotated[
        bool | None,
        typer.Option(
            help='Whether the unit of the poses is a metre; by default it is for a dataset, and '
            'is not for a model.'
        ),
    ] = None,
) -> None:
    """Makes a map bundle of a dataset with poses, a COLMAP model or an output of hloc."""
    from gam_relocalizer.mapping.build import MapBuildOptions
    from gam_relocalizer.mapping.colmap_model import is_colmap_model
    from gam_relocalizer.mapping.importing import (
        DatasetOptions,
        import_dataset,
        import_model,
        import_model_with_features,
    )
    from gam_relocalizer.mapping.workspace import open_workspace, workspace_of

    of_model = {'--images': images, '--database': database, '--features': features}
    of_dataset = {
        '--layout': layout,
        '--split': split,
        '--spacing': spacing,
        '--camera': camera or None,
    }
    options = MapBuildOptions(
        refine_camera=refine_camera,
        extractor=extractor or MapBuildOptions.extractor,
        max_keypoints=max_keypoints,
        global_descriptor=global_descriptor,
        global_weights=global_weights,
    )
    if not is_colmap_model(source):
        _refuse(of_model, f'{source}: not a COLMAP model (no images.bin or images.txt)')
        dataset = DatasetOptions(
            layout=layout,
            split=split or Split.TRAIN,
            spacing=spacing,
            camera=_parsed(camera),
            metric=metric is not False,
        )
        with open_workspace(workspace_of(out)) as workspace, progress_bars() as progress:
            report = import_dataset(source, out, dataset, options, progress, workspace)
        _print_import(report, None, out)
        return
    _refuse(of_dataset, f'{source}: a COLMAP model, which has cameras and poses of its own')
    _check_one_given(of_model, source)
    if images is not None:
        with open_workspace(workspace_of(out)) as workspace, progress_bars() as progress:
            report, model = import_model(
                source,
                images,
                out,
                options,
                metric=bool(metric),
                progress=progress,
                workspace=workspace,
            )
    else:
        found = _foreign_features(database, features, extractor, options)
        with progress_bars() as progress:
            report, model = import_model_with_features(
                source, found, out, metric=bool(metric), progress=progress
            )
    _print_import(report, model, out)


def _parsed(camera: str) -> pycolmap.Camera | None:
    from gam_relocalizer.cameras import parse_camera

    return parse_camera(camera) if camera else None


def _refuse(options: Mapping[str, object], why: str) -> None:
    given = [name for name, value in options.items() if value is not None]
    if given:
        msg = f'{why}; leave out {" and ".join(given)}'
        raise UsageError(msg)


def _check_one_given(options: Mapping[str, object], source: Path) -> None:
    given = [name for name, value in options.items() if value is not None]
    if len(given) == 1:
        return
    if given:
        msg = f'{source}: give one of {", ".join(given)}'
        raise UsageError(msg)
    msg = (
        f'{source}: a COLMAP model says where its points are, and not what they look like, so that '
        f'no query could recognise them; give its images with --images DIR (the best choice), its '
        f'database with --database FILE, or the features of hloc with --features FILE.h5 '
        f'--extractor NAME'
    )
    raise UsageError(msg)


def _foreign_features(
    database: Path | None,
    features: Path | None,
    extractor: str | None,
    options: MapBuildOptions,
) -> ForeignFeatures:
    from gam_relocalizer.mapping.build import MapBuildOptions
    from gam_relocalizer.mapping.foreign_features import SIFT, DatabaseFeatures, HlocFeatures

    if options != MapBuildOptions(extractor=options.extractor):
        msg = (
            '--max-keypoints, --global, --global-weights and --refine-camera are about images that '
            'are read, and here none are; leave them out'
        )
        raise UsageError(msg)
    if database is not None:
        if extractor not in {None, SIFT}:
            msg = f'--extractor {extractor}: the features of a COLMAP database are sift'
            raise UsageError(msg)
        return DatabaseFeatures(database)
    if extractor is None or features is None:
        msg = '--features needs --extractor, the name of what found them: xfeat or sift'
        raise UsageError(msg)
    return HlocFeatures(features, extractor)


def _print_import(report: BuildReport, model: ModelSummary | None, out: Path) -> None:
    from gam_relocalizer.mapping.workspace import workspace_of

    left_out = {
        'found no place': list(report.unregistered),
        'could not be read': list(report.unreadable),
        'have no pose': list(report.without_pose),
    }
    rows = {
        'images in the map': f'{report.images_registered} of {report.images_given}',
        'points': f'{report.points}',
        'observations': f'{report.observations}, {report.mean_track_length:.1f} per point',
        'mean reprojection error': f'{report.mean_reprojection_error:.2f} px',
        **{f'images that {why}': some_of(names) for why, names in left_out.items() if names},
        **{f'camera {i}': line for i, line in enumerate(report.cameras, start=1)},
        'seconds': ', '.join(f'{step} {spent:.1f}' for step, spent in report.seconds.items()),
    }
    workspace = workspace_of(out)
    if workspace.exists():
        rows['workspace'] = (
            f'{workspace.name}: finished steps, for a further import; may be deleted'
        )
    if model is not None:
        error = model.mean_reprojection_error
        rows['the model had'] = f'{model.images} images, {model.points} points' + (
            f', {error:.2f} px' if error is not None else ''
        )
    print_table(f'{out}', rows)
