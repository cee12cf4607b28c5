# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from gam_relocalizer.errors import TrainingError, WeightsError
from gam_relocalizer.matching.bmnet import BMNetConfig
from gam_relocalizer.matching.gamnet import GamNetConfig
from gam_relocalizer.matching.graph import CandidateGraphs, MatchingNetwork
from gam_relocalizer.matching.lgcnet import LgcNetConfig
from gam_relocalizer.matching.oanet import OaNetConfig
from gam_relocalizer.matching.weights import load_weights
from gam_relocalizer.training.loop import (
    CHECKPOINT_NAME,
    CURVES_NAME,
    LOG_NAME,
    WEIGHTS_NAME,
    Trainer,
    TrainingOptions,
    check_unused,
    pooled_cross_entropy,
    read_log,
)

if TYPE_CHECKING:
    from pathlib import Path

    from gam_relocalizer.mapping.leave_one_out import ReferenceImages
    from gam_relocalizer.matching.networks import NetworkConfig
    from gam_relocalizer.training.metrics import MatchMetrics

NETWORK = BMNetConfig(point_blocks=3, edge_blocks=2, point_width=16)
OPTIONS = TrainingOptions(
    steps=6,
    seed=5,
    network=NETWORK,
    graphs_per_step=2,
    keypoints=(64, 64),
    points=(200, 300),
    validate_every=3,
    validation_graphs=2,
)


FINE_TUNING = replace(OPTIONS, seed=9, plain_share=0.0, map_share=0.9, learning_rate=1e-3)


class KilledError(Exception):
    pass


class Recorder:
    """Keeps losses and validations, and kills or stops the run after a step if told so."""

    def __init__(self, kill_after: int | None = None) -> None:
        self.losses: dict[int, float] = {}
        self.validations: list[int] = []
        self._kill_after = kill_after

    def on_step(self, step: int, loss: float) -> None:
        self.losses[step] = loss
        if step == self._kill_after:
            raise KilledError

    def on_validation(self, step: int, metrics: MatchMetrics) -> None:
        assert 0 <= metrics.average_precision <= 1
        self.validations.append(step)


class Stopper(Recorder):
    """Asks for the end of the run after a step."""

    def __init__(self, trainer: Trainer, after: int) -> None:
        super().__init__()
        self._trainer = trainer
        self._after = after

    def on_step(self, step: int, loss: float) -> None:
        super().on_step(step, loss)
        if step == self._after:
            self._trainer.stop()


@pytest.fixture(scope='module')
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[int, float]]:
    directory = tmp_path_factory.mktemp('run') / 'out'
    recorder = Recorder()
    Trainer(OPTIONS, directory).run(recorder)
    return directory, recorder.losses


def _arrays(path: Path) -> dict[str, np.ndarray]:
    net, _ = load_weights(path)
    return {name: value.numpy() for name, value in net.state_dict().items()}


def _assert_same_weights(first: Path, second: Path) -> None:
    expected = _arrays(second / WEIGHTS_NAME)
    for name, value in _arrays(first / WEIGHTS_NAME).items():
        np.testing.assert_array_equal(value, expected[name])


def _steps(directory: Path) -> list[int]:
    return [record['step'] for record in read_log(directory)]


def test_a_run_leaves_checkpoint_log_curves_and_weights(
    finished: tuple[Path, dict[int, float]],
) -> None:
    directory, losses = finished

    assert sorted(p.name for p in directory.iterdir()) == sorted(
        [CHECKPOINT_NAME, LOG_NAME, CURVES_NAME, WEIGHTS_NAME]
    )
    assert _steps(directory) == [3, 6]
    assert [record['loss'] for record in read_log(directory)] == [losses[3], losses[6]]
    assert list(losses) == [1, 2, 3, 4, 5, 6]
    net, provenance = load_weights(directory / WEIGHTS_NAME)
    assert net.config == OPTIONS.network
    assert (provenance.steps, provenance.planned_steps, provenance.seed) == (6, 6, 5)
    assert provenance.extractors == ()
    assert provenance.average_precision == read_log(directory)[-1]['average_precision']


