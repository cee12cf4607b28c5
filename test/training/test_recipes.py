# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from gam_relocalizer.errors import UsageError
from gam_relocalizer.matching.networks import create_network
from gam_relocalizer.matching.registry import LEARNED_MATCHERS, MATCHER_NAMES
from gam_relocalizer.training.recipes import FINE_TUNING_STEPS, fine_tuning, recipe

if TYPE_CHECKING:
    from collections.abc import Callable

    from gam_relocalizer.training.loop import TrainingOptions

TRAINED = sorted({learned.weights for learned in LEARNED_MATCHERS.values()})
OTHERS = sorted({*MATCHER_NAMES} - {*TRAINED})


@pytest.mark.parametrize('matcher', TRAINED)
def test_weights_are_trained_for_the_matcher_that_uses_them(matcher: str) -> None:
    learned = LEARNED_MATCHERS[matcher]

    options = recipe(matcher)

    assert create_network(options.network).config == learned.network
    assert (options.rule.neighbours, options.rule.ratio) == (learned.neighbours, learned.ratio)
    assert options.rule.mining == learned.mining
    assert options.pooled == learned.pooling


@pytest.mark.parametrize('matcher', TRAINED)
def test_fine_tuning_is_the_same_but_shorter_and_gentler(matcher: str) -> None:
    whole, fine = recipe(matcher), fine_tuning(matcher)

    assert (fine.network, fine.rule, fine.pooled) == (whole.network, whole.rule, whole.pooled)
    assert fine.steps == FINE_TUNING_STEPS < whole.steps
    assert fine.learning_rate < whole.learning_rate
    assert fine.plain_share == 0
    assert fine.validate_every < fine.steps


def test_what_sets_the_variants_apart_is_how_they_are_trained() -> None:
    small, plain, no_mining = (
        recipe(name) for name in ('bmnet-small', 'plainnet', 'bmnet-no-mining')
    )

    assert plain == replace(small, pooled=False)
    assert no_mining == replace(small, rule=replace(small.rule, mining=False))
    assert small == replace(recipe('bmnet'), network=small.network)


@pytest.mark.parametrize('matcher', [*OTHERS, 'nonsense', ''])
@pytest.mark.parametrize('of', [recipe, fine_tuning])
def test_matchers_without_weights_of_their_own_have_none(
    of: Callable[[str], TrainingOptions], matcher: str
) -> None:
    with pytest.raises(UsageError):
        of(matcher)
