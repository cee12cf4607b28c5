# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gam_relocalizer.matching.bmnet import (
    BMNet,
    BMNetConfig,
    embed,
    normalise_keypoints,
    normalise_points,
    normalised_focal_length,
)
from gam_relocalizer.matching.graph import CandidateGraphs

SMALL = BMNetConfig(point_blocks=3, edge_blocks=2, point_width=8)


def _net(config: BMNetConfig = SMALL) -> BMNet:
    torch.manual_seed(0)
    return BMNet(config).eval()


def _graphs(batch: int, seed: int = 0) -> CandidateGraphs:
    generator = torch.Generator().manual_seed(seed)
    columns = [torch.randint(limit, (50, batch), generator=generator) for limit in (20, 30)]
    return CandidateGraphs(
        keypoints=torch.randn(20, batch, 2, generator=generator),
        points=torch.randn(30, batch, 3, generator=generator),
        edges=torch.stack(columns, dim=2),
        distances=torch.rand(50, batch, generator=generator),
        focal_lengths=torch.ones(batch),
    )


def test_default_is_the_published_size() -> None:
    net = _net(BMNetConfig())

    assert len(net.keypoint_net) == len(net.point_net) == 5
    assert len(net.edge_net) - 3 == 18
    assert net.edge_net[-1].in_features == 256


def test_order_of_points_and_edges_does_not_matter() -> None:
    graphs = _graphs(batch=1)
    order = torch.randperm(30, generator=torch.Generator().manual_seed(1))
    place = torch.argsort(order)
    edge_order = torch.randperm(50, generator=torch.Generator().manual_seed(2))
    renamed = torch.stack([graphs.edges[..., 0], place[graphs.edges[..., 1]]], dim=2)

    shuffled = _net()(replace(graphs, points=graphs.points[order], edges=renamed[edge_order]))

    torch.testing.assert_close(shuffled, _net()(graphs)[edge_order], rtol=1e-4, atol=1e-4)


def test_geometry_alone_decides() -> None:
    graphs = _graphs(batch=2)
    other = replace(graphs, distances=graphs.distances + 1, focal_lengths=torch.full((2,), 0.3))

    assert torch.equal(_net()(other), _net()(graphs))


def test_close_coordinates_are_told_apart_in_bfloat16() -> None:
    # 1 and 1.001 are the same number in bfloat16
    keypoints = torch.tensor([[1.0, 1.0], [1.001, 1.0], [0.0, 0.5], [0.3, 0.0]])[:, None]
    net = _net()

    with torch.autocast('cpu', torch.bfloat16):
        features = embed(net.keypoint_net, keypoints)

    assert not torch.equal(features[0], features[1])


def test_the_focal_length_is_in_the_unit_of_the_keypoints() -> None:
    camera = pycolmap.Camera(
        model='PINHOLE', width=480, height=640, params=[510.0, 490.0, 250.0, 300.0]
    )
    pixels = np.array([[250.0 + 510.0, 300.0], [250.0, 300.0 + 490.0]])

    # one focal length aside is a direction of 45 degrees
    np.testing.assert_allclose(
        normalise_keypoints(pixels, camera), normalised_focal_length(camera) * np.eye(2), atol=1e-6
    )
    assert normalised_focal_length(camera) == pytest.approx(500 / (1.2 * 640))


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


def test_keypoints_without_a_known_ray_are_not_a_number() -> None:
    camera = pycolmap.Camera(
        model='OPENCV_FISHEYE', width=640, height=480, params=[200, 200, 320, 240, 0, 0, 0, 0]
    )
    # 1.75 focal lengths from the centre an equidistant lens looks backwards
    pixels = np.array([[320.0, 240.0], [320.0 + 350.0, 240.0]])

    np.testing.assert_array_equal(
        np.isfinite(normalise_keypoints(pixels, camera)).all(axis=1), [True, False]
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