def test_the_number_of_threads_does_not_matter_and_stays(
    finished: tuple[Path, dict[int, float]], tmp_path: Path
) -> None:
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    recorder = Recorder()

    Trainer(OPTIONS, tmp_path / 'two').run(recorder)

    assert torch.get_num_threads() == 2
    torch.set_num_threads(threads)
    assert recorder.losses == finished[1]


def test_same_seed_same_weights(finished: tuple[Path, dict[int, float]], tmp_path: Path) -> None:
    recorder = Recorder()

    Trainer(OPTIONS, tmp_path / 'again').run(recorder)

    assert recorder.losses == finished[1]
    _assert_same_weights(tmp_path / 'again', finished[0])


def test_another_seed_other_losses(finished: tuple[Path, dict[int, float]], tmp_path: Path) -> None:
    recorder = Recorder()

    Trainer(replace(OPTIONS, seed=6), tmp_path / 'out').run(recorder)

    assert not set(recorder.losses.values()) & set(finished[1].values())


def test_a_resumed_run_ends_as_an_uninterrupted_one(
    finished: tuple[Path, dict[int, float]], tmp_path: Path
) -> None:
    directory = tmp_path / 'out'
    with pytest.raises(KilledError):
        Trainer(OPTIONS, directory).run(Recorder(kill_after=5), checkpoint_seconds=0)

    trainer = Trainer(OPTIONS, directory)
    trainer.resume()
    assert 0 < trainer.step < 5
    recorder = Recorder()
    trainer.run(recorder)

    for step, loss in recorder.losses.items():
        assert loss == finished[1][step]
    _assert_same_weights(directory, finished[0])
    assert _steps(directory) == [3, 6]


def test_a_stopped_run_keeps_its_last_step_and_ends_as_an_uninterrupted_one(
    finished: tuple[Path, dict[int, float]], tmp_path: Path
) -> None:
    directory = tmp_path / 'out'
    trainer = Trainer(OPTIONS, directory)
    with pytest.raises(KeyboardInterrupt):
        trainer.run(Stopper(trainer, after=2))

    resumed = Trainer(OPTIONS, directory)
    resumed.resume()
    assert resumed.step == 2
    resumed.run(Recorder())

    _assert_same_weights(directory, finished[0])


def test_a_validation_after_the_last_checkpoint_is_not_logged_twice(
    finished: tuple[Path, dict[int, float]], tmp_path: Path
) -> None:
    directory = tmp_path / 'out'
    trainer = Trainer(OPTIONS, directory)
    with pytest.raises(KeyboardInterrupt):
        trainer.run(Stopper(trainer, after=2))
    checkpoint = (directory / CHECKPOINT_NAME).read_bytes()
    resumed = Trainer(OPTIONS, directory)
    resumed.resume()
    with pytest.raises(KilledError):
        resumed.run(Recorder(kill_after=4))
    assert _steps(directory) == [3]
    assert (directory / CHECKPOINT_NAME).read_bytes() == checkpoint

    again = Trainer(OPTIONS, directory)
    again.resume()
    again.run(Recorder())

    assert read_log(directory) == read_log(finished[0])


def test_a_finished_run_that_is_resumed_stays_what_it_is(
    finished: tuple[Path, dict[int, float]],
) -> None:
    before = read_log(finished[0])
    trainer = Trainer(OPTIONS, finished[0])
    trainer.resume()
    recorder = Recorder()

    metrics = trainer.run(recorder)

    assert recorder.losses == {}
    assert metrics.average_precision == before[-1]['average_precision']
    assert [record['step'] for record in read_log(finished[0])] == [3, 6]


