# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Tables, numbers and figures of an evaluation of localization."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from html import escape
from typing import TYPE_CHECKING

import pytest

from gam_relocalizer.evaluation.localization import (
    Method,
    Outcome,
    RetrievalScore,
    SetEvaluation,
    methods_of,
)
from gam_relocalizer.evaluation.localization_report import (
    DEFAULT_MATCHERS,
    JSON,
    MARKDOWN,
    PAGE,
    PRECISION_RECALL,
    RELIABILITY,
    LocalizationReport,
    as_json,
    markdown,
    write_report,
)
from gam_relocalizer.evaluation.metrics import THRESHOLDS
from gam_relocalizer.geometry import PoseError, rigid3d_from
from gam_relocalizer.localization.result import Status
from gam_relocalizer.matching.registry import MATCHER_NAMES

if TYPE_CHECKING:
    from pathlib import Path

METHODS = methods_of(('nn-ratio', 'gam'))
NAMES = ['SR1', 'SR1', 'IR', 'CC', 'SR']
POSE = rigid3d_from([0.6, 0.0, -0.8, 0.0], [1.0, 2.0, -3.0])


def good(position: float) -> Outcome:
    return Outcome(Status.ACCEPTED, PoseError(position, 10.0 * position), 0.95, 12.0, POSE)


REFUSED = Outcome(Status.UNCERTAIN, PoseError(0.2, 1.0), 0.25, 80.0, POSE)
NO_POSE = Outcome(Status.NO_POSE, None, 0.0, 40.0, None)


def evaluation(
    name: str, *outcomes: Outcome, metric: bool = True, aligned: bool = False, without: int = 0
) -> SetEvaluation:
    """All methods come to the same, but for a first that finds nothing."""
    by_name = {f'{index}.png': outcome for index, outcome in enumerate(outcomes)}
    found: dict[Method, dict[str, Outcome]] = dict.fromkeys(METHODS, by_name)
    found[METHODS[0]] = dict.fromkeys(by_name, NO_POSE)
    retrieval = RetrievalScore(len(outcomes), 0.125, (0.5, *[0.75] * 8, *[1.0] * 11))
    return SetEvaluation(
        name, f'id of {name}', metric, 'vlad', aligned, len(outcomes), without, retrieval, found, {}
    )


ONE = evaluation('one', good(0.02), good(0.08), REFUSED, NO_POSE, without=2)
TWO = evaluation('two', good(0.02), metric=False, aligned=True)


def report_of(*evaluations: SetEvaluation) -> LocalizationReport:
    return LocalizationReport(evaluations, retrieved_images=10)


def sections_of(text: str) -> dict[str, str]:
    return {part.split('\n')[0].split()[0]: part for part in text.split('## ')[1:]}


def rows_of(text: str) -> list[list[str]]:
    """Cells of all rows but the rulers, of all tables."""
    return [
        [cell.strip() for cell in line.strip('|').split('|')]
        for line in text.splitlines()
        if line.startswith('|') and not line.startswith('|---')
    ]


def test_all_poses_and_accepted_poses_have_a_table_each() -> None:
    sections = sections_of(markdown(report_of(ONE)))
    found, accepted = rows_of(sections['All']), rows_of(sections['Accepted'])
    shared = [
        'Coarse', 'Matcher', '0.05 m, 5 deg [%]', '0.1 m, 5 deg [%]', '0.25 m, 2 deg [%]',
        '0.5 m, 5 deg [%]', '5 m, 10 deg [%]', 'Median [m]', 'Median [deg]',
    ]  # fmt: skip
    assert found[0] == [*shared, 'Poses', 'Time [ms]']
    assert accepted[0] == [*shared, 'Worst [m]', 'Worst [deg]', 'Accepted']
    assert [row[:2] for row in found[1:]] == [[m.name, m.matcher] for m in METHODS]
    assert found[1][2:] == ['0.0'] * 5 + ['-', '-', '0/4', '40']
    assert found[5][2:] == [
        '**25.0**', '**50.0**', '**75.0**', '**75.0**', '**75.0**',
        '**0.0800**', '**0.800**', '3/4', '26',
    ]  # fmt: skip
    assert accepted[1][2:] == ['0.0'] * 5 + ['-', '-', '-', '-', '0/4']
    assert accepted[5][2:] == [
        '**25.0**', '**50.0**', '**50.0**', '**50.0**', '**50.0**',
        '**0.0500**', '**0.500**', '**0.080**', '**0.80**', '2/4',
    ]  # fmt: skip


def test_captions_tell_frame_and_what_was_left_out() -> None:
    text = markdown(report_of(ONE, TWO))
    assert 'Map one (metric), R = 10, 4 queries, 2 more images without truth:' in text
    assert 'Map two (not metric, laid over the reference), R = 10, 1 queries:' in text
    assert 'Median [units]' in text


