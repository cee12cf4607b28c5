# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import signal
import threading
import time
from typing import TYPE_CHECKING, Any

import pytest
import typer
from typer.testing import CliRunner

from gam_relocalizer.cli.train import _Display, _progress, _run, _stopped_by_interrupt, train
from gam_relocalizer.errors import TrainingError, UsageError
from gam_relocalizer.matching.gamnet import GamNetConfig
from gam_relocalizer.matching.weights import SHIPPED, load_weights
from gam_relocalizer.training.loop import (
    CHECKPOINT_NAME,
    WEIGHTS_NAME,
    Trainer,
    TrainingOptions,
    read_log,
)
from gam_relocalizer.training.recipes import recipe

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tiny_place import TinyPlace

SMALL = TrainingOptions(
    steps=500,
    network=GamNetConfig(blocks=1, width=8),
    graphs_per_step=1,
    keypoints=(64, 64),
    points=(200, 300),
    validation_graphs=1,
)


def _app() -> typer.Typer:
    app = typer.Typer()
    app.command()(train)
    return app


@pytest.fixture
def app() -> typer.Typer:
    return _app()


def _of(place: TinyPlace) -> list[str]:
    recording = place.map_path.parent / 'mapping'
    return ['--map', str(place.map_path), '--images', str(recording / 'images')]


def _invoke(app: typer.Typer, out: Path, *arguments: str) -> Any:  # noqa: ANN401 - a result of typer, which does not name its type
    return CliRunner().invoke(app, ['--out', str(out), *arguments])


def test_resume_without_a_run_is_an_error(app: typer.Typer, tmp_path: Path) -> None:
    assert isinstance(_invoke(app, tmp_path, '--resume').exception, TrainingError)


def test_a_directory_with_a_run_is_not_overwritten(app: typer.Typer, tmp_path: Path) -> None:
    (tmp_path / CHECKPOINT_NAME).write_bytes(b'a run')

    result = _invoke(app, tmp_path, '--steps', '1')

    assert isinstance(result.exception, TrainingError)
    assert (tmp_path / CHECKPOINT_NAME).read_bytes() == b'a run'


@pytest.mark.parametrize(
    'arguments',
    [
        [],
        ['--out', 'run', '--steps', '0'],
        ['--out', 'run', '--seed', '-1'],
    ],
)
def test_arguments_out_of_range(app: typer.Typer, arguments: list[str]) -> None:
    assert CliRunner().invoke(app, arguments).exit_code == 2


@pytest.mark.parametrize(
    'arguments',
    [
        ['--matcher', 'nn-ratio'],
        ['--matcher', 'plainnet-hp'],
        ['--matcher', 'nonsense'],
        ['--map', 'map'],
        ['--images', 'images'],
        ['--map', 'map', '--map', 'other', '--images', 'images'],
    ],
)
def test_arguments_that_do_not_fit_together(
    app: typer.Typer, tmp_path: Path, arguments: list[str]
) -> None:
    result = _invoke(app, tmp_path / 'out', *arguments)

    assert isinstance(result.exception, UsageError)
    assert not (tmp_path / 'out').exists()


@pytest.fixture(scope='module')
def trained(tiny_place: TinyPlace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of a run from random weights."""
    out = tmp_path_factory.mktemp('trained')
    result = _invoke(_app(), out, *_of(tiny_place), '--from-scratch', '--steps', '3')
    assert result.exit_code == 0, result.output
    return out


def test_trains_on_a_map_from_random_weights(trained: Path) -> None:
    network, provenance = load_weights(trained / WEIGHTS_NAME)

    assert network.config == recipe('gam').network
    assert (provenance.steps, provenance.planned_steps) == (3, 3)
    assert provenance.extractors == ('xfeat',)
    assert [record['step'] for record in read_log(trained)] == [3]


@pytest.mark.parametrize('other', [[], ['--seed', '1'], ['--matcher', 'bmnet']])
def test_refuses_to_resume_another_run(app: typer.Typer, trained: Path, other: list[str]) -> None:
    before = (trained / CHECKPOINT_NAME).read_bytes()

    result = _invoke(app, trained, '--steps', '3', '--resume', *other)

    assert isinstance(result.exception, TrainingError)
    assert (trained / CHECKPOINT_NAME).read_bytes() == before


def test_fine_tunes_the_shipped_weights_on_a_map(
    app: typer.Typer, tiny_place: TinyPlace, tmp_path: Path
) -> None:
    result = _invoke(app, tmp_path, *_of(tiny_place), '--steps', '3')

    assert result.exit_code == 0, result.output
    network, provenance = load_weights(tmp_path / WEIGHTS_NAME)
    shipped, _ = load_weights(SHIPPED / 'gam.npz')
    assert network.config == shipped.config
    assert (provenance.steps, provenance.extractors) == (3, ('xfeat',))
    start, end = read_log(tmp_path)
    assert (start['step'], end['step']) == (0, 3)
    # the shipped weights know their trade, and three steps do not make them forget it
    assert start['average_precision'] > 0.5
    assert abs(end['average_precision'] - start['average_precision']) < 0.1
    assert f'{start["average_precision"]:.3f} at the start' in result.output


def test_an_interrupt_ends_the_run_after_a_step_that_can_be_resumed(tmp_path: Path) -> None:
    trainer = Trainer(SMALL, tmp_path)
    handler = signal.getsignal(signal.SIGINT)

    def interrupt() -> None:
        while trainer.step < 3:
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    with pytest.raises(KeyboardInterrupt), _progress() as progress:
        _run(trainer, SMALL.steps, progress)
    thread.join()

    assert signal.getsignal(signal.SIGINT) is handler
    assert 3 <= trainer.step < SMALL.steps
    resumed = Trainer(SMALL, tmp_path)
    resumed.resume()
    assert resumed.step == trainer.step


@pytest.fixture
def interrupts_raise() -> Iterator[None]:
    """As in a terminal; a process that a script put into the background ignores them."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures('interrupts_raise')
def test_a_second_interrupt_ends_the_run_at_once(tmp_path: Path) -> None:
    trainer = Trainer(SMALL, tmp_path)

    class Impatient(_Display):
        def on_step(self, step: int, loss: float) -> None:  # noqa: ARG002
            # two at once may be seen as one: the second comes when the first has been answered
            first = signal.getsignal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
            while signal.getsignal(signal.SIGINT) is first:
                time.sleep(0.001)
            signal.raise_signal(signal.SIGINT)
            time.sleep(10.0)  # ends as soon as the second one is seen

    with (
        pytest.raises(KeyboardInterrupt),
        _progress() as progress,
        _stopped_by_interrupt(trainer, progress),
    ):
        trainer.run(Impatient(progress, progress.add_task('train', loss='')))

    assert trainer.step == 1
    assert not (tmp_path / CHECKPOINT_NAME).exists()