@pytest.mark.parametrize(
    'network',
    [
        GamNetConfig(blocks=2, width=32),
        LgcNetConfig(blocks=2, width=32),
        OaNetConfig(blocks=2, width=32, clusters=8),
    ],
)
def test_every_network_trains(network: NetworkConfig, tmp_path: Path) -> None:
    options = replace(OPTIONS, network=network, steps=3)
    torch.manual_seed(options.seed)
    recorder = Recorder()

    Trainer(options, tmp_path).run(recorder)

    assert all(np.isfinite(loss) for loss in recorder.losses.values())
    assert load_weights(tmp_path / WEIGHTS_NAME)[0].config == network


@pytest.mark.parametrize('pooled', [True, False])
def test_training_lowers_the_loss_and_betters_the_weights(
    references: ReferenceImages, tmp_path: Path, *, pooled: bool
) -> None:
    recorder = Recorder()
    options = replace(
        OPTIONS,
        network=GamNetConfig(blocks=2, width=32),
        steps=100,
        pooled=pooled,
        points=(200, 210),
        map_share=1.0,
        validate_every=20,
        validation_graphs=3,
    )

    Trainer(options, tmp_path, [references]).run(recorder)

    first = [recorder.losses[step] for step in range(12, 32)]
    last = [recorder.losses[step] for step in range(81, 101)]
    assert np.mean(last) < 0.9 * np.mean(first)
    log = read_log(tmp_path)
    assert log[-1]['average_precision'] > 1.5 * log[0]['average_precision']


def test_refuses_a_directory_that_holds_a_run(
    finished: tuple[Path, dict[int, float]],
) -> None:
    with pytest.raises(TrainingError):
        Trainer(OPTIONS, finished[0]).run(Recorder())


def test_an_empty_directory_is_unused(
    finished: tuple[Path, dict[int, float]], tmp_path: Path
) -> None:
    check_unused(tmp_path)
    check_unused(tmp_path / 'absent')
    with pytest.raises(TrainingError):
        check_unused(finished[0])


def test_refuses_to_resume_nothing(tmp_path: Path) -> None:
    with pytest.raises(TrainingError):
        Trainer(OPTIONS, tmp_path).resume()


def test_refuses_to_resume_a_run_with_other_options(
    finished: tuple[Path, dict[int, float]],
) -> None:
    with pytest.raises(TrainingError):
        Trainer(replace(OPTIONS, seed=6), finished[0]).resume()


def test_refuses_to_resume_a_run_with_other_maps(
    references: ReferenceImages, other_references: ReferenceImages, tmp_path: Path
) -> None:
    trainer = Trainer(OPTIONS, tmp_path, [references])
    with pytest.raises(KeyboardInterrupt):
        trainer.run(Stopper(trainer, after=1))

    for maps in ([], [other_references], [references, other_references]):
        with pytest.raises(TrainingError):
            Trainer(OPTIONS, tmp_path, maps).resume()
    Trainer(OPTIONS, tmp_path, [references]).resume()


def test_refuses_to_resume_a_run_that_started_from_other_weights(
    finished: tuple[Path, dict[int, float]], references: ReferenceImages, tmp_path: Path
) -> None:
    start = finished[0] / WEIGHTS_NAME
    trainer = Trainer(FINE_TUNING, tmp_path / 'out', [references], start)
    with pytest.raises(KeyboardInterrupt):
        trainer.run(Stopper(trainer, after=1))
    other = tmp_path / 'other'
    Trainer(replace(OPTIONS, steps=1), other).run(Recorder())

    for weights in (None, other / WEIGHTS_NAME):
        with pytest.raises(TrainingError):
            Trainer(FINE_TUNING, tmp_path / 'out', [references], weights).resume()
    Trainer(FINE_TUNING, tmp_path / 'out', [references], start).resume()


def test_fine_tuning_starts_from_the_weights_and_says_how_good_they_were(
    finished: tuple[Path, dict[int, float]], references: ReferenceImages, tmp_path: Path
) -> None:
    start = finished[0] / WEIGHTS_NAME
    trainer = Trainer(FINE_TUNING, tmp_path, [references], start)
    recorder = Recorder()

    trainer.run(recorder)

    assert recorder.validations == _steps(tmp_path) == [0, 3, 6]
    assert read_log(tmp_path)[0]['loss'] is None
    net, provenance = load_weights(tmp_path / WEIGHTS_NAME)
    assert net.config == OPTIONS.network
    assert provenance.extractors == ('synthetic',)
    assert provenance.steps == 6
    moved = [
        np.abs(value - expected).max()
        for value, expected in zip(
            _arrays(tmp_path / WEIGHTS_NAME).values(), _arrays(start).values(), strict=True
        )
    ]
    assert 0 < max(moved) < 0.02


