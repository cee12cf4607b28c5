# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""`gam_relocalizer evaluate localization` on every layout, from the import to the last file."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from corner_room import CAMERA
from miniature_datasets import (
    ListedQueries,
    write_aachen,
    write_cambridge,
    write_euroc,
    write_hloc_results,
    write_kitti,
    write_robotcar,
    write_seven_scenes,
    write_tum,
)
from typer.testing import CliRunner

from gam_relocalizer.cameras import format_camera
from gam_relocalizer.cli.evaluate.query_options import QueryOptions, read_query_sets
from gam_relocalizer.cli.main import app
from gam_relocalizer.datasets.layout import Layout
from gam_relocalizer.errors import DatasetError, UsageError
from gam_relocalizer.evaluation.localization import evaluate_set
from gam_relocalizer.evaluation.localization_report import RELIABILITY
from gam_relocalizer.evaluation.submission import SUBMISSION
from gam_relocalizer.features.registry import create_extractor, global_descriptor_of
from gam_relocalizer.geometry import pose_error, read_poses, write_poses
from gam_relocalizer.matching.registry import create_matcher

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from click.testing import Result

    from gam_relocalizer.evaluation.localization import Outcome, SetEvaluation

WRITERS = {
    'cambridge': write_cambridge,
    '7scenes': write_seven_scenes,
    'tum': write_tum,
    'euroc': write_euroc,
    'kitti': write_kitti,
}
# Of every third image.
QUERIES = {'cambridge': 1, '7scenes': 2, 'tum': 3, 'euroc': 3, 'kitti': 3}
# The room is rendered without the distortion that the sensor.yaml of EuRoC and its kind has.
CAMERAS = {'7scenes': format_camera(CAMERA), 'euroc': format_camera(CAMERA)}


