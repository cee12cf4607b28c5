# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Poses files of the long-term visual localization benchmark."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st
from miniature_datasets import pose, same_poses, write_aachen, write_hloc_results, write_robotcar

from gam_relocalizer.errors import PosesFileError, UsageError
from gam_relocalizer.evaluation.submission import read_results, submission_names
from gam_relocalizer.geometry import write_poses

if TYPE_CHECKING:
    from pathlib import Path


def test_aachen_wants_base_names_and_robotcar_the_camera_too(tmp_path: Path) -> None:
    by_list = submission_names(
        [*write_aachen(tmp_path / 'a').poses, *write_robotcar(tmp_path / 'r').poses]
    )

    assert by_list == {
        'query/day/milestone/IMG_1.png': 'IMG_1.png',
        'query/day/milestone/IMG_3.png': 'IMG_3.png',
        'query/day/milestone/IMG_5.png': 'IMG_5.png',
        'query/night/nexus5x/IMG_6.png': 'IMG_6.png',
        'night-rain/rear/1417176976842290.png': 'rear/1417176976842290.png',
        'night-rain/left/1417176976842290.png': 'left/1417176976842290.png',
    }


@pytest.mark.parametrize(
    'names', [('day/1.jpg', 'night/1.jpg'), ('sun/rear/1.jpg', 'rain/rear/1.jpg')]
)
def test_two_images_of_one_name_cannot_be_handed_in(names: tuple[str, str]) -> None:
    with pytest.raises(UsageError):
        submission_names(names)


PARTS = st.sampled_from(['day', 'night', 'rear', 'left', '1.jpg', '2.jpg', '3.jpg'])


@given(st.lists(st.lists(PARTS, min_size=1, max_size=4).map('/'.join), unique=True))
def test_submitted_names_are_ends_of_the_queries_and_differ(names: list[str]) -> None:
    try:
        submitted = submission_names(names)
    except UsageError:
        return
    assert list(submitted) == names
    assert len(set(submitted.values())) == len(names)
    for name, end in submitted.items():
        assert f'/{name}'.endswith(f'/{end}')


def test_results_of_hloc_go_by_base_names(tmp_path: Path) -> None:
    poses = write_aachen(tmp_path).poses
    write_hloc_results(tmp_path / 'results.txt', {**poses, 'other/IMG_9.png': pose(0)})

    assert same_poses(read_results(tmp_path / 'results.txt', poses), poses)


def test_results_may_name_the_camera_or_the_whole(tmp_path: Path) -> None:
    poses = write_robotcar(tmp_path).poses
    whole, ending = poses
    write_poses(
        tmp_path / 'results.txt',
        {whole: poses[whole], ending.removeprefix('night-rain/'): poses[ending]},
    )

    assert same_poses(read_results(tmp_path / 'results.txt', poses), poses)


@pytest.mark.parametrize(
    'written',
    [
        ('1417176976842290.png',),
        ('rear/1417176976842290.png', 'night-rain/rear/1417176976842290.png'),
        ('other.png',),
    ],
)
def test_results_that_fit_no_query_or_several_are_usage_errors(
    written: tuple[str, ...], tmp_path: Path
) -> None:
    poses = write_robotcar(tmp_path).poses
    write_poses(tmp_path / 'results.txt', dict.fromkeys(written, pose(0)))

    with pytest.raises(UsageError, match=r'results\.txt'):
        read_results(tmp_path / 'results.txt', poses)


@pytest.mark.parametrize('line', ['IMG_1.png 1 0 0 0 0 0 nan', 'IMG_1.png 1 0 0', 'IMG_1.png'])
def test_results_that_are_no_poses_are_refused_with_their_line(line: str, tmp_path: Path) -> None:
    (tmp_path / 'results.txt').write_text(f'{line}\n')

    with pytest.raises(PosesFileError, match=r'results\.txt:1'):
        read_results(tmp_path / 'results.txt', ['IMG_1.png'])