def test_a_resumed_fine_tuning_ends_as_an_uninterrupted_one(
    finished: tuple[Path, dict[int, float]], references: ReferenceImages, tmp_path: Path
) -> None:
    start = finished[0] / WEIGHTS_NAME
    whole, parts = tmp_path / 'whole', tmp_path / 'parts'
    Trainer(FINE_TUNING, whole, [references], start).run(Recorder())
    trainer = Trainer(FINE_TUNING, parts, [references], start)
    with pytest.raises(KeyboardInterrupt):
        trainer.run(Stopper(trainer, after=4))

    resumed = Trainer(FINE_TUNING, parts, [references], start)
    resumed.resume()
    resumed.run(Recorder())

    _assert_same_weights(parts, whole)
    assert read_log(parts) == read_log(whole)


def test_refuses_to_start_from_weights_of_another_network(
    finished: tuple[Path, dict[int, float]], tmp_path: Path
) -> None:
    start = finished[0] / WEIGHTS_NAME
    for network in (GamNetConfig(2, 16), replace(NETWORK, edge_blocks=3)):
        with pytest.raises(TrainingError):
            Trainer(replace(FINE_TUNING, network=network), tmp_path, start=start)


def test_refuses_to_start_from_weights_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(WeightsError):
        Trainer(FINE_TUNING, tmp_path, start=tmp_path / 'absent.npz')


def test_refuses_maps_that_hold_nothing(lonely_references: ReferenceImages, tmp_path: Path) -> None:
    with pytest.raises(TrainingError):
        Trainer(OPTIONS, tmp_path, [lonely_references])


class Broken(MatchingNetwork):
    """Answers with numbers that are none."""

    def forward(self, graphs: CandidateGraphs) -> torch.Tensor:
        return torch.full(graphs.edges.shape[:2], torch.nan, requires_grad=True)


def test_a_loss_that_is_no_number_ends_the_run(tmp_path: Path) -> None:
    trainer = Trainer(replace(OPTIONS, pooled=False), tmp_path)
    trainer._net = Broken()

    with pytest.raises(TrainingError):
        trainer.run(Recorder())
    assert not (tmp_path / CHECKPOINT_NAME).exists()


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


@pytest.mark.parametrize('record', [None, 'old', {'steps': 6}])
def test_refuses_a_checkpoint_of_another_release(tmp_path: Path, record: object) -> None:
    torch.save({'run': record, 'step': 3}, tmp_path / CHECKPOINT_NAME)

    with pytest.raises(TrainingError):
        Trainer(OPTIONS, tmp_path).resume()


def test_refuses_a_checkpoint_that_would_run_code(tmp_path: Path) -> None:
    torch.save(Recorder(), tmp_path / CHECKPOINT_NAME)

    with pytest.raises(TrainingError):
        Trainer(OPTIONS, tmp_path).resume()


def test_loss_counts_pooled_edges_only() -> None:
    edges = np.array([[0, 0], [0, 1], [1, 1]])
    labels = torch.tensor([1.0, 1.0, 0.0])
    logits = torch.tensor([2.0, 1.0, -1.0], requires_grad=True)

    loss = pooled_cross_entropy(logits, edges, labels)
    loss.backward()  # type: ignore[no-untyped-call]

    probability = torch.sigmoid(logits.detach())
    expected = -(probability[0].log() + (1 - probability[2]).log()) / 2
    torch.testing.assert_close(loss.detach(), expected)
    assert logits.grad is not None
    assert logits.grad[1] == 0
    assert logits.grad[0] < 0 < logits.grad[2]
