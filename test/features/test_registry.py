# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from netvlad_file import write_netvlad_file

from gam_relocalizer.errors import UsageError
from gam_relocalizer.features import EXTRACTOR_NAMES, create_extractor
from gam_relocalizer.features.registry import GLOBAL_DESCRIPTOR_NAMES, load_global_descriptor
from gam_relocalizer.features.vlad import Vlad


@pytest.mark.parametrize('name', EXTRACTOR_NAMES)
def test_creates_what_is_asked_for(name: str) -> None:
    assert create_extractor(name).identity.name == name


def test_unknown_name_is_refused_with_the_known_ones() -> None:
    with pytest.raises(UsageError, match='xfeat, sift'):
        create_extractor('surf')


def test_refuses_to_keep_no_keypoints() -> None:
    with pytest.raises(UsageError):
        create_extractor('sift', max_keypoints=0)


@pytest.mark.parametrize(
    ('name', 'weights', 'told'),
    [
        ('bag-of-words', None, 'vlad, netvlad'),
        ('netvlad', None, 'weights'),
        ('vlad', Path('netvlad.mat'), r'netvlad\.mat'),
    ],
)
def test_global_descriptors_are_asked_for_with_the_weights_that_they_need(
    name: str, weights: Path | None, told: str
) -> None:
    with pytest.raises(UsageError, match=told):
        load_global_descriptor(name, weights)


@pytest.mark.parametrize('name', GLOBAL_DESCRIPTOR_NAMES)
def test_global_descriptors_are_named_as_asked_for(name: str, tmp_path: Path) -> None:
    weights = write_netvlad_file(tmp_path / 'weights.mat') if name == 'netvlad' else None
    described_by = load_global_descriptor(name, weights) or Vlad(np.ones((1, 2), np.float32))
    assert described_by.name == name
