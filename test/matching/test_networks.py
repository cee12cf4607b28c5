# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import asdict

import pytest

from gam_relocalizer.matching.graph import MatchingNetwork
from gam_relocalizer.matching.networks import NETWORK_NAMES, create_config, create_network, name_of
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
