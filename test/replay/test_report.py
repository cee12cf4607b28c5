# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import base64
from dataclasses import replace
from functools import partial
from html.parser import HTMLParser
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from map_content import changed_map, of_first_images, with_points
from recorded_drive import KnowingLocalizer, map_from_base_at, stamp_of

from gam_relocalizer.localization.result import Status
from gam_relocalizer.plots import png
from gam_relocalizer.replay.figures import error_figure
from gam_relocalizer.replay.replay import ReplayOptions, replay_bag
from gam_relocalizer.replay.report import OVERVIEW, REPORT, Report, report_html, write_report
from gam_relocalizer.replay.summary import Row, row_of

if TYPE_CHECKING:
    from pathlib import Path

    from gam_relocalizer.scene_map import SceneMap

VOID_TAGS = {'meta', 'img'}


class Page(HTMLParser):
    """Checks that tags are balanced, and gathers what a page holds."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str]] = []
        self.images: list[np.ndarray] = []
        self.text: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(name, value or '') for name, value in attrs]
        if tag not in VOID_TAGS:
            self.open.append(tag)
        if tag == 'img':
            source = dict(attrs)['src'] or ''
            kind, data = source.split(',')
            assert kind == 'data:image/png;base64'
            encoded = np.frombuffer(base64.b64decode(data, validate=True), dtype=np.uint8)
            self.images.append(cv2.imdecode(encoded, cv2.IMREAD_COLOR))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)


@pytest.fixture(scope='module')
def report(mcap_drive: Path, wall_map: SceneMap) -> Report:
    localizer = KnowingLocalizer(wall_map.points, refuse=[20], doubt=[40])
    options = ReplayOptions(period=1.0, truth_topic='/ground_truth')
    replay = replay_bag(mcap_drive, localizer, options)
    return Report(
        title='Replay of <drive>',
        rows=[row_of(attempt) for attempt in replay.attempts],
        scene_map=wall_map,
        illustrations=replay.illustrations,
        facts={'bag': 'drive & more'},
    )


@pytest.fixture(scope='module')
def page(report: Report) -> Page:
    return Page(report_html(report))


def test_page_is_balanced_and_holds_its_pictures(page: Page, report: Report) -> None:
    assert page.open == []
    above, side, errors, inliers, verdicts, timings = range(6)
    pictures = [above, side, errors, inliers, verdicts, timings, *report.illustrations]
    assert len(page.images) == len(pictures)
    for image in page.images:
        assert image.std() > 5.0
    assert page.tags.count('tr') > len(report.rows)


def test_refused_image_is_shown_with_its_reason(page: Page, report: Report) -> None:
    assert [timed.stamp_ns for timed in report.illustrations][-1] == stamp_of(40)
    captions = [value for name, value in page.attributes if name == 'alt']
    assert captions[-1] == '4.0 s, AMBIGUOUS, two places look & match alike'


def test_page_loads_nothing_and_runs_nothing(page: Page) -> None:
    assert not {'script', 'link', 'iframe', 'object', 'form'} & set(page.tags)
    for name, value in page.attributes:
        assert not name.startswith('on')
        assert name not in {'src', 'href'} or value.startswith('data:')
        assert 'http' not in value


def test_text_from_outside_is_escaped(page: Page) -> None:
    text = ''.join(page.text)
    for part in ('Replay of <drive>', 'drive & more', 'needs 20 <inliers>', 'look & match'):
        assert part in text


def test_page_tells_every_attempt(page: Page, report: Report) -> None:
    text = '\n'.join(page.text)
    for row in report.rows:
        assert f'{row.stamp_ns / 1e9:.3f}' in text
    assert Status.TOO_FEW_INLIERS.name in text
    assert '8 / 10 (80%)' in text


def test_same_rows_give_the_same_picture(report: Report) -> None:
    first, second = (png(error_figure(report.rows, 'm')) for _ in range(2))
    assert first == second


def rows_without_fix() -> list[Row]:
    return [Row(stamp_of(index), Status.NO_CALIBRATION, 'none') for index in range(3)]


def rows_without_truth(report: Report) -> list[Row]:
    return [replace(row, truth=None) for row in report.rows]


@pytest.mark.parametrize('kind', ['nothing', 'refused', 'refused-with-truth', 'one', 'no-truth'])
def test_report_of_poor_runs_is_whole(report: Report, tmp_path: Path, kind: str) -> None:
    rows = {
        'nothing': [],
        'refused': rows_without_fix(),
        'refused-with-truth': [
            replace(row, truth=map_from_base_at(index))
            for index, row in enumerate(rows_without_fix())
        ],
        'one': list(report.rows[:1]),
        'no-truth': rows_without_truth(report),
    }[kind]
    poor = replace(report, rows=rows, illustrations=())
    write_report(tmp_path, poor)
    assert Page((tmp_path / REPORT).read_text(encoding='utf-8')).open == []
    assert cv2.imread(str(tmp_path / OVERVIEW)) is not None


def test_report_of_a_map_that_is_empty_and_not_metric_is_whole(
    report: Report, tmp_path: Path
) -> None:
    frame = replace(report.scene_map.manifest.frame, metric=False)
    without_points = with_points(
        replace(report.scene_map, manifest=replace(report.scene_map.manifest, frame=frame)),
        np.zeros((0, 3)),
    )
    empty = changed_map(without_points, partial(of_first_images, count=0))
    write_report(tmp_path, replace(report, scene_map=empty, illustrations=()))
    assert 'map units' in (tmp_path / REPORT).read_text(encoding='utf-8')
