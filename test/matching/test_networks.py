# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import asdict, replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gam_relocalizer.matching.bmnet import BMNetConfig
from gam_relocalizer.matching.gamnet import GamNetConfig
from gam_relocalizer.matching.graph import CandidateGraphs, MatchingNetwork
from gam_relocalizer.matching.lgcnet import LgcNetConfig
from gam_relocalizer.matching.networks import (
    NETWORK_NAMES,
    NetworkConfig,
    create_config,
    create_network,
    name_of,
)
from gam_relocalizer.matching.oanet import OaNetConfig
from gam_relocalizer.matching.registry import LEARNED_MATCHERS


@pytest.mark.parametrize('name', NETWORK_NAMES)
def test_the_name_of_a_network_makes_it(name: str) -> None:
    config = create_config(name)

    network = create_network(config)

    assert name_of(config) == name
    assert isinstance(network, MatchingNetwork)
    assert network.config == config


@pytest.mark.parametrize('name', NETWORK_NAMES)
def test_sizes_make_the_config_that_they_were_taken_from(name: str) -> None:
    sizes = asdict(create_config(name))
    assert all(type(size) is int for size in sizes.values())

    for size in sizes:
        wider = create_config(name, {**sizes, size: 2 * sizes[size]})
        assert wider != create_config(name)
        assert asdict(wider) == {**sizes, size: 2 * sizes[size]}
    assert create_config(name, sizes) == create_config(name)


def test_unknown_names_and_sizes() -> None:
    with pytest.raises(KeyError):
        create_config('nonsense')
    for name in NETWORK_NAMES:
        with pytest.raises(TypeError):
            create_config(name, {'colour': 3})


def test_every_learned_matcher_has_a_network() -> None:
    networks = {name_of(learned.network) for learned in LEARNED_MATCHERS.values()}

    assert networks == {*NETWORK_NAMES}


# What holds of every network, whatever it makes of an edge.

SMALL = {
    'gamnet': GamNetConfig(blocks=2, width=16),
    'bmnet': BMNetConfig(point_blocks=3, edge_blocks=2, point_width=8),
    'lgcnet': LgcNetConfig(blocks=3, width=16),
    'oanet': OaNetConfig(blocks=4, filters=2, width=16, clusters=8),
}
every_network = pytest.mark.parametrize('config', SMALL.values(), ids=SMALL)


def _net(config: NetworkConfig) -> MatchingNetwork:
    torch.manual_seed(0)
    return create_network(config)


def _graphs(batch: int, edges: int = 50, seed: int = 0) -> CandidateGraphs:
    generator = torch.Generator().manual_seed(seed)
    columns = [torch.randint(limit, (edges, batch), generator=generator) for limit in (20, 30)]
    return CandidateGraphs(
        keypoints=torch.randn(20, batch, 2, generator=generator),
        points=torch.randn(30, batch, 3, generator=generator),
        edges=torch.stack(columns, dim=2),
        distances=torch.rand(edges, batch, generator=generator),
        focal_lengths=0.5 + torch.rand(batch, generator=generator),
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


def test_every_network_is_held_to_the_laws() -> None:
    assert set(SMALL) == set(NETWORK_NAMES)


@every_network
@pytest.mark.parametrize('batch', [2, 3])
def test_graphs_of_a_batch_do_not_influence_each_other(config: NetworkConfig, batch: int) -> None:
    graphs = _graphs(batch)

    together = _net(config)(graphs)

    assert together.shape == (50, batch)
    for i in range(batch):
        alone = _net(config)(_one(graphs, i))
        torch.testing.assert_close(together[:, i : i + 1], alone, rtol=1e-4, atol=1e-4)


@every_network
@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), edges=st.integers(1, 40), batch=st.integers(1, 3))
def test_order_of_edges_does_not_matter(
    config: NetworkConfig, seed: int, edges: int, batch: int
) -> None:
    graphs, net = _graphs(batch, edges, seed), _net(config)
    order = torch.randperm(edges, generator=torch.Generator().manual_seed(seed))
    shuffled = replace(graphs, edges=graphs.edges[order], distances=graphs.distances[order])

    torch.testing.assert_close(net(shuffled), net(graphs)[order], rtol=1e-3, atol=1e-3)


@every_network
def test_both_ends_of_an_edge_count(config: NetworkConfig) -> None:
    graphs, net = _graphs(batch=1), _net(config)
    keypoints, points = graphs.keypoints.clone(), graphs.points.clone()
    keypoints[graphs.edges[0, 0, 0]] += 1
    points[graphs.edges[0, 0, 1]] += 1
    before = net(graphs)

    for changed in (replace(graphs, keypoints=keypoints), replace(graphs, points=points)):
        assert not torch.allclose(net(changed), before)


@every_network
def test_every_weight_learns_in_bfloat16_too(config: NetworkConfig) -> None:
    net = _net(config)

    with torch.autocast('cpu', torch.bfloat16):
        logits = net(_graphs(batch=2))
    logits.square().sum().backward()

    assert logits.dtype == torch.float32
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in net.parameters())


@every_network
@pytest.mark.parametrize('edges', [1, 2])
def test_very_few_edges_get_finite_logits_and_gradients(config: NetworkConfig, edges: int) -> None:
    net = _net(config)

    logits = net(_graphs(batch=2, edges=edges))
    logits.sum().backward()

    assert logits.shape == (edges, 2)
    assert torch.isfinite(logits).all()
    assert all(p.grad is None or torch.isfinite(p.grad).all() for p in net.parameters())


@every_network
def test_same_input_same_output(config: NetworkConfig) -> None:
    assert torch.equal(_net(config)(_graphs(batch=2)), _net(config)(_graphs(batch=2)))
