# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Tables, numbers, figure and page of an evaluation of running time."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from gam_relocalizer.evaluation.timing import Components, Method, Run, SetTiming
from gam_relocalizer.evaluation.timing_report import (
    FIGURE,
    JSON,
    MARKDOWN,
    PAGE,
    TimingReport,
    as_json,
    figure,
    html,
    markdown,
    write_report,
)
from gam_relocalizer.geometry import PoseError

if TYPE_CHECKING:
    from pathlib import Path

MACHINE = {'CPU': 'A <fast> one', 'cores': '2'}


def run_of(elapsed: float, position: float | None, *, accepted: bool | None = None) -> Run:
    """60 ms of description, and a sixth of the rest for the verdict where there is one."""
    error = None if position is None else PoseError(position, 10.0 * position)
    verdict = 0.0 if accepted is None else elapsed / 6.0
    parts = 50.0, 10.0, 0.0, elapsed - verdict, 0.0, verdict
    return Run(error, accepted, Components(*parts, total=sum(parts)))


def timing_of(name: str, slower: float, *, images: bool = True) -> SetTiming:
    """Three queries; image matching takes so many times as long per retrieved image."""
    scenes = {
        'a.png': run_of(12.0, 0.02, accepted=True),
        'b.png': run_of(18.0, 0.06, accepted=True),
        'c.png': run_of(60.0, 0.4, accepted=False),
    }
    runs: dict[Method, dict[int, dict[str, Run]]] = {Method.SCENES: {1: scenes, 10: scenes}}
    if images:
        runs[Method.IMAGES] = {
            count: {
                'a.png': run_of(count * slower * 1.2, 0.03),
                'b.png': run_of(count * slower * 1.8, 0.09),
                'c.png': run_of(count * slower * 6.0, None),
            }
            for count in (1, 10)
        }
    return SetTiming(
        name, f'id of {name}', metric=True, aligned=False, extractor='xfeat',
        global_descriptor='vlad', images=12, images_without_truth=1, runs=runs,
    )  # fmt: skip


ONE = timing_of('one', slower=20.0)
TWO = replace(timing_of('two', slower=5.0), metric=False, aligned=True)


def report_of(*timings: SetTiming) -> TimingReport:
    return TimingReport(timings, MACHINE)


def sections_of(text: str) -> dict[str, str]:
    return {part.split('\n')[0]: part for part in text.split('## ')[1:]}


def rows_of(text: str) -> list[list[str]]:
    """Cells of all rows but the rulers, of all tables."""
    return [
        [cell.strip() for cell in line.strip('|').split('|')]
        for line in text.splitlines()
        if line.startswith('|') and not line.startswith('|---')
    ]


def test_components_are_averaged_over_the_queries() -> None:
    rows = rows_of(sections_of(markdown(report_of(ONE)))['Running time'])
    assert rows == [
        [
            'Map', 'Average', 'Local features [ms]', 'Global descriptor [ms]',
            'Scene retrieval [ms]', 'Matching [ms]', 'Pose [ms]', 'Verdict [ms]', 'Total [ms]',
        ],
        ['one', 'mean', '50.0', '10.0', '0.0', '25.0', '0.0', '5.0', '90.0'],
        ['one', 'median', '50.0', '10.0', '0.0', '15.0', '0.0', '3.0', '78.0'],
    ]  # fmt: skip


def test_times_faster_stand_beside_what_they_cost() -> None:
    sections = sections_of(markdown(report_of(ONE, TWO)))
    _, one, two, mean = rows_of(sections['Image matching against the localizer'])
    # mean 600 : 25, median 360 : 15; with the verdict 30 and 18; whole 660 : 90 and 420 : 78
    assert one == [
        'one', '24.0', '24.0', '20.0', '20.0', '7.3', '5.4', '0.0600 / 0.0600 m', '0.600 / 0.600',
        '33 / 33, 67 / 67, 67 / 67, 100 / 67, 100 / 67',
    ]  # fmt: skip
    assert two[:5] == ['two', '6.0', '6.0', '5.0', '5.0']
    assert two[7].endswith('units')
    assert mean[:5] == ['geometric mean', '12.0', '12.0', '10.0', '10.0']


