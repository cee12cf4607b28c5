# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`map import`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gam_relocalizer.cli.map.printing import (
    BitsOption,
    DiscardOption,
    OutOption,
    print_build,
    progress_bars,
)
from gam_relocalizer.cli.options import GlobalWeightsOption
from gam_relocalizer.datasets.layout import Layout, Split
from gam_relocalizer.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Mapping

    import pycolmap

    from gam_relocalizer.mapping.build import MapBuildOptions
    from gam_relocalizer.mapping.foreign_features import ForeignFeatures
    from gam_relocalizer.mapping.importing import ModelSummary


def import_map(  # noqa: PLR0913 - one argument per option
    source: Annotated[
        Path, typer.Argument(help='A folder: a dataset, a COLMAP model or the sfm of hloc.')
    ],
    out: OutOption,
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
        typer.Option(help='Local features, such as xfeat or sift; with --features, what they are.'),
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
    descriptor_bits: BitsOption = 16,
    discard_work: DiscardOption = False,
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
    from gam_relocalizer.mapping.pictures import write_build_report
    from gam_relocalizer.mapping.workspace import open_workspace, report_of, workspace_of

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
        descriptor_bits=descriptor_bits,
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
        with open_workspace(workspace_of(out)) as workspace:
            with progress_bars() as progress:
                report = import_dataset(source, out, dataset, options, progress, workspace)
            if discard_work:
                workspace.discard()
            print_build(report, out, workspace)
        write_build_report(out, report, report_of(out))
        return
    _refuse(of_dataset, f'{source}: a COLMAP model, which has cameras and poses of its own')
    _check_one_given(of_model, source)
    if images is not None:
        with open_workspace(workspace_of(out)) as workspace:
            with progress_bars() as progress:
                report, model = import_model(
                    source,
                    images,
                    out,
                    options,
                    metric=bool(metric),
                    progress=progress,
                    workspace=workspace,
                )
            if discard_work:
                workspace.discard()
            print_build(report, out, workspace, _of_model(model))
    else:
        if discard_work:
            msg = '--discard-work: an import that reads no images leaves no work; leave it out'
            raise UsageError(msg)
        found = _foreign_features(database, features, extractor, options)
        with progress_bars() as progress:
            report, model = import_model_with_features(
                source,
                found,
                out,
                metric=bool(metric),
                descriptor_bits=descriptor_bits,
                progress=progress,
            )
        print_build(report, out, None, _of_model(model))
    write_build_report(out, report, report_of(out))


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

    of_no_image = MapBuildOptions(
        extractor=options.extractor, descriptor_bits=options.descriptor_bits
    )
    if options != of_no_image:
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
        msg = '--features needs --extractor, the name of what found them, such as sift'
        raise UsageError(msg)
    return HlocFeatures(features, extractor)


def _of_model(model: ModelSummary) -> dict[str, str]:
    """What there was before the import, as a row."""
    error = model.mean_reprojection_error
    fits = f', {error:.2f} px' if error is not None else ''
    return {'the model had': f'{model.images} images, {model.points} points{fits}'}