@pytest.fixture(scope='module')
def imported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of the train images of one dataset; the others show the same room in its frame."""
    folder = tmp_path_factory.mktemp('imported')
    write_cambridge(folder / 'college')
    done = CliRunner().invoke(
        app,
        [
            *('map', 'import', str(folder / 'college'), '--out', str(folder / 'college.map')),
            *('--spacing', '0', '0', '--max-keypoints', '400', '--discard-work'),
        ],
    )
    assert done.exit_code == 0, done.output
    return folder / 'college.map'


def evaluate(scene_map: Path, *arguments: object) -> Result:
    given = ('--map', scene_map, '--matcher', 'nn-cross', *arguments)
    return CliRunner().invoke(app, ['evaluate', 'localization', *map(str, given)])


def written(scene_map: Path, out: Path, *arguments: object) -> dict[str, Any]:
    done = evaluate(scene_map, *arguments, '--out', out)
    assert done.exit_code == 0, done.output
    assert done.stdout == (out / 'localization.md').read_text()
    content: dict[str, Any] = json.loads((out / 'localization.json').read_text())
    return content


def evaluated(chosen: QueryOptions) -> list[SetEvaluation]:
    """The same without tables and figures."""
    return [
        evaluate_set(
            one,
            create_extractor('xfeat'),
            global_descriptor_of(one.scene_map),
            {'nn-cross': create_matcher('nn-cross')},
            retrieved_images=10,
        )
        for one in read_query_sets(chosen)
    ]


def whole_of(evaluation: SetEvaluation) -> Mapping[str, Outcome]:
    *_, outcomes = evaluation.outcomes.values()
    return outcomes


def listed_arguments(listed: ListedQueries) -> tuple[object, ...]:
    return '--queries', listed.folder, '--query-list', listed.file


@pytest.mark.parametrize('layout', WRITERS)
def test_a_map_is_evaluated_on_each_layout_in_its_frame(
    layout: str, imported: Path, tmp_path: Path
) -> None:
    WRITERS[layout](tmp_path / 'set')
    camera = [CAMERAS[layout]] if layout in CAMERAS else None
    chosen = QueryOptions(
        [imported], dataset=[tmp_path / 'set'], layout=[Layout(layout)], camera=camera, every=3
    )

    (evaluation,) = evaluated(chosen)

    assert (evaluation.metric, evaluation.queries) == (True, QUERIES[layout])
    for outcome in whole_of(evaluation).values():
        assert outcome.error.position < 0.05
        assert outcome.error.rotation_deg < 0.5


def test_a_dataset_and_the_same_images_as_a_folder_score_the_same(
    imported: Path, tmp_path: Path
) -> None:
    folder, truth = tmp_path / 'set', tmp_path / 'truth.txt'
    poses = write_seven_scenes(folder)
    write_poses(truth, {name: poses[name] for name in list(poses)[4:]})

    camera = [format_camera(CAMERA)]
    (as_dataset,) = evaluated(QueryOptions([imported], dataset=[folder], camera=camera))
    (as_folder,) = evaluated(
        QueryOptions([imported], queries=[folder], truth=[truth], camera=camera)
    )

    assert (as_dataset.images_without_truth, as_folder.images_without_truth) == (0, 4)
    assert as_dataset.retrieval == as_folder.retrieval
    again = whole_of(as_folder)
    for name, outcome in whole_of(as_dataset).items():
        assert outcome.error.position == pytest.approx(again[name].error.position, abs=1e-9)


def test_the_submission_holds_the_poses_found(imported: Path, tmp_path: Path) -> None:
    day, night = write_aachen(tmp_path / 'aachen'), write_robotcar(tmp_path / 'robotcar')

    content = written(
        *(imported, tmp_path / 'out', *listed_arguments(day)),
        *('--map', imported, *listed_arguments(night)),
    )

    submitted = read_poses(tmp_path / 'out' / SUBMISSION)
    expected = {
        **{name.split('/')[-1]: pose for name, pose in day.poses.items()},
        **{name.removeprefix('night-rain/'): pose for name, pose in night.poses.items()},
    }
    assert list(submitted) == list(expected)
    for name, pose in expected.items():
        error = pose_error(submitted[name], pose)
        assert error.position < 0.1
        assert error.rotation_deg < 1.0
    in_json = [
        outcome['camera_from_world']
        for one in content['sets']
        for outcome in one['methods'][-1]['outcomes'].values()
    ]
    lines = (tmp_path / 'out' / SUBMISSION).read_text().splitlines()
    for line, pose in zip(lines, in_json, strict=True):
        assert [float(word) for word in line.split()[1:]] == pytest.approx(pose, abs=1e-9)
    assert 'mean' not in content
    assert not (tmp_path / 'out' / RELIABILITY).exists()


def test_a_query_without_a_pose_has_no_line(imported: Path, tmp_path: Path) -> None:
    listed = write_aachen(tmp_path / 'set')
    lost, *found = listed.poses
    blank = (tmp_path / 'set' / lost).with_suffix('.bmp')
    (tmp_path / 'set' / lost).replace(blank)
    _paint_grey(tmp_path / 'set' / lost)

    content = written(imported, tmp_path / 'out', *listed_arguments(listed))

    assert list(read_poses(tmp_path / 'out' / SUBMISSION)) == [
        name.split('/')[-1] for name in found
    ]
    whole = content['sets'][0]['methods'][-1]
    assert (whole['queries'], whole['found']) == (4, 3)
    assert whole['outcomes'][lost]['camera_from_world'] is None


def _paint_grey(path: Path) -> None:
    cv2.imwrite(str(path), np.full((CAMERA.height, CAMERA.width), 90, np.uint8))


def test_poses_that_hloc_found_have_a_row(imported: Path, tmp_path: Path) -> None:
    listed = write_aachen(tmp_path / 'set')
    write_poses(tmp_path / 'truth.txt', listed.poses)
    *found, _ = listed.poses
    write_hloc_results(tmp_path / 'results.txt', {name: listed.poses[name] for name in found})

    content = written(
        *(imported, tmp_path / 'out', *listed_arguments(listed)),
        *('--truth', tmp_path / 'truth.txt', '--results', f'hloc={tmp_path / "results.txt"}'),
    )

    (only,) = content['sets']
    scored = only['others']['hloc']['found']
    assert (scored['queries'], scored['localized']) == (4, 3)
    assert scored['median_position'] == pytest.approx(0.0, abs=1e-6)
    assert [one['recall'] for one in scored['recall']] == [0.75] * 5
    assert '| hloc |' in (tmp_path / 'out' / 'localization.md').read_text()
    assert not (tmp_path / 'out' / SUBMISSION).exists()


@pytest.mark.parametrize(
    'words',
    [
        (),
        ('--queries', 'SET'),
        ('--truth', 'TRUTH'),
        ('--dataset', 'SET', '--queries', 'SET'),
        ('--dataset', 'SET', '--truth', 'TRUTH'),
        ('--dataset', 'SET', '--query-list', 'LIST'),
        ('--dataset', 'SET', '--dataset', 'SET'),
        ('--dataset', 'SET', '--layout', 'tum', '--layout', 'tum'),
        ('--queries', 'SET', '--truth', 'TRUTH', '--results', 'hloc'),
        ('--queries', 'SET', '--truth', 'TRUTH', '--results', '=TRUTH'),
        (
            '--queries',
            'SET',
            '--truth',
            'TRUTH',
            '--results',
            'hloc=TRUTH',
            '--results',
            'hloc=TRUTH',
        ),
        ('--queries', 'SET', '--query-list', 'LIST', '--layout', 'tum'),
        ('--queries', 'SET', '--query-list', 'LIST', '--camera', 'CAMERA'),
        ('--queries', 'SET', '--query-list', 'LIST', '--query-list', 'LIST'),
        ('--queries', 'SET', '--query-list', 'LIST', '--results', 'hloc=TRUTH'),
        ('--query-list', 'LIST'),
    ],
)
def test_options_that_do_not_go_together_are_usage_errors(
    words: tuple[str, ...], imported: Path, tmp_path: Path
) -> None:
    listed = write_aachen(tmp_path / 'set')
    write_poses(tmp_path / 'truth.txt', listed.poses)
    places = {
        'SET': str(listed.folder),
        'LIST': str(listed.file),
        'TRUTH': str(tmp_path / 'truth.txt'),
        'CAMERA': format_camera(CAMERA),
    }
    given = [word.replace('=TRUTH', f'={places["TRUTH"]}') for word in words]
    done = evaluate(imported, *(places.get(word, word) for word in given), '--out', tmp_path / 'o')
    assert isinstance(done.exception, UsageError)
    assert not (tmp_path / 'o').exists()


def test_images_of_one_name_in_a_submission_are_refused_before_any_work(
    imported: Path, tmp_path: Path
) -> None:
    arguments = listed_arguments(write_aachen(tmp_path / 'set'))
    done = evaluate(imported, *arguments, '--map', imported, *arguments, '--out', tmp_path / 'out')
    assert isinstance(done.exception, UsageError)
    assert not (tmp_path / 'out').exists()


def test_a_folder_of_unknown_layout_is_a_dataset_error(imported: Path, tmp_path: Path) -> None:
    assert isinstance(evaluate(imported, '--dataset', tmp_path).exception, DatasetError)
