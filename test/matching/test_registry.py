# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from gam_relocalizer.errors import UsageError, WeightsError
from gam_relocalizer.matching.bmnet import BMNet, BMNetConfig
from gam_relocalizer.matching.gamnet import GamNet, GamNetConfig
from gam_relocalizer.matching.matcher import MatchInput
from gam_relocalizer.matching.registry import (
    DEFAULT_MATCHER,
    LEARNED_MATCHERS,
    MATCHER_NAMES,
    create_matcher,
)
from gam_relocalizer.matching.weights import Provenance, load_weights, save_weights
from gam_relocalizer.training.synthetic import synthetic_view

if TYPE_CHECKING:
    from pathlib import Path

    from gam_relocalizer.matching.graph import MatchingNetwork


def _given() -> MatchInput:
    view = synthetic_view(np.random.default_rng(0), (150, 150), (400, 400))
    return MatchInput(
        view.keypoints, view.focal_length, view.descriptors, view.points, view.point_descriptors
    )


def _saved(path: Path, network: MatchingNetwork, extractors: tuple[str, ...]) -> Path:
    save_weights(path, network, Provenance(1, 1, 0, extractors, 0.5))
    return path


@pytest.fixture
def gam_weights(tmp_path: Path) -> Path:
    torch.manual_seed(1)
    network = GamNet(GamNetConfig(blocks=1, width=8))
    return _saved(tmp_path / 'gam.npz', network, ('sift',))


@pytest.mark.parametrize('name', MATCHER_NAMES)
def test_every_matcher_comes_with_what_it_needs(name: str) -> None:
    matches = create_matcher(name).match(_given())

    assert len(matches) > 0
    assert np.isfinite(matches.weights).all()


def test_the_default_is_a_matcher() -> None:
    assert DEFAULT_MATCHER in MATCHER_NAMES


@pytest.mark.parametrize('name', LEARNED_MATCHERS)
def test_shipped_weights_are_of_the_network_of_their_matcher(name: str) -> None:
    learned = LEARNED_MATCHERS[name]

    network, provenance = load_weights(learned.shipped)

    assert network.config == learned.network
    assert provenance.steps > 0


def test_all_shipped_weights_together_are_small() -> None:
    files = {learned.shipped for learned in LEARNED_MATCHERS.values()}

    assert sum(file.stat().st_size for file in files) < 20_000_000


def test_other_weights_give_other_matches(gam_weights: Path) -> None:
    shipped = create_matcher('gam').match(_given())
    other = create_matcher('gam', weights=gam_weights).match(_given())

    assert sorted(shipped.weights) != sorted(other.weights)


def test_one_neighbour_gives_fewer_candidates() -> None:
    three = create_matcher('plainnet').match(_given())
    nearest = create_matcher('plainnet', neighbours=1, ratio=1.0).match(_given())

    assert len(np.unique(nearest.keypoint_indices)) == len(nearest)
    assert len(np.unique(three.keypoint_indices)) < len(three)


def test_unknown_name() -> None:
    with pytest.raises(UsageError):
        create_matcher('superglue')


def test_handcrafted_matchers_take_no_weights(gam_weights: Path) -> None:
    with pytest.raises(UsageError):
        create_matcher('nn-cross', weights=gam_weights)


def test_refuses_weights_of_another_network(gam_weights: Path) -> None:
    with pytest.raises(WeightsError):
        create_matcher('bmnet', weights=gam_weights)


def test_refuses_to_compare_looks_that_it_did_not_learn(gam_weights: Path) -> None:
    create_matcher('gam', weights=gam_weights, extractor='sift')
    with pytest.raises(WeightsError):
        create_matcher('gam', weights=gam_weights, extractor='xfeat')


def test_geometry_alone_serves_every_extractor(tmp_path: Path) -> None:
    network = BMNet(BMNetConfig(point_blocks=2, edge_blocks=1, point_width=8))
    path = _saved(tmp_path / 'bmnet.npz', network, ())

    matches = create_matcher('bmnet', weights=path, extractor='anything').match(_given())

    assert len(matches) > 0


@pytest.mark.parametrize('extractor', ['xfeat', 'sift'])
def test_the_default_serves_the_extractors_of_the_project(extractor: str) -> None:
    create_matcher(extractor=extractor)