def test_mean_over_sets_comes_first_and_counts_them_alike() -> None:
    sections = sections_of(markdown(report_of(ONE, TWO)))
    found, accepted = rows_of(sections['All']), rows_of(sections['Accepted'])
    assert found[0][2:] == [
        '0.05, 5 deg [%]', '0.1, 5 deg [%]', '0.25, 2 deg [%]', '0.5, 5 deg [%]', '5, 10 deg [%]',
    ]  # fmt: skip
    assert found[5][2:] == ['**62.5**', '**75.0**', '**87.5**', '**87.5**', '**87.5**']
    assert accepted[5][2:] == ['**62.5**', '**75.0**', '**75.0**', '**75.0**', '**75.0**']
    assert 'Mean over 2 sets:' in sections['All']


def test_what_all_methods_share_is_not_bold() -> None:
    alike = evaluation('alike', NO_POSE)
    assert '**' not in markdown(report_of(alike))


def test_retrieval_has_a_row_for_each_map() -> None:
    rows = rows_of(sections_of(markdown(report_of(ONE, TWO)))['Retrieval'])
    assert rows[0][:4] == ['Map', 'Descriptor', 'Queries', 'Covisible [%]']
    assert [cell.split()[0] for cell in rows[0][4:]] == [
        f'Recall@{rank}' for rank in (1, 5, 10, 20)
    ]
    assert rows[1] == ['one', 'vlad', '4', '12.5', '50.0', '75.0', '100.0', '100.0']


def test_confidence_is_that_of_the_whole_method_over_all_sets() -> None:
    section = sections_of(markdown(report_of(ONE, TWO)))['Confidence']
    assert section.startswith('Confidence of SR with gam')
    # the refused pose is correct as well
    assert rows_of(section)[1:] == [
        ['0.2 - 0.3', '0.250', '1.000', '1'],
        ['0.9 - 1.0', '0.950', '1.000', '3'],
    ]
    assert '80.0 % of all queries' in section


def test_confidence_without_poses_is_said() -> None:
    assert 'No pose was found.' in markdown(report_of(evaluation('none', NO_POSE)))


def test_default_matchers_exist_and_end_with_the_one_of_the_paper() -> None:
    assert set(DEFAULT_MATCHERS) <= set(MATCHER_NAMES)
    assert DEFAULT_MATCHERS[-1] == 'gam'


def test_json_holds_every_number() -> None:
    content = json.loads(json.dumps(as_json(report_of(ONE, TWO)), allow_nan=False))
    assert content['retrieved_images'] == 10
    first, second = content['sets']
    methods = first.pop('methods')
    assert [method['name'] for method in methods] == NAMES
    assert first == {
        'name': 'one',
        'map_id': 'id of one',
        'metric': True,
        'global_descriptor': 'vlad',
        'aligned': False,
        'queries': 4,
        'images_without_truth': 2,
        'has_truth': True,
        'others': {},
        'retrieval': {
            'queries': 4, 'covisible': 0.125, 'recall': [0.5, *[0.75] * 8, *[1.0] * 11],
        },
    }  # fmt: skip
    assert (second['metric'], second['aligned']) == (False, True)
    whole = methods[-1]
    assert (whole['coarse'], whole['matcher'], whole['max_scenes']) == ('expanded', 'gam', 5)
    assert whole['found']['recall'] == [
        {'position': one.position, 'rotation_deg': one.rotation_deg, 'recall': share}
        for one, share in zip(THRESHOLDS, (0.25, 0.5, 0.75, 0.75, 0.75), strict=True)
    ]
    assert whole['found']['median_position'] == pytest.approx(0.08)
    assert whole['accepted']['localized'] == 2
    assert whole['worst_position'] == pytest.approx(0.08)
    assert whole['outcomes']['2.png'] == {
        'status': 'UNCERTAIN',
        'position': 0.2,
        'rotation_deg': 1.0,
        'confidence': 0.25,
        'milliseconds': 80.0,
        'camera_from_world': pytest.approx([0.6, 0.0, -0.8, 0.0, 1.0, 2.0, -3.0]),
    }
    assert whole['outcomes']['3.png']['position'] is None
    assert whole['outcomes']['3.png']['camera_from_world'] is None
    assert content['mean'][-1]['accepted'][0]['recall'] == pytest.approx(0.625)
    confidence = content['confidence']
    assert confidence['brier_score'] == pytest.approx((0.75**2 + 3 * 0.05**2) / 4)
    assert confidence['recall_without_error'] == pytest.approx(0.8)
    assert confidence['precision_recall']['thresholds'] == [0.95, 0.25]
    assert [one['count'] for one in confidence['bins']] == [1, 3]


def without_truth(name: str, *outcomes: Outcome) -> SetEvaluation:
    unknown = [replace(one, error=None) for one in outcomes]
    return replace(evaluation(name, *unknown), retrieval=None)


def test_without_truth_there_are_counts_and_nothing_else() -> None:
    text = markdown(report_of(without_truth('day', good(0.1), REFUSED, NO_POSE)))
    assert rows_of(text)[0] == ['Coarse', 'Matcher', 'Poses', 'Accepted', 'Time [ms]']
    assert rows_of(text)[1] == ['SR1', 'nn-ratio', '0/3', '0/3', '40']
    assert rows_of(text)[5] == ['SR', 'gam', '2/3', '1/3', '40']
    assert len(sections_of(text)) == 1


