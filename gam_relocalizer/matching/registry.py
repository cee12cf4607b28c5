# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The matchers by the name that command lines and parameters know them by."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from gam_relocalizer.errors import UsageError, WeightsError
from gam_relocalizer.matching.baselines import (
    NearestNeighbourCross,
    NearestNeighbourDistance,
    NearestNeighbourRatio,
)
from gam_relocalizer.matching.bmnet import BMNetConfig
from gam_relocalizer.matching.gam import NEIGHBOURS, RATIO, Gam
from gam_relocalizer.matching.gamnet import GamNetConfig
from gam_relocalizer.matching.lgcnet import LgcNetConfig
from gam_relocalizer.matching.networks import name_of
from gam_relocalizer.matching.oanet import OaNetConfig
from gam_relocalizer.matching.weights import SHIPPED, load_weights

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from gam_relocalizer.matching.matcher import Matcher
    from gam_relocalizer.matching.networks import NetworkConfig

DEFAULT_MATCHER = 'gam'
# Below it hardly a match is true, and the search for a pose only has more to draw from.
_UNLIKELY = 0.1
# Anything from 4 to 40 does as well.
_LIKENESS = 10.0
# An outlier filter without pooling decides by itself what a match is.
_LIKELY = 0.5
# The ablation is about how a network is trained: at half the size, each takes minutes.
_SMALL = BMNetConfig(edge_blocks=9, point_width=64)


@dataclass(frozen=True)
class LearnedMatcher:
    """A network, and how its judgement becomes matches.

    Attributes:
        weights: Name of the shipped weights, which is that of the matcher they were trained for.
        network: Its kind and size.
        neighbours: See `knn_ratio`.
        ratio: See `knn_ratio`.
        pooling: Whether Hungarian pooling makes matches one-to-one.
        least_weight: Matches of lower weight are left out.
        likeness: How much looks count beside the weight in the pooling, see `Gam`.
        mining: Whether kNN ratio matching found the false edges that it learned from.
    """

    weights: str
    network: NetworkConfig
    neighbours: int = NEIGHBOURS
    ratio: float = RATIO
    pooling: bool = True
    least_weight: float = 0.0
    likeness: float = 0.0
    mining: bool = True

    @property
    def shipped(self) -> Path:
        """The file of the shipped weights."""
        return SHIPPED / f'{self.weights}.npz'

    def load(self, weights: Path | None = None, extractor: str | None = None) -> Matcher:
        """The matcher with the weights of a file, the shipped ones if no path is given.

        Raises:
            WeightsError: The file is missing, damaged, of another network, or not made for the
                extractor.
        """
        path = weights or self.shipped
        network, provenance = load_weights(path)
        if name_of(network.config) != name_of(self.network):
            raise WeightsError(
                f'the weights file {path} is of the network {name_of(network.config)}, the '
                f'matcher needs those of {name_of(self.network)}'
            )
        known = provenance.extractors
        if network.compares_looks and extractor is not None and extractor not in known:
            raise WeightsError(
                f'the weights file {path} learned how descriptors of {", ".join(known) or "none"} '
                f'compare, the map has those of {extractor}: use the matcher `bmnet`, which looks '
                'at geometry alone, or fine-tune on the map with `gam_relocalizer train --map`'
            )
        return Gam(
            network,
            self.neighbours,
            self.ratio,
            pooling=self.pooling,
            least_weight=self.least_weight,
            likeness=self.likeness,
        )


def _outlier_filter(name: str, network: NetworkConfig) -> LearnedMatcher:
    """A network that sees nearest neighbours only, each a match or not."""
    return LearnedMatcher(name, network, 1, 1.0, pooling=False, least_weight=_LIKELY)


LEARNED_MATCHERS = {
    'gam': LearnedMatcher('gam', GamNetConfig(), least_weight=_UNLIKELY, likeness=_LIKENESS),
    'bmnet': LearnedMatcher('bmnet', BMNetConfig()),
    'knn-bmnet': LearnedMatcher('bmnet', BMNetConfig(), ratio=0.0),
    'bmnet-small': LearnedMatcher('bmnet-small', _SMALL),
    'bmnet-no-mining': LearnedMatcher('bmnet-no-mining', _SMALL, mining=False),
    'plainnet': LearnedMatcher('plainnet', _SMALL, pooling=False, least_weight=_LIKELY),
    'plainnet-hp': LearnedMatcher('plainnet', _SMALL),
    'nn-lgcnet': _outlier_filter('nn-lgcnet', LgcNetConfig()),
    'nn-oanet': _outlier_filter('nn-oanet', OaNetConfig()),
}
_HANDCRAFTED: dict[str, Callable[[], Matcher]] = {
    'nn-ratio': NearestNeighbourRatio,
    'nn-cross': NearestNeighbourCross,
    'nn-distance': NearestNeighbourDistance,
}
MATCHER_NAMES = (*LEARNED_MATCHERS, *_HANDCRAFTED)


def create_matcher(
    name: str = DEFAULT_MATCHER,
    *,
    weights: Path | None = None,
    neighbours: int | None = None,
    ratio: float | None = None,
    extractor: str | None = None,
) -> Matcher:
    """The matcher of that name.

    Args:
        name: One of `MATCHER_NAMES`.
        weights: Of a learned matcher, instead of the shipped ones.
        neighbours: Of a learned matcher, instead of its own; see `knn_ratio`.
        ratio: Of a learned matcher, instead of its own; see `knn_ratio`.
        extractor: Name of what makes the descriptors, if it is to be checked.

    Raises:
        UsageError: Unknown name, or an argument that the matcher has no use for.
        WeightsError: Weights are missing, damaged, of another network or another extractor.
    """
    if name in LEARNED_MATCHERS:
        learned = LEARNED_MATCHERS[name]
        if neighbours is not None:
            learned = replace(learned, neighbours=neighbours)
        if ratio is not None:
            learned = replace(learned, ratio=ratio)
        return learned.load(weights, extractor)
    if name not in _HANDCRAFTED:
        msg = f'unknown matcher `{name}`; known are {", ".join(MATCHER_NAMES)}'
        raise UsageError(msg)
    if (weights, neighbours, ratio) != (None, None, None):
        msg = f'the matcher `{name}` has neither weights nor candidates to set'
        raise UsageError(msg)
    return _HANDCRAFTED[name]()
