# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import sys

import numpy as np
import pytest

from gam_relocalizer.demo import textures
from gam_relocalizer.errors import UsageError


def test_photographs_are_found_without_importing_the_package() -> None:
    image = textures.photo('brick_wall_1')
    assert image.shape == (1024, 1024, 3)
    assert textures.PACKAGE not in sys.modules


def test_photographs_are_rgb() -> None:
    red, green, blue = textures.photo('door_garage_red').reshape(-1, 3).mean(axis=0)
    assert red > 1.5 * green
    assert red > 1.5 * blue


def test_there_are_many_portraits() -> None:
    names = textures.portrait_names()
    assert len(names) == len(set(names)) == 82
    assert textures.photo(names[0]).ndim == 3


def test_missing_package_is_a_usage_error_that_names_the_extra(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(textures, 'PACKAGE', 'no_such_package_of_photographs')
    with pytest.raises(UsageError, match=r'gam_relocalizer\[demo\]'):
        textures.photo_folder()


def test_unknown_photograph_is_a_usage_error() -> None:
    with pytest.raises(UsageError):
        textures.photo('no_such_photograph')


def test_tiled_surface_repeats_the_photograph_at_its_size() -> None:
    image = textures.tiled(textures.photo('brick_wall_1'), (3.0, 2.0), 1.0, 100.0)
    assert image.shape == (200, 300, 3)
    np.testing.assert_array_equal(image[:, :100], image[:, 200:])


def test_weathering_breaks_the_repetition() -> None:
    tiled = textures.tiled(textures.photo('brick_wall_1'), (3.0, 2.0), 1.0, 100.0)
    worn = textures.weathered(tiled, np.random.default_rng(0), 0.25).astype(float)
    assert np.abs(worn[:, :100] - worn[:, 200:]).mean() > 3.0


@pytest.mark.parametrize('seed', [0, 1])
def test_prints_depend_on_the_seed_alone(seed: int) -> None:
    pictures = [textures.photo(name) for name in textures.portrait_names()[:4]]

    def made(seed: int) -> list[np.ndarray]:
        rng = np.random.default_rng(seed)
        return [
            textures.printed_page(rng, 150, 210),
            textures.poster(rng, pictures[0], 330, 480),
            textures.notice_board(rng, textures.photo('cardboard_1'), pictures, 310, 200),
            textures.book_row(rng, pictures, 320, 95),
            textures.carton(rng, textures.photo('cardboard_2'), pictures[1], 200),
            textures.window_view(rng, 280, 210),
        ]

    for one, same, other in zip(made(seed), made(seed), made(seed + 7), strict=True):
        np.testing.assert_array_equal(one, same)
        assert one.shape != other.shape or (one != other).any()
