# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""2D-3D matching: kNN ratio candidates, networks that judge them, Hungarian pooling, baselines."""

from gam_relocalizer.matching.bmnet import normalise_keypoints, normalised_focal_length
from gam_relocalizer.matching.matcher import Matcher, Matches, MatchInput
from gam_relocalizer.matching.registry import create_matcher

__all__ = [
    'MatchInput',
    'Matcher',
    'Matches',
    'create_matcher',
    'normalise_keypoints',
    'normalised_focal_length',
]
