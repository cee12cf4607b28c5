# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The matching networks by the name that weights files and command lines know them by."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from gam_relocalizer.matching.bmnet import BMNet, BMNetConfig
from gam_relocalizer.matching.gamnet import GamNet, GamNetConfig
from gam_relocalizer.matching.lgcnet import LgcNet, LgcNetConfig
from gam_relocalizer.matching.oanet import OaNet, OaNetConfig

if TYPE_CHECKING:
    from gam_relocalizer.matching.graph import MatchingNetwork

NetworkConfig = GamNetConfig | BMNetConfig | LgcNetConfig | OaNetConfig

_NETWORKS: dict[str, tuple[type[Any], type[Any]]] = {
    'gamnet': (GamNet, GamNetConfig),
    'bmnet': (BMNet, BMNetConfig),
    'lgcnet': (LgcNet, LgcNetConfig),
    'oanet': (OaNet, OaNetConfig),
}
NETWORK_NAMES = tuple(_NETWORKS)


def create_config(name: str, sizes: dict[str, int] | None = None) -> NetworkConfig:
    """The config of a network, of default size but for what is given.

    Raises:
        KeyError: No network has that name.
        TypeError: The network has no such size.
    """
    config: NetworkConfig = _NETWORKS[name][1](**(sizes or {}))
    return config


def create_network(config: NetworkConfig) -> MatchingNetwork:
    """The network of a config, with random weights."""
    network: MatchingNetwork = _NETWORKS[name_of(config)][0](config)
    return network


def name_of(config: NetworkConfig) -> str:
    """The name of the network that has such a config."""
    return next(name for name, (_, kind) in _NETWORKS.items() if isinstance(config, kind))
