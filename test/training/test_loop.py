# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from gam_relocalizer.errors import TrainingError
from gam_relocalizer.matching.bmnet import BMNetConfig
from gam_relocalizer.matching.weights import load_weights
from gam_relocalizer.training.loop import (
    CHECKPOINT_NAME,
    CURVES_NAME,
    LOG_NAME,
    WEIGHTS_NAME,
    Trainer,
    TrainingOptions,
    pooled_cross_entropy,
)

if TYPE_CHECKING:
    from pathlib import Path

    from gam_relocalizer.training.metrics import MatchMetrics

OPTIONS = TrainingOptions(
    steps=6,
    seed=5,
    net=BMNetConfig(point_blocks=3, edge_blocks=2, point_width=16),
    graphs_per_step=2,
    keypoints=(64, 64),
    points=(200, 300),
    validate_every=3,
    validation_graphs=2,
)


class InterruptError(Exception):
    pass


class Recorder:
    """Keeps losses, and interrupts after a step if told so."""

    def __init__(self, stop_after: int | None = None) -> None:
        self.losses: dict[int, float] = {}
        self._stop_after = stop_after

    def on_step(self, step: int, loss: float) -> None:
        self.losses[step] = loss
        if step == self._stop_after:
            raise InterruptError

    def on_validation(self, step: int, metrics: MatchMetrics) -> None:
        assert 0 <= metrics.average_precision <= 1
        assert step in self.losses


@pytest.fixture(scope='module')
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[int, float]]:
    directory = tmp_path_factory.mktemp('run') / 'out'
    recorder = Recorder()
    Trainer(OPTIONS, directory).run(recorder)
    return directory, recorder.losses


def _arrays(path: Path) -> dict[str, np.ndarray]:
    net, _ = load_weights(path)
    return {name: value.numpy() for name, value in net.state_dict().items()}


def test_a_run_leaves_checkpoint_log_curves_and_weights(
    finished: tuple[Path, dict[int, float]],
) -> None:
    directory, losses = finished

    assert sorted(p.name for p in directory.iterdir()) == sorted(
        [CHECKPOINT_NAME, LOG_NAME, CURVES_NAME, WEIGHTS_NAME]
    )
    log = [json.loads(line) for line in (directory / LOG_NAME).read_text().splitlines()]
    assert [record['step'] for record in log] == [3, 6]
    assert list(losses) == [1, 2, 3, 4, 5, 6]
    net, provenance = load_weights(directory / WEIGHTS_NAME)
    assert net.config == OPTIONS.net
    assert (provenance.steps, provenance.seed) == (6, 5)


def test_same_seed_same_weights(finished: tuple[Path, dict[int, float]], tmp_path: Path) -> None:
    recorder = Recorder()

    Trainer(OPTIONS, tmp_path / 'again').run(recorder)

    assert recorder.losses == finished[1]
    expected = _arrays(finished[0] / WEIGHTS_NAME)
    for name, value in _arrays(tmp_path / 'again' / WEIGHTS_NAME).items():
        np.testing.assert_array_equal(value, expected[name])


def test_a_resumed_run_ends_as_an_uninterrupted_one(
    finished: tuple[Path, dict[int, float]], tmp_path: Path
) -> None:
    directory = tmp_path / 'out'
    with pytest.raises(InterruptError):
        Trainer(OPTIONS, directory).run(Recorder(stop_after=5), checkpoint_seconds=0)

    trainer = Trainer(OPTIONS, directory)
    trainer.resume()
    assert 0 < trainer.step < 5
    recorder = Recorder()
    trainer.run(recorder)

    for step, loss in recorder.losses.items():
        assert loss == finished[1][step]
    expected = _arrays(finished[0] / WEIGHTS_NAME)
    for name, value in _arrays(directory / WEIGHTS_NAME).items():
        np.testing.assert_array_equal(value, expected[name])
    log = [json.loads(line) for line in (directory / LOG_NAME).read_text().splitlines()]
    assert [record['step'] for record in log] == [3, 6]


def test_training_lowers_the_loss(tmp_path: Path) -> None:
    recorder = Recorder()
    options = replace(OPTIONS, steps=60, validate_every=60, points=(200, 210))

    Trainer(options, tmp_path / 'out').run(recorder)

    first = [recorder.losses[step] for step in range(7, 17)]
    last = [recorder.losses[step] for step in range(51, 61)]
    assert np.mean(last) < np.mean(first)


def test_refuses_a_directory_that_holds_a_run(
    finished: tuple[Path, dict[int, float]],
) -> None:
    with pytest.raises(TrainingError):
        Trainer(OPTIONS, finished[0]).run(Recorder())


def test_refuses_to_resume_nothing(tmp_path: Path) -> None:
    with pytest.raises(TrainingError):
        Trainer(OPTIONS, tmp_path).resume()


def test_refuses_to_resume_a_run_with_other_options(
    finished: tuple[Path, dict[int, float]],
) -> None:
    with pytest.raises(TrainingError):
        Trainer(replace(OPTIONS, seed=6), finished[0]).resume()


@pytest.mark.parametrize('content', [b'', b'not a checkpoint'])
def test_refuses_a_damaged_checkpoint(tmp_path: Path, content: bytes) -> None:
    (tmp_path / CHECKPOINT_NAME).write_bytes(content)

    with pytest.raises(TrainingError):
        Trainer(OPTIONS, tmp_path).resume()


def test_refuses_a_truncated_checkpoint(
    finished: tuple[Path, dict[int, float]], tmp_path: Path
) -> None:
    content = (finished[0] / CHECKPOINT_NAME).read_bytes()
    (tmp_path / CHECKPOINT_NAME).write_bytes(content[: len(content) // 2])

    with pytest.raises(TrainingError):
        Trainer(OPTIONS, tmp_path).resume()


def test_loss_counts_pooled_edges_only() -> None:
    edges = np.array([[0, 0], [0, 1], [1, 1]])
    labels = torch.tensor([1.0, 1.0, 0.0])
    logits = torch.tensor([2.0, 1.0, -1.0], requires_grad=True)

    loss = pooled_cross_entropy(logits, edges, labels)
    loss.backward()

    probability = torch.sigmoid(logits.detach())
    expected = -(probability[0].log() + (1 - probability[2]).log()) / 2
    torch.testing.assert_close(loss.detach(), expected)
    assert logits.grad is not None
    assert logits.grad[1] == 0
    assert logits.grad[0] < 0 < logits.grad[2]
