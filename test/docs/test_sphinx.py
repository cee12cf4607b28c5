# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import gam_relocalizer

REPOSITORY = Path(__file__).parents[2]
MODULES = sorted(
    module.name
    for module in pkgutil.walk_packages(gam_relocalizer.__path__, 'gam_relocalizer.')
    if not any(part.startswith('_') for part in module.name.split('.'))
)


@pytest.fixture(scope='module')
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The documentation as text: all that HTML needs but the drawing of 250 pages."""
    out = tmp_path_factory.mktemp('site')
    options = ['-W', '--keep-going', '-q', '-b', 'text', '-c', 'docs']
    build = subprocess.run(
        [sys.executable, '-m', 'sphinx', *options, '.', out],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=False,
    )
    assert build.returncode == 0, build.stderr
    return out


def test_it_builds_without_a_warning_and_each_page_of_ours_is_in_it(site: Path) -> None:
    for page in [*REPOSITORY.glob('*.md'), *REPOSITORY.glob('docs/*.md')]:
        assert (site / page.relative_to(REPOSITORY)).with_suffix('.txt').is_file(), page


def test_every_public_module_has_its_page(site: Path) -> None:
    pages = {page.stem for page in site.glob('docs/api/*.txt')}
    assert len(MODULES) > 100
    assert [name for name in MODULES if name not in pages] == []
