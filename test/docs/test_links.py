# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Links between the pages, followed as a git host does."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
PAGES = sorted([*REPOSITORY.glob('*.md'), *REPOSITORY.glob('docs/*.md')])
LINK = re.compile(r'\]\(([^()\s]*(?:\([^()\s]*\)[^()\s]*)*)\)')
FENCED = re.compile(r'^```.*?^```$', re.MULTILINE | re.DOTALL)


def prose_of(page: Path) -> str:
    return re.sub(r'`[^`\n]*`', '', FENCED.sub('', page.read_text(encoding='utf-8')))


@cache
def anchors_of(page: Path) -> frozenset[str]:
    """What a git host makes of the headings of a page."""
    text = FENCED.sub('', page.read_text(encoding='utf-8'))
    found: list[str] = []
    for heading in re.findall(r'^#+ (.+?) *$', text, re.MULTILINE):
        words = re.sub(r'\[([^]]*)\]\([^)]*\)', r'\1', heading).lower()
        slug = re.sub(r'[^\w\- ]', '', words).replace(' ', '-')
        repeated = sum(1 for each in found if re.fullmatch(rf'{re.escape(slug)}(-\d+)?', each))
        found.append(f'{slug}-{repeated}' if repeated else slug)
    return frozenset(found)


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)
def test_relative_links_lead_to_files_and_headings_that_exist(page: Path) -> None:
    broken = []
    for link in LINK.findall(prose_of(page)):
        if re.match(r'[a-z]+:', link):
            continue
        name, _, anchor = link.partition('#')
        target = (page.parent / name).resolve() if name else page
        leads_out = not target.is_relative_to(REPOSITORY)
        if leads_out or not target.exists() or (anchor and anchor not in anchors_of(target)):
            broken.append(link)
    assert broken == []


def test_headings_become_anchors_as_on_a_git_host(tmp_path: Path) -> None:
    page = tmp_path / 'page.md'
    page.write_text('# map -> odom\n## A `rosbag2`, or two\n```\n# none\n```\n## [A](b.md)\n## A\n')
    assert anchors_of(page) == {'map---odom', 'a-rosbag2-or-two', 'a', 'a-1'}
