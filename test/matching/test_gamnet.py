# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gam_relocalizer.matching.gamnet import (
    APPEARANCE,
    GEOMETRY,
    GREATEST_INVERSE,
    LONELY_RATIO,
    TURN_SCALE,
    GamNet,
    GamNetConfig,
    _appearance,
    _geometry,
)
from gam_relocalizer.matching.graph import CandidateGraphs

SMALL = GamNetConfig(blocks=2, width=16)
KEYPOINTS, POINTS = 20, 30
some = settings(max_examples=30, deadline=None)


def _net(config: GamNetConfig = SMALL) -> GamNet:
    torch.manual_seed(0)
    return GamNet(config)


def _graphs(batch: int, edges: int = 50, seed: int = 0) -> CandidateGraphs:
    generator = torch.Generator().manual_seed(seed)
    columns = [
        torch.randint(limit, (edges, batch), generator=generator) for limit in (KEYPOINTS, POINTS)
    ]
    return CandidateGraphs(
        keypoints=torch.randn(KEYPOINTS, batch, 2, generator=generator),
        points=torch.randn(POINTS, batch, 3, generator=generator),
        edges=torch.stack(columns, dim=2),
        distances=torch.rand(edges, batch, generator=generator),
        focal_lengths=0.5 + torch.rand(batch, generator=generator),
    )


def _graph(edges: list[tuple[int, int]], distances: list[float]) -> CandidateGraphs:
    """One graph of which only the appearance matters."""
    return CandidateGraphs(
        torch.zeros(KEYPOINTS, 1, 2),
        torch.ones(POINTS, 1, 3),
        torch.tensor(edges)[:, None],
        torch.tensor(distances)[:, None],
        torch.ones(1),
    )


def _compared(
    edges: list[tuple[int, int]], distances: list[float]
) -> tuple[torch.Tensor, torch.Tensor]:
    """What is told of every edge, at its keypoint and at its point."""
    told = _appearance(_graph(edges, distances))[:, 0]
    return told[:, 1:5], told[:, 5:]


@some
@given(seed=st.integers(0, 10_000))
def test_order_of_keypoints_and_points_does_not_matter(seed: int) -> None:
    graphs = _graphs(1, seed=seed)
    generator = torch.Generator().manual_seed(seed)
    orders = [torch.randperm(count, generator=generator) for count in (KEYPOINTS, POINTS)]
    places = [torch.argsort(order) for order in orders]
    renamed = [place[graphs.edges[..., side]] for side, place in enumerate(places)]
    shuffled = replace(
        graphs,
        keypoints=graphs.keypoints[orders[0]],
        points=graphs.points[orders[1]],
        edges=torch.stack(renamed, dim=2),
    )

    assert torch.equal(_net()(shuffled), _net()(graphs))


def test_what_has_no_edge_does_not_count() -> None:
    graphs = _graphs(1)
    more = replace(
        graphs,
        keypoints=torch.cat([graphs.keypoints, torch.full((5, 1, 2), 9.0)]),
        points=torch.cat([graphs.points, torch.zeros(7, 1, 3)]),
    )

    assert torch.equal(_net()(more), _net()(graphs))


def test_all_of_the_graph_counts() -> None:
    graphs = _graphs(1)
    before = _net()(graphs)

    for changed in (
        replace(graphs, keypoints=graphs.keypoints.flip(0)),
        replace(graphs, points=graphs.points.flip(0)),
        replace(graphs, distances=graphs.distances.flip(0)),
        replace(graphs, focal_lengths=2 * graphs.focal_lengths),
    ):
        assert not torch.allclose(_net()(changed), before)


def test_degenerate_places_get_finite_logits() -> None:
    graphs = _graphs(1)
    for one in (
        replace(graphs, points=torch.zeros(POINTS, 1, 3)),
        replace(graphs, keypoints=torch.zeros(KEYPOINTS, 1, 2)),
        replace(graphs, distances=torch.zeros(50, 1)),
        replace(graphs, edges=torch.zeros(50, 1, 2, dtype=torch.int64)),
    ):
        assert torch.isfinite(_net()(one)).all()


def test_what_is_told_of_an_edge_is_in_full_precision() -> None:
    graphs = _graphs(1)
    # 1 and 1.001 are the same number in bfloat16
    near = replace(graphs, keypoints=graphs.keypoints * 1.001)
    net = _net()
    seen = []
    net.embedding.register_forward_hook(lambda *call: seen.append(call[-1]))

    with torch.autocast('cpu', torch.bfloat16):
        net(graphs)
        net(near)

    assert seen[0].dtype == torch.float32
    assert not torch.equal(*seen)


def test_geometry_by_hand() -> None:
    # a keypoint one focal length aside, and a point straight ahead at distance 4
    graphs = CandidateGraphs(
        torch.tensor([[[0.7, 0.0]]]),
        torch.tensor([[[0.0, 0.0, 4.0]]]),
        torch.zeros(1, 1, 2, dtype=torch.int64),
        torch.ones(1, 1),
        torch.tensor([0.7]),
    )
    half = np.sqrt(0.5)

    told = _geometry(graphs)

    assert told.shape == (1, 1, GEOMETRY)
    turn = TURN_SCALE * np.array([half, 0, half - 1])
    np.testing.assert_allclose(told[0, 0], [half, 0, half, 0, 0, 1, *turn, 0.25], atol=1e-6)