def test_curves_have_a_row_per_count_and_method() -> None:
    sections = sections_of(markdown(report_of(ONE)))
    section = sections['Number of retrieved images']
    header, *rows = rows_of(section)
    assert [row[:2] for row in rows] == [
        [count, method.value] for count in ('1', '10') for method in Method
    ]
    assert header[2] == 'Median [m]'
    assert rows[0][2:4] == ['0.0600', '0.600']
    assert rows[0][-4:] == ['3/3', '2/3', '30', '18']
    assert rows[3][-4:] == ['2/3', '', '600', '360']
    assert 'Map one (metric; 12 images, xfeat, vlad), 3 queries, 1 more images without' in section


def test_without_image_matching_there_is_nothing_to_compare() -> None:
    report = report_of(timing_of('alone', 1.0, images=False))
    sections = sections_of(markdown(report))
    assert list(sections) == ['Running time', 'Number of retrieved images']
    assert [row[1] for row in rows_of(sections['Number of retrieved images'])[1:]] == [
        Method.SCENES.value
    ] * 2
    content = as_json(report)
    assert content['mean_speedup'] is None
    assert content['sets'][0]['speedup'] is None


def test_json_holds_every_run() -> None:
    content = json.loads(json.dumps(as_json(report_of(ONE, TWO)), allow_nan=False))
    assert content['machine'] == MACHINE
    assert content['compared_retrieved_images'] == 10
    assert content['mean_speedup']['elapsed']['mean'] == pytest.approx(10.0)
    one, two = content['sets']
    assert (one['name'], one['map_id'], two['aligned']) == ('one', 'id of one', True)
    assert one['components']['matching'] == pytest.approx({'mean': 25.0, 'median': 15.0})
    assert one['speedup']['elapsed'] == pytest.approx({'mean': 20.0, 'median': 20.0})
    assert [(m['name'], m['retrieved_images']) for m in one['methods']] == [
        (method.value, count) for method in Method for count in (1, 10)
    ]
    last = one['methods'][-1]
    assert last['found']['localized'] == 2
    assert last['found']['recall'][-1]['recall'] == pytest.approx(2 / 3)
    missed = last['queries']['c.png']
    assert (missed['position'], missed['accepted']) == (None, None)
    assert missed['milliseconds']['total'] == pytest.approx(1260.0)


def test_medians_of_nothing_are_no_numbers() -> None:
    lost = {'a.png': run_of(10.0, None, accepted=False)}
    report = report_of(replace(ONE, runs={Method.SCENES: {10: lost}}))
    (_, row) = rows_of(sections_of(markdown(report))['Number of retrieved images'])
    assert row[2:4] == ['-', '-']
    assert as_json(report)['sets'][0]['methods'][0]['found']['median_position'] is None


def test_figure_shows_errors_and_times_of_both_methods() -> None:
    drawn = figure([ONE, TWO])
    assert len(drawn.axes) == 6
    over_time, time_over_count, error_over_count = (
        [line.get_xydata().tolist() for line in axes.get_lines()] for axes in drawn.axes[:3]
    )
    assert over_time[1] == [pytest.approx((60.0, 0.06)), pytest.approx((600.0, 0.06))]
    assert time_over_count[0] == [pytest.approx((1, 30.0)), pytest.approx((10, 30.0))]
    assert error_over_count[1] == [pytest.approx((1, 0.06)), pytest.approx((10, 0.06))]


def test_everything_is_written_and_nothing_else(tmp_path: Path) -> None:
    report = report_of(ONE)
    write_report(tmp_path, report)
    assert {path.name for path in tmp_path.iterdir()} == {MARKDOWN, JSON, FIGURE, PAGE}
    assert (tmp_path / MARKDOWN).read_text() == markdown(report)
    assert json.loads((tmp_path / JSON).read_text()) == as_json(report)
    assert (tmp_path / FIGURE).read_bytes().startswith(b'\x89PNG')
    assert (tmp_path / PAGE).read_text() == html(report)


def test_page_holds_all_tables_and_says_where_it_was_measured() -> None:
    page = html(report_of(ONE))
    assert page.count('<table') == 3
    assert page.count('data:image/png') == 1
    assert 'A &lt;fast&gt; one' in page
    for value in ('20.0', '78.0', '360'):
        assert f'>{value}<' in page
