# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""2D-3D matching: kNN ratio candidates, BMNet, Hungarian pooling, and a baseline."""

from gam_relocalizer.matching.baselines import NearestNeighbourRatio
from gam_relocalizer.matching.bmnet import normalise_keypoints
from gam_relocalizer.matching.gam import Gam
from gam_relocalizer.matching.matcher import Matcher, Matches

__all__ = ['Gam', 'Matcher', 'Matches', 'NearestNeighbourRatio', 'normalise_keypoints']
