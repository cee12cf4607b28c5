# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Weights files: float16 arrays in an npz, with the network's name and size, and their origin."""

from __future__ import annotations

import hashlib
import json
import zipfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from gam_relocalizer.errors import WeightsError
from gam_relocalizer.matching.networks import (
    NETWORK_NAMES,
    create_config,
    create_network,
    name_of,
)

if TYPE_CHECKING:
    from gam_relocalizer.matching.graph import MatchingNetwork
    from gam_relocalizer.matching.networks import NetworkConfig

FORMAT = 2
SHIPPED = Path(__file__).with_name('weights')
HEADER = 'header'
MAX_FILE_BYTES = 100_000_000
MAX_SIZE = 1024


@dataclass(frozen=True)
class Provenance:
    """How weights came about.

    Attributes:
        steps: Steps trained.
        planned_steps: Steps of the whole run, which sets its learning rates.
        seed: Of the run.
        extractors: Whose descriptors the graphs were made with.
        average_precision: On the validation graphs.
    """

    steps: int
    planned_steps: int
    seed: int
    extractors: tuple[str, ...]
    average_precision: float


def save_weights(path: Path, net: MatchingNetwork, provenance: Provenance) -> None:
    """Write a network, under a temporary name first.

    Raises:
        WeightsError: The file cannot be written.
    """
    arrays = {
        name: value.detach().cpu().numpy().astype(np.float16)
        for name, value in net.state_dict().items()
    }
    header = {
        'format': FORMAT,
        'net': {'name': name_of(net.config), **asdict(net.config)},
        'provenance': asdict(provenance),
        'sha256': _digest(arrays),
    }
    header_bytes = np.frombuffer(json.dumps(header).encode(), np.uint8)
    temporary = path.with_name(f'{path.name}.tmp')
    try:
        with temporary.open('wb') as file:
            np.savez(file, allow_pickle=False, **{HEADER: header_bytes, **arrays})
        temporary.replace(path)
    except OSError as error:
        raise WeightsError(f'cannot write the weights to {path}: {error}') from error


def load_weights(path: Path) -> tuple[MatchingNetwork, Provenance]:
    """Read a network ready for inference.

    Raises:
        WeightsError: The file is missing, damaged, of another version or of another network.
    """
    arrays = _read_arrays(path)
    header = _read_header(path, arrays.pop(HEADER, None))
    try:
        sizes = dict(header['net'])
        config = create_config(sizes.pop('name'), sizes)
        provenance = _provenance(header['provenance'])
        expected_digest = header['sha256']
    except (KeyError, TypeError, ValueError) as error:
        raise WeightsError(
            f'the header of the weights file {path} lacks or misnames an entry: {error!r}; known '
            f'networks are {", ".join(NETWORK_NAMES)}; write the file again with '
            '`gam_relocalizer train`'
        ) from error
    _check_size(path, config)
    net = create_network(config)
    _check_shapes(path, net, arrays)
    if _digest(arrays) != expected_digest:
        raise WeightsError(
            f'the weights file {path} is damaged: its arrays do not have the sha256 '
            f'{expected_digest} of its header; fetch or write it again'
        )
    net.load_state_dict(
        {name: torch.from_numpy(array.astype(np.float32)) for name, array in arrays.items()}
    )
    net.eval()
    return net, provenance


def _read_arrays(path: Path) -> dict[str, Any]:
    try:
        size = path.stat().st_size
        if size > MAX_FILE_BYTES:
            raise WeightsError(
                f'{path} has {size} bytes, more than the {MAX_FILE_BYTES} that weights may have'
            )
        _check_unpacked_size(path)
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except FileNotFoundError as error:
        raise WeightsError(
            f'there is no weights file at {path}: give the path of a file that '
            '`gam_relocalizer train` wrote, or none for the shipped weights'
        ) from error
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise WeightsError(
            f'{path} is not a readable weights file ({error}); expected an npz archive that '
            '`gam_relocalizer train` wrote: fetch or write it again'
        ) from error


def _check_unpacked_size(path: Path) -> None:
    with zipfile.ZipFile(path) as archive:
        declared = sum(entry.file_size for entry in archive.infolist())
    if declared > MAX_FILE_BYTES:
        raise ValueError(f'its arrays would take {declared} bytes')


def _read_header(path: Path, stored: Any) -> dict[str, Any]:  # noqa: ANN401 - untrusted
    try:
        header = json.loads(np.asarray(stored, np.uint8).tobytes())
        version = header['format']
    except (TypeError, ValueError, KeyError, UnicodeDecodeError, RecursionError) as error:
        raise WeightsError(
            f'{path} has no header of a weights file; expected a file that '
            '`gam_relocalizer train` wrote'
        ) from error
    if version != FORMAT:
        raise WeightsError(
            f'the weights file {path} is of format {version}, expected {FORMAT}: '
            'use the release that wrote it, or train again'
        )
    return dict(header)


def _provenance(stored: dict[str, Any]) -> Provenance:
    return Provenance(**{**stored, 'extractors': tuple(stored['extractors'])})


def _check_size(path: Path, config: NetworkConfig) -> None:
    """Before a header makes the program build a network that does not fit the memory."""
    for name, value in asdict(config).items():
        if not isinstance(value, int) or not 1 <= value <= MAX_SIZE:
            raise WeightsError(
                f'the weights file {path} asks for {name} = {value!r}, expected 1 to {MAX_SIZE}'
            )


def _check_shapes(path: Path, net: MatchingNetwork, arrays: dict[str, Any]) -> None:
    expected = {name: ('float16', tuple(value.shape)) for name, value in net.state_dict().items()}
    found = {name: (array.dtype.name, array.shape) for name, array in arrays.items()}
    if found == expected:
        return
    differing = sorted(
        name for name in expected.keys() | found.keys() if expected.get(name) != found.get(name)
    )
    name = differing[0]
    raise WeightsError(
        f'the weights file {path} does not fit the network of its header: {len(differing)} arrays '
        f'differ, first {name}: {found.get(name)}, expected {expected.get(name)}'
    )


def _digest(arrays: dict[str, Any]) -> str:
    digest = hashlib.sha256()
    for name in sorted(arrays):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(arrays[name], np.float16).tobytes())
    return digest.hexdigest()
