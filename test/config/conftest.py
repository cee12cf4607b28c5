# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import yaml

from gam_relocalizer.ros.interface import Topic

REPOSITORY = Path(__file__).parents[2]


class StrictLoader(yaml.SafeLoader):
    """Refuses a key that is there twice: the first one would be lost without a word."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:  # noqa: FBT001, FBT002 - overrides
        keys = Counter(self.construct_object(key, deep=deep) for key, _ in node.value)
        assert not [key for key, count in keys.items() if count > 1], node.start_mark
        return super().construct_mapping(node, deep=deep)


def read_yaml(name: str) -> Any:  # noqa: ANN401 - whatever the file holds
    text = (REPOSITORY / 'config' / name).read_text(encoding='utf-8')
    loader = StrictLoader(text)
    try:
        return loader.get_single_data()
    finally:
        loader.dispose()


@pytest.fixture(scope='session')
def config_folder() -> Path:
    return REPOSITORY / 'config'


@pytest.fixture(scope='session')
def ekf() -> dict[str, Any]:
    return read_yaml('ekf.yaml')['/**/ekf_filter_node_map']['ros__parameters']


@pytest.fixture(scope='session')
def fuse() -> dict[str, Any]:
    return read_yaml('fuse.yaml')['fixed_lag_smoother_node']['ros__parameters']


@pytest.fixture(scope='session')
def rviz() -> dict[str, Any]:
    return read_yaml('relocalizer.rviz')


@pytest.fixture(scope='session')
def topics() -> dict[str, Topic]:
    """All topics of a node without a namespace, by their full names."""
    return {full_name(topic.topic): topic for topic in Topic}


def full_name(name: str) -> str:
    if name.startswith('~/'):
        return f'/gam_relocalizer/{name[2:]}'
    return name if name.startswith('/') else f'/{name}'
