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
from gam_relocalizer.matching.gamnet import GamNetConfig
from gam_relocalizer.matching.lgcnet import LgcNetConfig
from gam_relocalizer.matching.networks import NETWORK_NAMES, create_network, name_of
from gam_relocalizer.matching.oanet import OaNetConfig
from gam_relocalizer.matching.registry import LEARNED_MATCHERS
from gam_relocalizer.matching.weights import (
    FORMAT,
    SHIPPED,
    Provenance,
    load_weights,
    save_weights,
)

if TYPE_CHECKING:
    from pathlib import Path

    from gam_relocalizer.matching.networks import NetworkConfig

CONFIG = BMNetConfig(point_blocks=3, edge_blocks=2, point_width=8)
PROVENANCE = Provenance(
    steps=10, planned_steps=20, seed=3, extractors=('sift', 'xfeat'), average_precision=0.5
)
SMALL: list[NetworkConfig] = [
    CONFIG,
    GamNetConfig(blocks=2, width=8),
    LgcNetConfig(blocks=2, width=8),
    OaNetConfig(blocks=2, filters=1, width=8, clusters=4),
]


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


@pytest.mark.parametrize('config', SMALL)
def test_every_network_is_saved_and_loaded_ready_for_use(
    config: NetworkConfig, tmp_path: Path
) -> None:
    torch.manual_seed(1)
    network = create_network(config)
    save_weights(tmp_path / 'net.npz', network, PROVENANCE)

    loaded, _ = load_weights(tmp_path / 'net.npz')

    assert type(loaded) is type(network)
    assert loaded.config == config
    assert not loaded.training
    for name, value in network.state_dict().items():
        torch.testing.assert_close(loaded.state_dict()[name], value.half().float())


def test_the_header_tells_the_network_its_size_and_its_origin(saved: Path) -> None:
    with np.load(saved) as file:
        header = json.loads(file['header'].tobytes())

    assert header['format'] == FORMAT == 2
    assert header['net'] == {
        'name': 'bmnet',
        'point_blocks': 3,
        'edge_blocks': 2,
        'point_width': 8,
        'perceptrons': 2,
    }
    assert header['provenance']['extractors'] == ['sift', 'xfeat']
    assert len(header['sha256']) == 64


def test_same_network_same_file(saved: Path, tmp_path: Path) -> None:
    network, provenance = load_weights(saved)

    save_weights(tmp_path / 'again.npz', network, provenance)

    with np.load(saved) as first, np.load(tmp_path / 'again.npz') as second:
        assert first.files == second.files
        for name in first.files:
            np.testing.assert_array_equal(first[name], second[name])


@pytest.mark.parametrize('matcher', sorted({one.weights for one in LEARNED_MATCHERS.values()}))
def test_shipped_weights_fit_their_matcher_and_are_small(matcher: str) -> None:
    path = SHIPPED / f'{matcher}.npz'

    network, provenance = load_weights(path)

    assert network.config == LEARNED_MATCHERS[matcher].network
    assert path.stat().st_size <= 10_000_000
    assert provenance.steps == provenance.planned_steps > 0
    assert 0 < provenance.average_precision < 1


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


def test_another_array(saved: Path) -> None:
    _rewrite(saved, another=np.zeros(3, np.float16))

    with pytest.raises(WeightsError, match='another'):
        load_weights(saved)


def test_values_that_are_no_half_precision_numbers(saved: Path) -> None:
    for values in (np.full((32, 2), 'a'), np.zeros((32, 2)), np.zeros((32, 2), np.complex64)):
        _rewrite(saved, keypoint_net__0__linears__0__weight=values)

        with pytest.raises(WeightsError):
            load_weights(saved)


def test_one_changed_bit_anywhere(saved: Path) -> None:
    content = bytearray(saved.read_bytes())
    content[len(content) // 2] ^= 1
    saved.write_bytes(content)

    with pytest.raises(WeightsError):
        load_weights(saved)


def test_other_shape(saved: Path) -> None:
    _rewrite(saved, keypoint_net__0__linears__0__weight=np.zeros((3, 3), np.float16))

    with pytest.raises(WeightsError, match=r'keypoint_net\.0\.linears\.0\.weight'):
        load_weights(saved)


@pytest.mark.parametrize(
    'header',
    [
        {'format': 1},
        {'format': 99},
        {'format': 'x'},
        {'net': {'point_blocks': 3, 'edge_blocks': 2, 'point_width': 8}},
        {'net': {'name': 'bmnet', 'point_blocks': 3}},
        {'net': {'name': 'bmnet', 'depth': 3}},
        {'net': {'name': 'gamnet', 'blocks': 2, 'width': 8}},
        {'net': {'name': 'nonsense', 'blocks': 2}},
        {'net': {'name': ['bmnet']}},
        {'net': 'bmnet'},
        {'net': None},
        {'provenance': {}},
        {'provenance': None},
        {'provenance': {'extractors': 3}},
        {'sha256': None},
        {'net': {'name': 'bmnet', 'point_blocks': 3, 'edge_blocks': 10**9, 'point_width': 8}},
        {'net': {'name': 'bmnet', 'point_blocks': 3, 'edge_blocks': 0, 'point_width': 8}},
        {'net': {'name': 'bmnet', 'point_blocks': 3, 'edge_blocks': 2, 'point_width': 'wide'}},
        {'net': {'name': 'bmnet', 'point_blocks': 3, 'edge_blocks': True, 'point_width': 8}},
        {'net': {'name': 'oanet', 'blocks': 2, 'filters': 1, 'width': 8, 'clusters': 10**9}},
    ],
)
def test_other_header(saved: Path, header: dict[str, object]) -> None:
    _rewrite(saved, **header)

    with pytest.raises(WeightsError):
        load_weights(saved)


@pytest.mark.parametrize(
    'header', [b'', b'{', b'[]', b'3', b'null', b'"text"', b'\xff\xfe', b'[' * 5000]
)
def test_header_that_is_none(saved: Path, header: bytes) -> None:
    with np.load(saved) as file:
        arrays = {name: file[name] for name in file.files}
    arrays['header'] = np.frombuffer(header, np.uint8)
    np.savez(saved, **arrays)

    with pytest.raises(WeightsError):
        load_weights(saved)


def test_array_that_claims_to_be_huge(tmp_path: Path) -> None:
    path = tmp_path / 'bomb.npz'
    np.savez_compressed(path, header=np.zeros(200_000_000, np.uint8))
    assert path.stat().st_size < 1_000_000

    with pytest.raises(WeightsError):
        load_weights(path)


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


def test_an_unfinished_write_leaves_the_file_that_was_there(
    saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full_disk(*_: object, **__: object) -> None:
        raise OSError(28, 'No space left on device')

    before = saved.read_bytes()
    monkeypatch.setattr(np, 'savez', full_disk)

    with pytest.raises(WeightsError):
        save_weights(saved, BMNet(CONFIG), PROVENANCE)

    assert saved.read_bytes() == before


def test_networks_of_all_names_are_tested() -> None:
    assert sorted(map(name_of, SMALL)) == sorted(NETWORK_NAMES)
