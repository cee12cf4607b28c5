# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What a reader sees: on a phone, on a desk, in the dark and on paper."""

from __future__ import annotations

import csv
import json
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from playwright.sync_api import Page

    Show = Callable[..., Any]

PHONE = {'viewport': {'width': 360, 'height': 740}, 'device_scale_factor': 2, 'is_mobile': True}
DESKTOP = {'viewport': {'width': 1280, 'height': 900}}
SCREENS = {'phone': PHONE, 'desktop': DESKTOP}
SMALLEST_TEXT_PX = 14.0
# WCAG 2, level AA, for text of normal size.
LEAST_CONTRAST = 4.5

TEXTS = """() => [...document.querySelectorAll('h1, h2, p, li, li b, th, td, figcaption')]
    .filter(one => one.textContent.trim())
    .map(one => {
        let behind = one, paper = 'rgba(0, 0, 0, 0)';
        while (behind && paper === 'rgba(0, 0, 0, 0)') {
            paper = getComputedStyle(behind).backgroundColor;
            behind = behind.parentElement;
        }
        const style = getComputedStyle(one);
        return {ink: style.color, paper, size: parseFloat(style.fontSize)};
    })"""

IMAGES = """() => [...document.images].map(one => ({
    width: one.naturalWidth, shown: one.getBoundingClientRect().width, alt: one.alt,
    ready: one.complete}))"""


def luminance(colour: str) -> float:
    """Relative luminance of `rgb(r, g, b)`, as WCAG 2 defines it."""
    channels = np.array([float(one) for one in colour[colour.index('(') + 1 : -1].split(',')][:3])
    channels /= 255.0
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def contrast(one: str, other: str) -> float:
    low, high = sorted([luminance(one), luminance(other)])
    return (high + 0.05) / (low + 0.05)


def table_after(page: Page, heading: str) -> list[list[str]]:
    """Cells of the first table after a heading."""
    rows: list[list[str]] = page.evaluate(
        """heading => {
            const all = [...document.querySelectorAll('h2, table')];
            const at = all.findIndex(one => one.textContent === heading);
            const table = all.slice(at).find(one => one.tagName === 'TABLE');
            return [...table.rows].map(row => [...row.cells].map(cell => cell.textContent));
        }""",
        heading,
    )
    return rows


@pytest.mark.parametrize('screen', SCREENS)
def test_page_is_readable(show: Show, page_file: Path, screen: str, tmp_path: Path) -> None:
    with show(page_file, **SCREENS[screen]) as seen:
        assert seen.complaints == []
        assert seen.requests[0] == page_file.resolve().as_uri()
        assert all(url.startswith('data:image/png;base64,') for url in seen.requests[1:])
        images = seen.page.evaluate(IMAGES)
        assert len(images) >= 7
        width = seen.page.evaluate('innerWidth')
        for image in images:
            assert image['ready']
            assert image['alt']
            assert image['width'] > 0
            assert image['shown'] <= width
        assert seen.page.evaluate('document.documentElement.scrollWidth') <= width
        assert min(text['size'] for text in seen.page.evaluate(TEXTS)) >= SMALLEST_TEXT_PX
        assert seen.page.locator('h1').count() == 1
        assert seen.page.locator('h2').count() >= 4
        seen.page.screenshot(path=tmp_path / f'{screen}.png', full_page=True)
    assert cv2.imread(str(tmp_path / f'{screen}.png')).std() > 10.0


@pytest.mark.parametrize('scheme', ['light', 'dark'])
def test_text_stands_out_in_light_and_in_the_dark(show: Show, page_file: Path, scheme: str) -> None:
    with show(page_file, **PHONE, color_scheme=scheme) as seen:
        texts = seen.page.evaluate(TEXTS)
        paper = seen.page.evaluate('getComputedStyle(document.body).backgroundColor')
    assert (luminance(paper) < 0.5) == (scheme == 'dark')
    for text in texts:
        assert contrast(text['ink'], text['paper']) >= LEAST_CONTRAST, text


def test_wide_tables_scroll_inside_of_their_box(show: Show, replayed: Path) -> None:
    with show(replayed / 'report.html', **PHONE) as seen:
        boxes: list[Any] = seen.page.evaluate(
            "[...document.querySelectorAll('.wide')].map(one => [one.scrollWidth, one.clientWidth])"
        )
        assert max(inner - outer for inner, outer in boxes) > 0
        assert max(outer for _, outer in boxes) <= 360


def test_page_prints(show: Show, page_file: Path) -> None:
    with show(page_file, **DESKTOP, color_scheme='dark') as seen:
        seen.page.emulate_media(media='print')
        paper = seen.page.evaluate('getComputedStyle(document.body).backgroundColor')
        document = seen.page.pdf(format='A4')
    assert luminance(paper) > 0.99
    assert document.startswith(b'%PDF')
    assert len(document) > 50_000


def test_attempts_are_those_of_the_file(show: Show, replayed: Path) -> None:
    with (replayed / 'attempts.csv').open(encoding='utf-8', newline='') as file:
        attempts = list(csv.DictReader(file))
    with show(replayed / 'report.html', **PHONE) as seen:
        header, *rows = table_after(seen.page, 'Attempts')
    assert len(rows) == len(attempts) > 1
    for cells, attempt in zip(rows, attempts, strict=True):
        row = dict(zip(header, cells, strict=True))
        assert row['verdict'] == attempt['status']
        assert row['inliers'] == attempt['inliers']
        assert row['reason'] == attempt['reason']
        assert row['stamp [s]'] == f'{int(attempt["stamp_ns"]) / 1e9:.3f}'


def test_recalls_are_those_of_the_json(show: Show, evaluated: Path) -> None:
    (one,) = json.loads((evaluated / 'localization.json').read_text(encoding='utf-8'))['sets']
    with show(evaluated / 'localization.html', **DESKTOP) as seen:
        _, *rows = table_after(seen.page, 'All poses found, whatever the verdict (as in the paper)')
    assert [cells[:2] for cells in rows] == [[m['name'], m['matcher']] for m in one['methods']]
    for cells, method in zip(rows, one['methods'], strict=True):
        recalls = [f'{100.0 * limit["recall"]:.1f}' for limit in method['found']['recall']]
        assert cells[2 : 2 + len(recalls)] == recalls
