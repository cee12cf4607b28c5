# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gam_relocalizer.augmentation.arrows import MAX_ARROWS_BYTES, Arrow, read_arrows, write_arrows
from gam_relocalizer.errors import UsageError

if TYPE_CHECKING:
    from pathlib import Path

GOOD = "- {position: [1, 2, 3], direction: [0, 0, 2.5], length: 0.5, colour: '#18b26b'}\n"
NUMBERS = st.floats(-1e6, 1e6)
ARROWS = st.builds(
    Arrow,
    st.tuples(NUMBERS, NUMBERS, NUMBERS),
    st.tuples(NUMBERS, NUMBERS, st.floats(0.1, 10.0)),
    st.floats(1e-3, 1e3),
    st.sampled_from(['#18b26b', '#F26A1B', '#000000', '#123456']),
)


@given(st.lists(ARROWS, min_size=1, max_size=4))
def test_what_is_written_is_read_again(
    tmp_path_factory: pytest.TempPathFactory, arrows: list[Arrow]
) -> None:
    file = tmp_path_factory.mktemp('arrows') / 'arrows.yaml'
    write_arrows(file, arrows)
    assert read_arrows(file) == tuple(arrows)


def test_tip_is_a_length_from_the_tail_whatever_the_length_of_the_direction(tmp_path: Path) -> None:
    file = tmp_path / 'arrows.yaml'
    file.write_text(GOOD, encoding='utf-8')
    (arrow,) = read_arrows(file)
    np.testing.assert_allclose(arrow.tail, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(arrow.tip, [1.0, 2.0, 3.5])
    assert arrow.rgb == (0x18, 0xB2, 0x6B)


@pytest.mark.parametrize(
    'text',
    [
        '',
        '[]',
        'arrows: 3',
        '- 7',
        '- {position: [1, 2, 3]}',
        '[' * 5000,
        '{unbalanced: [',
        '- !!python/object/apply:os.getcwd []',
        GOOD.replace('[1, 2, 3]', '[1, 2]'),
        GOOD.replace('[1, 2, 3]', '[1, 2, .nan]'),
        GOOD.replace('[1, 2, 3]', '[1, 2, .inf]'),
        GOOD.replace('[1, 2, 3]', '[1, 2, true]'),
        GOOD.replace('[0, 0, 2.5]', '[0, 0, 0]'),
        GOOD.replace('0.5', '-0.5'),
        GOOD.replace('0.5', 'long'),
        GOOD.replace("'#18b26b'", 'green'),
        GOOD.replace("'#18b26b'", '12'),
        GOOD.replace('colour', 'color'),
        GOOD * 1001,
    ],
)
def test_what_is_no_list_of_arrows_is_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / 'arrows.yaml'
    file.write_text(text, encoding='utf-8')
    with pytest.raises(UsageError, match=r'arrows\.yaml'):
        read_arrows(file)


def test_missing_binary_and_huge_files_are_refused(tmp_path: Path) -> None:
    binary, huge = tmp_path / 'binary', tmp_path / 'huge'
    binary.write_bytes(b'\xff\xfe\x00')
    huge.write_bytes(b'#' * (MAX_ARROWS_BYTES + 1))
    for file in (tmp_path / 'missing', binary, huge, tmp_path):
        with pytest.raises(UsageError, match=str(file)):
            read_arrows(file)