def test_sets_without_truth_change_no_number_of_the_others() -> None:
    both = as_json(report_of(without_truth('day', REFUSED), ONE, TWO))
    scored = as_json(report_of(ONE, TWO))
    assert both['sets'][1:] == scored['sets']
    for key in ('mean', 'confidence'):
        assert both[key] == scored[key]
    both_text, text = (
        markdown(report_of(without_truth('day', REFUSED), ONE)),
        markdown(report_of(ONE)),
    )
    assert both_text.startswith(text)
    assert 'Map day (metric), R = 10, 1 queries:' in both_text


def test_json_without_truth_has_no_recall() -> None:
    content = json.loads(
        json.dumps(as_json(report_of(without_truth('day', good(0.1), NO_POSE))), allow_nan=False)
    )
    assert set(content) == {'kind', 'retrieved_images', 'sets'}
    (only,) = content['sets']
    assert not only['has_truth']
    assert 'retrieval' not in only
    whole = only['methods'][-1]
    assert (whole['queries'], whole['found'], whole['accepted']) == (2, 1, 1)
    assert set(whole) == {
        'name', 'matcher', 'coarse', 'max_scenes',
        'queries', 'found', 'accepted', 'milliseconds', 'outcomes',
    }  # fmt: skip
    assert whole['outcomes']['1.png'] == {
        'status': 'NO_POSE',
        'confidence': 0.0,
        'milliseconds': 40.0,
        'camera_from_world': None,
    }


def test_without_truth_there_are_no_figures_of_the_confidence(tmp_path: Path) -> None:
    write_report(tmp_path, report_of(without_truth('day', good(0.1))))
    names = {path.name for path in tmp_path.iterdir()}
    assert {MARKDOWN, JSON} <= names
    assert not {RELIABILITY, PRECISION_RECALL} & names


def test_others_have_a_row_among_all_poses_and_in_the_mean() -> None:
    errors = {'0.png': PoseError(0.02, 0.1), '1.png': PoseError(0.4, 0.3)}
    one = replace(ONE, others={'hloc': errors})
    two = replace(TWO, others={'hloc': {'0.png': PoseError(0.02, 0.1)}})
    sections = sections_of(markdown(report_of(one, two)))
    mean, first, second = (row for row in rows_of(sections['All']) if row[:2] == ['hloc', '-'])
    assert [float(cell.strip('*')) for cell in mean[2:]] == [62.5, 62.5, 62.5, 75.0, 75.0]
    assert first[2:] == [
        '**25.0**',
        '25.0',
        '25.0',
        '50.0',
        '50.0',
        '0.2100',
        '**0.200**',
        '2/4',
        '-',
    ]
    assert second[-2:] == ['1/1', '-']
    assert 'hloc' not in sections['Accepted']
    content = json.loads(json.dumps(as_json(report_of(one, two)), allow_nan=False))
    assert content['sets'][0]['others']['hloc']['outcomes']['1.png']['position'] == 0.4
    assert content['mean_of_others']['hloc'][0]['recall'] == pytest.approx(0.625)


def test_what_is_not_defined_is_null_in_json() -> None:
    lost = evaluation('lost', NO_POSE)
    content = json.loads(json.dumps(as_json(report_of(lost)), allow_nan=False))
    (only,) = content['sets']
    assert only['methods'][-1]['accepted']['median_position'] is None
    assert only['methods'][-1]['worst_position'] is None
    assert content['confidence']['brier_score'] is None
    assert math.isfinite(only['methods'][-1]['milliseconds'])


def test_writes_files_and_nothing_else(tmp_path: Path) -> None:
    report = report_of(ONE, TWO)
    write_report(tmp_path, report)
    pictures = {RELIABILITY, PRECISION_RECALL, 'errors.png', 'recall.png', 'times.png'}
    assert {path.name for path in tmp_path.iterdir()} == {MARKDOWN, JSON, PAGE, *pictures}
    assert (tmp_path / MARKDOWN).read_text() == markdown(report)
    assert json.loads((tmp_path / JSON).read_text()) == as_json(report)
    for name in pictures:
        assert (tmp_path / name).read_bytes().startswith(b'\x89PNG')


def test_page_tells_what_is_printed(tmp_path: Path) -> None:
    report = report_of(ONE, TWO, without_truth('day', good(0.1)))
    write_report(tmp_path, report)
    text = (tmp_path / PAGE).read_text(encoding='utf-8')
    assert text.count('<img') == len(list(tmp_path.glob('*.png')))
    for line in markdown(report).splitlines():
        if line.startswith('| '):
            for cell in line.strip('|').split('|'):
                assert f'>{escape(cell.strip().strip("*"))}<' in text


def test_page_of_sets_without_truth_is_whole(tmp_path: Path) -> None:
    write_report(tmp_path, report_of(without_truth('day', good(0.1), NO_POSE)))
    text = (tmp_path / PAGE).read_text(encoding='utf-8')
    assert '1 / 2' in text
    assert text.endswith('</html>\n')
