# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The two lines that head every file of code, and sizes: what a clone has to download."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator

REPOSITORY = Path(__file__).resolve().parents[2]
FOLDERS = (
    'benchmarks',
    'config',
    'docs',
    'gam_relocalizer',
    'gam_relocalizer_msgs',
    'launch',
    'maps/demo',
    'pip_interfaces',
    'requirements',
    'resource',
    'scripts',
    'test',
)
HEADER = [
    '# Copyright 2026 gam_relocalizer authors',
    '# SPDX-License-Identifier: Apache-2.0',
]
CODE = {'.cmake', '.py'}
CODE_NAMES = {'CMakeLists.txt', 'Makefile', 'node', 'run'}
# The largest is the demo's map; anything above is a mistake or belongs elsewhere.
MAX_BYTES = 7_000_000


def files() -> Iterator[Path]:
    yield REPOSITORY / '.ci' / 'run'
    yield from (path for path in REPOSITORY.iterdir() if path.is_file())
    for folder in FOLDERS:
        for path in (REPOSITORY / folder).rglob('*'):
            if path.is_file() and '__pycache__' not in path.parts:
                yield path


def code() -> Iterator[Path]:
    for path in files():
        if path.suffix in CODE or path.name in CODE_NAMES:
            yield path


@pytest.mark.parametrize('path', sorted(code()), ids=lambda path: str(path.relative_to(REPOSITORY)))
def test_code_has_copyright_and_licence(path: Path) -> None:
    lines = path.read_text(encoding='utf-8').splitlines()
    if lines[:1] and lines[0].startswith('#!'):
        lines = lines[1:]

    assert lines[:2] == HEADER


def test_no_file_is_larger_than_the_map_of_the_demo() -> None:
    too_large = [path for path in files() if path.stat().st_size > MAX_BYTES]

    assert too_large == []
