# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from gam_relocalizer.training.scenes import KINDS, Scene, cast

if TYPE_CHECKING:
    from collections.abc import Callable


def _two_walls() -> Scene:
    """Unit squares across the x axis at x = 2 and x = 5."""
    return Scene(
        origins=np.array([[5.0, -0.5, -0.5], [2.0, -0.5, -0.5]], np.float32),
        sides=np.array([[[0, 1, 0], [0, 0, 1]]] * 2, np.float32),
        roughness=np.zeros(2, np.float32),
        texture=np.ones(2, np.float32),
        cells=np.zeros((2, 2), np.int64),
        free_low=np.zeros(3),
        free_high=np.zeros(3),
        target=None,
    )


def test_a_ray_meets_the_first_surface_at_its_place() -> None:
    hits = cast(_two_walls(), np.zeros(3), np.array([[1.0, 0.1, -0.05]]))

    assert hits.surface.tolist() == [1]
    np.testing.assert_allclose(hits.depth, [2.0], rtol=1e-6)
    np.testing.assert_allclose(hits.place, [[0.7, 0.4]], rtol=1e-5)


def test_a_ray_passes_behind_a_surface_that_ends() -> None:
    scene = _two_walls()

    hits = cast(
        scene, np.array([3.0, 0.0, 0.0]), np.array([[1.0, 0.1, 0], [-1.0, 0, 0], [0, 1, 0]])
    )

    assert hits.surface.tolist() == [0, 1, -1]
    assert np.isinf(hits.depth[2])


@pytest.mark.parametrize('kind', KINDS)
def test_every_kind_has_surfaces_with_square_corners_around_free_space(
    kind: Callable[[np.random.Generator], Scene],
) -> None:
    for seed in range(5):
        scene = kind(np.random.default_rng(seed))

        dots = np.einsum('pc,pc->p', scene.sides[:, 0], scene.sides[:, 1])
        lengths = np.linalg.norm(scene.sides, axis=2).prod(axis=1)
        assert np.all(np.abs(dots) < 1e-4 * lengths)
        assert np.all(scene.free_low <= scene.free_high)
        directions = np.random.default_rng(seed).normal(size=(500, 3))
        middle = (scene.free_low + scene.free_high) / 2
        assert (cast(scene, middle, directions).surface >= 0).mean() > 0.1
