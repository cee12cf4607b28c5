# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gam_relocalizer.matching.graph import CandidateGraphs
from gam_relocalizer.matching.lgcnet import LgcNet, LgcNetConfig

SMALL = LgcNetConfig(blocks=3, width=16)


def _net(config: LgcNetConfig = SMALL) -> LgcNet:
    torch.manual_seed(0)
    return LgcNet(config)


def _graphs(batch: int, edges: int = 50, seed: int = 0) -> CandidateGraphs:
    generator = torch.Generator().manual_seed(seed)
    columns = [torch.randint(limit, (edges, batch), generator=generator) for limit in (20, 30)]
    return CandidateGraphs(
        keypoints=torch.randn(20, batch, 2, generator=generator),
        points=torch.randn(30, batch, 3, generator=generator),
        edges=torch.stack(columns, dim=2),
        distances=torch.rand(edges, batch, generator=generator),
        focal_lengths=torch.ones(batch),
    )


def _one(graphs: CandidateGraphs, index: int) -> CandidateGraphs:
    one = slice(index, index + 1)
    return CandidateGraphs(
        graphs.keypoints[:, one],
        graphs.points[:, one],
        graphs.edges[:, one],
        graphs.distances[:, one],
        graphs.focal_lengths[one],
    )


def test_default_is_the_published_size() -> None:
    net = LgcNet()

    assert net.config == LgcNetConfig(blocks=12, width=128)
    assert sum(weights.numel() for weights in net.parameters() if weights.ndim == 2) == (
        5 * 128 + 12 * 2 * 128 * 128 + 128
    )


@pytest.mark.parametrize('batch', [2, 3])
def test_graphs_of_a_batch_do_not_influence_each_other(batch: int) -> None:
    graphs = _graphs(batch)

    together = _net()(graphs)

    assert together.shape == (50, batch)
    for i in range(batch):
        torch.testing.assert_close(
            together[:, i : i + 1], _net()(_one(graphs, i)), rtol=1e-4, atol=1e-4
        )


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), edges=st.integers(1, 40))
def test_order_of_edges_does_not_matter(seed: int, edges: int) -> None:
    graphs = _graphs(batch=1, edges=edges, seed=seed)
    order = torch.randperm(edges, generator=torch.Generator().manual_seed(seed))
    shuffled = replace(graphs, edges=graphs.edges[order], distances=graphs.distances[order])

    torch.testing.assert_close(_net()(shuffled), _net()(graphs)[order], rtol=1e-3, atol=1e-3)


def test_both_ends_of_an_edge_count() -> None:
    graphs = _graphs(batch=1)
    keypoints, points = graphs.keypoints.clone(), graphs.points.clone()
    keypoints[graphs.edges[0, 0, 0]] += 1
    points[graphs.edges[0, 0, 1]] += 1
    before = _net()(graphs)

    for changed in (replace(graphs, keypoints=keypoints), replace(graphs, points=points)):
        assert not torch.allclose(_net()(changed), before)


def test_every_weight_learns_in_bfloat16_too() -> None:
    net = _net()

    with torch.autocast('cpu', torch.bfloat16):
        logits = net(_graphs(batch=2))
    logits.square().sum().backward()

    assert logits.dtype == torch.float32
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in net.parameters())


def test_close_coordinates_are_told_apart_in_bfloat16() -> None:
    # 1 and 1.001 are the same number in bfloat16
    keypoints = torch.tensor([[1.0, 1.0], [1.001, 1.0], [0.0, 0.5], [0.3, 0.0]])[:, None]
    edges = torch.arange(4)[:, None, None].expand(4, 1, 2)
    graphs = CandidateGraphs(
        keypoints, torch.zeros(4, 1, 3), edges, torch.zeros(4, 1), torch.ones(1)
    )
    net = _net()

    with torch.autocast('cpu', torch.bfloat16):
        embedded = net.embedding(graphs)

    assert not torch.equal(embedded[0], embedded[1])


@pytest.mark.parametrize('edges', [1, 2])
def test_very_few_edges_get_finite_logits_and_gradients(edges: int) -> None:
    net = _net()

    logits = net(_graphs(batch=2, edges=edges))
    logits.sum().backward()

    assert logits.shape == (edges, 2)
    assert torch.isfinite(logits).all()
    assert all(p.grad is None or torch.isfinite(p.grad).all() for p in net.parameters())


def test_same_input_same_output() -> None:
    assert torch.equal(_net()(_graphs(batch=2)), _net()(_graphs(batch=2)))
