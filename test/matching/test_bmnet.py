# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pycolmap
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gam_relocalizer.matching.bmnet import (
    BMNet,
    BMNetConfig,
    normalise_keypoints,
    normalise_points,
)

SMALL = BMNetConfig(point_blocks=3, edge_blocks=2, point_width=8)


def _net(config: BMNetConfig = SMALL) -> BMNet:
    torch.manual_seed(0)
    return BMNet(config).eval()


def _graphs(batch: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    keypoints = torch.randn(20, batch, 2, generator=generator)
    points = torch.randn(30, batch, 3, generator=generator)
    columns = [torch.randint(limit, (50, batch), generator=generator) for limit in (20, 30)]
    return keypoints, points, torch.stack(columns, dim=2)


def test_default_is_the_published_size() -> None:
    net = _net(BMNetConfig())

    assert len(net.keypoint_net) == len(net.point_net) == 5
    assert len(net.edge_net) - 3 == 18
    assert net.edge_net[-1].in_features == 256


def test_graphs_of_a_batch_do_not_influence_each_other() -> None:
    keypoints, points, edges = _graphs(batch=3)

    together = _net()(keypoints, points, edges)

    for i in range(3):
        one = slice(i, i + 1)
        alone = _net()(keypoints[:, one], points[:, one], edges[:, one])
        torch.testing.assert_close(together[:, one], alone)


def test_order_of_points_and_edges_does_not_matter() -> None:
    keypoints, points, edges = _graphs(batch=1)
    order = torch.randperm(30, generator=torch.Generator().manual_seed(1))
    place = torch.argsort(order)
    edge_order = torch.randperm(50, generator=torch.Generator().manual_seed(2))
    renamed = torch.stack([edges[..., 0], place[edges[..., 1]]], dim=2)[edge_order]

    shuffled = _net()(keypoints, points[order], renamed)

    torch.testing.assert_close(
        shuffled, _net()(keypoints, points, edges)[edge_order], rtol=1e-4, atol=1e-4
    )


def test_every_weight_learns() -> None:
    net = _net()

    net(*_graphs(batch=2)).square().sum().backward()

    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in net.parameters())


def test_a_single_edge_gets_a_finite_logit() -> None:
    logits = _net()(
        torch.zeros(1, 1, 2), torch.ones(1, 1, 3), torch.zeros(1, 1, 2, dtype=torch.int64)
    )

    assert logits.shape == (1, 1)
    assert torch.isfinite(logits).all()


def test_keypoints_of_a_centred_pinhole_are_normalised_as_published() -> None:
    camera = pycolmap.Camera(
        model='PINHOLE', width=640, height=480, params=[500.0, 500.0, 320.0, 240.0]
    )
    pixels = np.array([[0.0, 0.0], [320.0, 240.0], [640.0, 100.0]])

    np.testing.assert_allclose(
        normalise_keypoints(pixels, camera), (pixels - [320, 240]) / (1.2 * 640), atol=1e-6
    )


def test_keypoints_are_undistorted() -> None:
    camera = pycolmap.Camera(
        model='SIMPLE_RADIAL', width=640, height=480, params=[500.0, 320.0, 240.0, 0.1]
    )
    on_plane = np.array([[0.3, -0.2], [0.0, 0.1]])
    pixels = camera.img_from_cam(np.column_stack([on_plane, np.ones(2)]))

    np.testing.assert_allclose(
        normalise_keypoints(pixels, camera), on_plane * 500 / (1.2 * 640), atol=1e-5
    )


def test_no_keypoints_and_no_points() -> None:
    camera = pycolmap.Camera(
        model='PINHOLE', width=640, height=480, params=[500.0, 500.0, 320.0, 240.0]
    )

    assert normalise_keypoints(np.empty((0, 2)), camera).shape == (0, 2)
    assert normalise_points(np.empty((0, 3))).shape == (0, 3)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), unit=st.floats(1e-3, 1e3))
def test_unit_of_the_points_does_not_matter(seed: int, unit: float) -> None:
    points = np.random.default_rng(seed).normal(size=(40, 3))

    np.testing.assert_allclose(
        normalise_points(unit * points), normalise_points(points), rtol=1e-4, atol=1e-6
    )


def test_far_points_keep_their_direction_and_leave_the_others_alone() -> None:
    points = np.random.default_rng(0).normal(size=(41, 3))
    wild = np.concatenate([points, [[1e6, 0.0, 0.0], [0.0, 0.0, 1e-6]]])

    normalised = normalise_points(wild)

    np.testing.assert_allclose(normalised[:41], normalise_points(points), rtol=1e-5)
    np.testing.assert_allclose(normalised[41], [10.0, 0.0, 0.0], atol=1e-5)


@pytest.mark.parametrize('points', [np.zeros((5, 3)), np.ones((5, 3)), np.ones((1, 3))])
def test_points_in_one_place_stay_finite(points: np.ndarray) -> None:
    assert np.isfinite(normalise_points(points)).all()
