# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from gam_relocalizer.errors import WeightsError
from gam_relocalizer.matching.bmnet import BMNet, BMNetConfig
from gam_relocalizer.matching.weights import (
    SHIPPED_WEIGHTS,
    Provenance,
    load_weights,
    save_weights,
)

if TYPE_CHECKING:
    from pathlib import Path

CONFIG = BMNetConfig(point_blocks=3, edge_blocks=2, point_width=8)
PROVENANCE = Provenance(steps=10, planned_steps=20, seed=3, average_precision=0.5)


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    torch.manual_seed(0)
    path = tmp_path / 'net.npz'
    save_weights(path, BMNet(CONFIG), PROVENANCE)
    return path


def _rewrite(path: Path, **changes: object) -> None:
    """Change entries of the header, or arrays when given as arrays."""
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    header = json.loads(arrays['header'].tobytes())
    for name, value in changes.items():
        if isinstance(value, np.ndarray):
            arrays[name.replace('__', '.')] = value
        else:
            header[name] = value
    arrays['header'] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    np.savez(path, **arrays)


def test_loads_what_was_saved_to_half_precision(saved: Path) -> None:
    net, provenance = load_weights(saved)

    torch.manual_seed(0)
    for name, value in BMNet(CONFIG).state_dict().items():
        torch.testing.assert_close(net.state_dict()[name], value.half().float())
    assert net.config == CONFIG
    assert provenance == PROVENANCE
    assert [p.name for p in saved.parent.iterdir()] == ['net.npz']


def test_shipped_weights_are_of_the_published_size_and_small() -> None:
    net, provenance = load_weights()

    assert net.config == BMNetConfig()
    assert SHIPPED_WEIGHTS.stat().st_size <= 10_000_000
    assert provenance.steps > 0


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(WeightsError):
        load_weights(tmp_path / 'absent.npz')


@pytest.mark.parametrize('share', [0.0, 0.3, 0.99])
def test_truncated_file(saved: Path, share: float) -> None:
    content = saved.read_bytes()
    saved.write_bytes(content[: int(share * len(content))])

    with pytest.raises(WeightsError):
        load_weights(saved)


def test_changed_values(saved: Path) -> None:
    _rewrite(saved, keypoint_net__0__linears__0__weight=np.zeros((32, 2), np.float16))

    with pytest.raises(WeightsError, match='sha256'):
        load_weights(saved)


def test_other_shape(saved: Path) -> None:
    _rewrite(saved, keypoint_net__0__linears__0__weight=np.zeros((3, 3), np.float16))

    with pytest.raises(WeightsError, match=r'keypoint_net\.0\.linears\.0\.weight'):
        load_weights(saved)


@pytest.mark.parametrize(
    'header',
    [
        {'format': 99},
        {'format': 'x'},
        {'net': {'point_blocks': 3}},
        {'net': {'depth': 3}},
        {'net': None},
        {'provenance': {}},
        {'net': {'point_blocks': 3, 'edge_blocks': 10**9, 'point_width': 8}},
        {'net': {'point_blocks': 3, 'edge_blocks': 2, 'point_width': 'wide'}},
    ],
)
def test_other_header(saved: Path, header: dict[str, object]) -> None:
    _rewrite(saved, **header)

    with pytest.raises(WeightsError):
        load_weights(saved)


def test_file_without_header(tmp_path: Path) -> None:
    np.savez(tmp_path / 'other.npz', a=np.zeros(3))

    with pytest.raises(WeightsError):
        load_weights(tmp_path / 'other.npz')


def test_pickled_content_is_never_run(tmp_path: Path) -> None:
    np.savez(tmp_path / 'evil.npz', header=np.array([object()], dtype=object))

    with pytest.raises(WeightsError):
        load_weights(tmp_path / 'evil.npz')


def test_unwritable_place(tmp_path: Path) -> None:
    with pytest.raises(WeightsError):
        save_weights(tmp_path / 'absent' / 'net.npz', BMNet(CONFIG), PROVENANCE)
