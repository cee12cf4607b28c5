# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""How the network of each matcher is trained: alike, but for what sets it apart."""

from __future__ import annotations

from dataclasses import replace

from gam_relocalizer.errors import UsageError
from gam_relocalizer.matching.registry import LEARNED_MATCHERS
from gam_relocalizer.training.labelled import CandidateRule
from gam_relocalizer.training.loop import TrainingOptions

FINE_TUNING_STEPS = 1_000
# A tenth of that of a run from random weights: the rest of what it knows should stay.
FINE_TUNING_RATE = 3e-4


def recipe(matcher: str) -> TrainingOptions:
    """Options of a run that starts from random weights.

    Raises:
        UsageError: No network of that name is trained.
    """
    trained = {
        name: learned for name, learned in LEARNED_MATCHERS.items() if name == learned.weights
    }
    if matcher not in trained:
        msg = f'the matcher `{matcher}` has no network of its own; these have: {", ".join(trained)}'
        raise UsageError(msg)
    learned = trained[matcher]
    return TrainingOptions(
        network=learned.network,
        rule=CandidateRule(learned.neighbours, learned.ratio, mining=learned.mining),
        pooled=learned.pooling,
    )


def fine_tuning(matcher: str) -> TrainingOptions:
    """Options of a run that starts from the shipped weights.

    Raises:
        UsageError: No network of that name is trained.
    """
    return replace(
        recipe(matcher),
        steps=FINE_TUNING_STEPS,
        learning_rate=FINE_TUNING_RATE,
        plain_share=0.0,
        validate_every=FINE_TUNING_STEPS // 4,
    )
