# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Tables, numbers and the figure over k."""

from __future__ import annotations

import json
import math
from html import escape
from typing import TYPE_CHECKING

import numpy as np
import pytest

from gam_relocalizer.evaluation.matching import (
    TRUE_CANDIDATES,
    EvaluationOptions,
    MapEvaluation,
    MapScore,
    Score,
    mean_over_maps,
)
from gam_relocalizer.evaluation.matching_report import (
    DEFAULT_MATCHERS,
    FIGURE,
    JSON,
    MARKDOWN,
    PAGE,
    SHARES,
    MatchingReport,
    as_json,
    markdown,
    write_report,
)
from gam_relocalizer.evaluation.neighbours import CANDIDACIES, curves_of, neighbours_figure
from gam_relocalizer.matching.registry import MATCHER_NAMES

if TYPE_CHECKING:
    from pathlib import Path


def score(precision: float, position: float) -> MapScore:
    return MapScore(
        precision=precision,
        recall=0.25,
        geometric_precision=0.5,
        geometric_recall=0.75,
        matches=123.4,
        poses=1.0,
        position_permille=10.0 * position,
        rotation_deg=position / 10.0,
        position=position,
    )


def evaluation(name: str, scores: dict[str, MapScore], without: int = 0) -> MapEvaluation:
    bounded = {**scores, TRUE_CANDIDATES: score(1.0, 0.05)}
    return MapEvaluation(name, f'id of {name}', name == 'metric', 12, without, bounded)


def report_of(*evaluations: MapEvaluation, swept: str | None = None) -> MatchingReport:
    names = [name for name in evaluations[0].scores if name in MATCHER_NAMES]
    return MatchingReport(evaluations, names, EvaluationOptions(), swept)


def rows_of(text: str) -> list[list[str]]:
    """Cells of all rows but the rulers, of all tables."""
    return [
        [cell.strip() for cell in line.strip('|').split('|')]
        for line in text.splitlines()
        if line.startswith('|') and not line.startswith('|---')
    ]


def test_table_of_one_map() -> None:
    scores = {'nn-cross': score(0.401, 0.2), 'nn-ratio': score(0.5, 0.25)}
    text = markdown(report_of(evaluation('metric', scores)))
    assert rows_of(text) == [
        [
            'Matcher', 'M.Precision [%]', 'M.Recall [%]', 'G.Precision [%]',
            'G.Recall [%]', 'Matches', 'MPE [m]', 'MPE [‰ of depth]', 'MRE [deg]',
        ],
        [
            'nn-ratio', '**50.0**', '**25.0**', '**50.0**', '**75.0**', '123',
            '0.25000', '2.500', '0.0250',
        ],
        [
            'nn-cross', '40.1', '**25.0**', '**50.0**', '**75.0**', '123',
            '**0.20000**', '**2.000**', '**0.0200**',
        ],
        [TRUE_CANDIDATES, '100.0', '25.0', '50.0', '75.0', '123', '0.05000', '0.500', '0.0050'],
    ]  # fmt: skip
    assert 'metric (metric), 12 images:' in text


def test_maps_without_scale_have_no_metres() -> None:
    text = markdown(report_of(evaluation('free', {'gam': score(0.5, 0.1)}, without=2)))
    assert 'MPE [map units]' in text
    assert 'free (not metric), 12 images, 2 more without' in text


def test_mean_over_maps_comes_first_and_has_no_unit_of_a_map() -> None:
    text = markdown(
        report_of(
            evaluation('metric', {'gam': score(0.4, 0.1)}),
            evaluation('free', {'gam': score(0.6, 0.3)}),
        )
    )
    head, mean, *_ = rows_of(text)
    assert head[6:] == ['MPE [‰ of depth]', 'MRE [deg]']
    assert mean == ['gam', '50.0', '25.0', '50.0', '75.0', '123', '2.000', '0.0200']


def test_matchers_stand_in_the_tables_of_the_paper() -> None:
    scores = {
        name: score(0.5, 0.1)
        for name in ('knn-bmnet', 'bmnet', 'plainnet', 'bmnet-small', 'nn-ratio')
    }
    text = markdown(report_of(evaluation('metric', scores)))
    sections = {part.split('\n')[0]: part for part in text.split('## ')[1:]}
    names = {title: [row[0] for row in rows_of(part)[1:-1]] for title, part in sections.items()}
    assert names == {
        '2D-3D matching': ['nn-ratio', 'bmnet'],
        'Ablation study': ['plainnet', 'bmnet-small'],
        'Other matchers': ['knn-bmnet'],
    }