@some
@given(seed=st.integers(0, 10_000), turn=st.floats(-3.0, 3.0))
def test_a_true_edge_of_a_camera_that_did_not_move_does_not_turn(seed: int, turn: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform([-2, -2, 1], [2, 2, 5], (8, 3))
    focal_length = rng.uniform(0.3, 1.5)
    keypoints = focal_length * points[:, :2] / points[:, 2:]
    edges = torch.arange(8)[:, None, None].expand(8, 1, 2)
    graphs = CandidateGraphs(
        torch.tensor(keypoints, dtype=torch.float32)[:, None],
        torch.tensor(points, dtype=torch.float32)[:, None],
        edges,
        torch.ones(8, 1),
        torch.tensor([focal_length], dtype=torch.float32),
    )

    still = _geometry(graphs)[:, 0]

    np.testing.assert_allclose(still[:, 6:9], 0, atol=1e-4)
    # a camera that rolls turns all lines of sight about its axis, by what the keypoints tell
    c, s = np.cos(turn), np.sin(turn)
    rolled = replace(graphs, keypoints=graphs.keypoints @ torch.tensor([[c, s], [-s, c]]).float())
    by_hand = still[:, :2] @ torch.tensor([[c, s], [-s, c]]).float()
    np.testing.assert_allclose(_geometry(rolled)[:, 0, :2], by_hand, atol=1e-5)


def test_points_at_the_reference_camera_are_not_endlessly_near() -> None:
    graphs = replace(_graphs(1), points=torch.zeros(POINTS, 1, 3))

    assert (_geometry(graphs)[..., 9] == GREATEST_INVERSE).all()


def test_appearance_by_hand() -> None:
    # keypoint 0 has three candidates, keypoint 1 one; point 5 is a candidate of both
    edges = [(0, 5), (0, 6), (0, 7), (1, 5)]

    at_keypoint, at_point = _compared(edges, [0.4, 0.5, 0.8, 0.2])

    # best over own, best over second best, is best, one over how many
    np.testing.assert_allclose(
        at_keypoint,
        [
            [1.0, 0.8, 1, 1 / 3],
            [0.8, 1.0, 0, 1 / 3],
            [0.5, 1.0, 0, 1 / 3],
            [1.0, LONELY_RATIO, 1, 1],
        ],
        rtol=1e-6,
    )
    np.testing.assert_allclose(
        at_point,
        [
            [0.5, 1.0, 0, 1 / 2],
            [1.0, LONELY_RATIO, 1, 1],
            [1.0, LONELY_RATIO, 1, 1],
            [1.0, 0.5, 1, 1 / 2],
        ],
        rtol=1e-6,
    )
    told = _appearance(_graph(edges, [0.4, 0.5, 0.8, 0.2]))
    assert told.shape == (4, 1, APPEARANCE)
    np.testing.assert_allclose(told[:, 0, 0], [0.4, 0.5, 0.8, 0.2])


def test_equally_near_candidates_are_all_the_best() -> None:
    at_keypoint, _ = _compared([(0, 0), (0, 1), (0, 2)], [0.3, 0.3, 0.6])

    # they are compared with the next one that is farther
    np.testing.assert_allclose(
        at_keypoint, [[1, 0.5, 1, 1 / 3], [1, 0.5, 1, 1 / 3], [0.5, 1, 0, 1 / 3]], rtol=1e-6
    )


def test_equally_near_candidates_without_a_farther_one_know_no_next() -> None:
    at_keypoint, _ = _compared([(0, 0), (0, 1)], [0.3, 0.3])

    np.testing.assert_allclose(at_keypoint, [[1, LONELY_RATIO, 1, 1 / 2]] * 2, rtol=1e-6)


def test_an_edge_that_is_there_twice_is_no_rival_of_itself() -> None:
    once, _ = _compared([(0, 0), (0, 1)], [0.3, 0.6])
    twice, _ = _compared([(0, 0), (0, 1), (0, 0)], [0.3, 0.6, 0.3])

    # but for the number of edges
    np.testing.assert_array_equal(once[:, :3], twice[:2, :3])
    np.testing.assert_array_equal(twice[0], twice[2])


def test_identical_descriptors_are_compared_all_the_same() -> None:
    at_keypoint, at_point = _compared([(0, 0), (0, 1)], [0.0, 0.5])

    assert torch.isfinite(at_keypoint).all()
    assert torch.isfinite(at_point).all()
    assert at_keypoint[0, 1] < 0.01
    assert at_keypoint[0, 2] == 1


@some
@given(seed=st.integers(0, 10_000), edges=st.integers(1, 80), batch=st.integers(1, 3))
def test_appearance_is_what_a_loop_says(seed: int, edges: int, batch: int) -> None:
    graphs = _graphs(batch, edges, seed)
    told = _appearance(graphs)

    for b in range(batch):
        for side in (0, 1):
            ends, distances = graphs.edges[:, b, side], graphs.distances[:, b].clamp_min(1e-3)
            for t in range(edges):
                rivals = distances[ends == ends[t]]
                best, own = rivals.min(), distances[t]
                farther = rivals[rivals > best]
                next_best = best / farther.min() if len(farther) else LONELY_RATIO
                expected = [
                    float(best / own),
                    float(next_best) if own == best else 1.0,
                    float(own == best),
                    1 / len(rivals),
                ]
                found = told[t, b, 1 + 4 * side : 5 + 4 * side]
                np.testing.assert_allclose(found, expected, rtol=1e-5)