def test_default_matchers_exist() -> None:
    assert set(DEFAULT_MATCHERS) <= set(MATCHER_NAMES)


def test_no_pose_is_infinite_in_tables_and_null_in_json() -> None:
    report = report_of(evaluation('metric', {'gam': score(0.5, math.inf)}))
    assert rows_of(markdown(report))[1][6:] == ['∞', '∞', '∞']
    content = json.loads(json.dumps(as_json(report), allow_nan=False))
    assert content['maps'][0]['matchers']['gam']['position'] is None


def test_json_holds_every_number() -> None:
    report = report_of(
        evaluation('metric', {'gam': score(0.4, 0.1)}, without=3),
        evaluation('free', {'gam': score(0.6, 0.3)}),
    )
    content = as_json(report)
    assert content['maps'][0].pop('matchers')['gam'] == {
        'precision': 0.4,
        'recall': 0.25,
        'geometric_precision': 0.5,
        'geometric_recall': 0.75,
        'matches': 123.4,
        'poses': 1.0,
        'position': 0.1,
        'position_permille': 1.0,
        'rotation_deg': 0.01,
    }
    assert content['maps'][0] == {
        'name': 'metric',
        'map_id': 'id of metric',
        'metric': True,
        'images': 12,
        'images_without_truth': 3,
    }
    assert content['mean']['gam']['precision'] == pytest.approx(0.5)
    assert 'position' not in content['mean']['gam']
    assert (content['keypoints'], content['every']) == (None, 1)
    assert 'neighbours' not in content


def swept_evaluation() -> MapEvaluation:
    scores = {'gam': score(0.5, 0.1)}
    for rank, one in enumerate(CANDIDACIES):
        scores[one.name] = score(0.01 * rank, 0.1 + 0.01 * rank)
    return evaluation('metric', scores)


def test_curves_rise_over_k() -> None:
    scores: dict[str, Score] = mean_over_maps([swept_evaluation()])
    curves = curves_of(scores)
    assert [one.precision for one in curves['kNN ratio']] == pytest.approx(0.01 * np.arange(8))
    assert [one.precision for one in curves['kNN']] == pytest.approx(0.01 * np.arange(8, 16))
    assert {one.ratio for one in CANDIDACIES if one.label == 'kNN'} == {0.0}


def test_figure_has_the_panels_of_the_paper() -> None:
    figure = neighbours_figure(curves_of(mean_over_maps([swept_evaluation()])))
    titles = [axes.get_title() for axes in figure.axes]
    assert [title.split()[0] for title in titles] == ['M.Precision', 'MPE', 'M.Recall', 'MRE']
    for axes in figure.axes:
        assert [line.get_label() for line in axes.lines] == ['kNN ratio', 'kNN']
    ratio = figure.axes[0].lines[0]
    np.testing.assert_array_equal(ratio.get_xdata(), np.arange(1, 9))
    np.testing.assert_allclose(ratio.get_ydata(), np.arange(8.0))


def test_writes_files_and_nothing_else(tmp_path: Path) -> None:
    report = report_of(swept_evaluation(), swept='bmnet')
    write_report(tmp_path, report)
    assert {path.name for path in tmp_path.iterdir()} == {
        MARKDOWN, JSON, PAGE, SHARES, FIGURE,
    }  # fmt: skip
    assert (tmp_path / MARKDOWN).read_text() == markdown(report)
    content = json.loads((tmp_path / JSON).read_text())
    assert content == as_json(report)
    assert list(content['maps'][0]['matchers']) == ['gam', TRUE_CANDIDATES]
    assert content['neighbours']['matcher'] == 'bmnet'
    assert len(content['neighbours']['mean']['kNN']) == 8
    assert (tmp_path / FIGURE).read_bytes().startswith(b'\x89PNG')


def test_page_tells_what_is_printed(tmp_path: Path) -> None:
    report = report_of(swept_evaluation(), swept='bmnet')
    write_report(tmp_path, report)
    text = (tmp_path / PAGE).read_text(encoding='utf-8')
    assert text.count('<img') == 2
    for line in markdown(report).splitlines():
        if line.startswith('| '):
            for cell in line.strip('|').split('|'):
                assert f'>{escape(cell.strip().strip("*"))}<' in text


def test_figure_needs_a_sweep(tmp_path: Path) -> None:
    write_report(tmp_path, report_of(evaluation('metric', {'gam': score(0.5, 0.1)})))
    assert {path.name for path in tmp_path.iterdir()} == {
        MARKDOWN, JSON, PAGE, SHARES,
    }  # fmt: skip
