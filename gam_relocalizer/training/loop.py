# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The training run: loss, optimiser, checkpoints that resume, log, curves.

The loss is the paper's cross-entropy over the pooled edges. For the first tenth of the run it goes
over all edges instead: as long as the weights say nothing, the pooling picks at random and hides
two thirds of what could be learned.

A run is a function of its options and its maps. Batch number i comes from a generator seeded with
(seed, i), so that a resumed run sees the graphs that it would have seen; nothing else is random
after the start.
"""

from __future__ import annotations

import hashlib
import json
import math
import pickle
import signal
import time
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch.nn import functional
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torch.utils.data import DataLoader, Dataset

from gam_relocalizer.errors import TrainingError
from gam_relocalizer.matching.bmnet import BMNetConfig
from gam_relocalizer.matching.networks import create_network
from gam_relocalizer.matching.pooling import hungarian_pool
from gam_relocalizer.matching.weights import Provenance, load_weights, save_weights
from gam_relocalizer.training.batches import GraphBatch
from gam_relocalizer.training.labelled import CandidateRule
from gam_relocalizer.training.metrics import MatchMetrics, evaluate
from gam_relocalizer.training.sources import GraphSource

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path
    from typing import Protocol

    from numpy.typing import NDArray

    from gam_relocalizer.mapping.leave_one_out import ReferenceImages
    from gam_relocalizer.matching.graph import MatchingNetwork
    from gam_relocalizer.matching.networks import NetworkConfig
    from gam_relocalizer.training.labelled import LabelledGraph
    from gam_relocalizer.training.sources import MapUse

    class Observer(Protocol):
        """Told about the progress of a run."""

        def on_step(self, step: int, loss: float) -> None:
            """After every step."""

        def on_validation(self, step: int, metrics: MatchMetrics) -> None:
            """After every validation."""


CHECKPOINT_NAME = 'checkpoint.pt'
LOG_NAME = 'metrics.jsonl'
CURVES_NAME = 'curves.png'
WEIGHTS_NAME = 'weights.npz'

WARM_UP_STEPS = 100
WEIGHT_DECAY = 1e-2
VECTOR_LEARNING_RATE = 1e-3
MIN_MATRIX_SIDE = 32
AVERAGE_DECAY = 0.999
# Of a short run the average covers this share of its steps, or its start would never fade from it.
SHORT_AVERAGE_SHARE = 0.2


@dataclass(frozen=True)
class TrainingOptions:
    """What a run is a function of, besides its maps and the weights that it starts from.

    Attributes:
        steps: Steps of the optimiser.
        seed: Of the first weights and of the graphs.
        network: Name and size of the network.
        rule: How edges are found.
        pooled: Whether the loss goes over pooled edges (BMNet) or over all (PlainNet).
        plain_share: Share of the steps, at the start, whose loss goes over all edges anyway.
        graphs_per_step: Graphs whose gradients are averaged in a step.
        learning_rate: Greatest of the matrices, after the warm-up; it falls to zero as a cosine.
        keypoints: Least and greatest number of keypoints of a graph.
        points: Least and greatest number of points of a graph.
        map_share: Share of the batches that come from maps, when there are any.
        validate_every: Steps between validations.
        validation_graphs: Graphs to validate on, the same for every run.
    """

    steps: int = 9_600
    seed: int = 0
    network: NetworkConfig = field(default_factory=BMNetConfig)
    rule: CandidateRule = field(default_factory=CandidateRule)
    pooled: bool = True
    plain_share: float = 0.1
    graphs_per_step: int = 4
    learning_rate: float = 3e-3
    keypoints: tuple[int, int] = (96, 512)
    points: tuple[int, int] = (300, 4000)
    map_share: float = 0.6
    validate_every: int = 500
    validation_graphs: int = 48


def check_unused(directory: Path) -> None:
    """Check that a run may start in a directory.

    Raises:
        TrainingError: It holds a run already.
    """
    if (directory / CHECKPOINT_NAME).exists():
        raise TrainingError(
            f'{directory} already holds a run: continue it with --resume, or use another directory'
        )


class BatchStream(Dataset[GraphBatch]):
    """Batches number `first` and on, each a function of (seed, number)."""

    def __init__(self, options: TrainingOptions, source: GraphSource, first: int) -> None:
        self._options = options
        self._source = source
        self._first = first

    def __len__(self) -> int:
        return self._options.steps - self._first

    def __getitem__(self, index: int) -> GraphBatch:
        rng = np.random.default_rng([self._options.seed, self._first + index])
        return self._source.batch(rng, self._options.graphs_per_step)


def pooled_cross_entropy(
    logits: torch.Tensor, edges: NDArray[np.int64], labels: torch.Tensor
) -> torch.Tensor:
    """Cross-entropy over the edges that Hungarian pooling chooses (section 'Loss Function').

    Averaged over those, not over all edges: a graph counts as much however many edges conflict.
    """
    pooled = hungarian_pool(torch.sigmoid(logits), edges)
    chosen = pooled.detach() > 0
    return functional.binary_cross_entropy(pooled[chosen], labels[chosen])


class Trainer:
    """State of a run, in a directory of its own."""

    def __init__(
        self,
        options: TrainingOptions,
        directory: Path,
        maps: Sequence[ReferenceImages] = (),
        start: Path | None = None,
    ) -> None:
        """Start at step 0; `resume` continues from the checkpoint of the directory.

        Args:
            options: Of the run.
            directory: Receives checkpoint, log, curves and weights.
            maps: Real places to learn from, besides the synthetic ones.
            start: Weights to start from instead of random ones; their network has the size that the
                options ask for.

        Raises:
            TrainingError: The maps leave nothing to learn from, or `start` is of another network.
            WeightsError: `start` is missing or damaged.
        """
        self.options = options
        self.step = 0
        self._stops = False
        self._starts_from_weights = start is not None
        self._directory = directory
        self._checkpoint = directory / CHECKPOINT_NAME
        self._log = directory / LOG_NAME
        self._source = GraphSource(
            options.rule, options.keypoints, options.points, maps, options.map_share
        )
        torch.manual_seed(options.seed)
        self._net = create_network(options.network)
        if start is not None:
            self._start_from(start)
        self._record = _record(options, maps, start)
        self._average = AveragedModel(
            self._net,
            multi_avg_fn=get_ema_multi_avg_fn(  # type: ignore[no-untyped-call]
                _average_decay(options.steps)
            ),
        )
        self._optimisers = _create_optimisers(self._net, options)

    @property
    def map_uses(self) -> tuple[MapUse, ...]:
        """What becomes of the images of each map."""
        return self._source.map_uses

    def _start_from(self, weights: Path) -> None:
        network, _ = load_weights(weights)
        if network.config != self.options.network:
            raise TrainingError(
                f'the weights {weights} are of {network.config}, the run is of '
                f'{self.options.network}: start from weights of the same network'
            )
        self._net.load_state_dict(network.state_dict())

    def resume(self) -> None:
        """Continue where the last checkpoint was written.

        Raises:
            TrainingError: There is no usable checkpoint of a run with the same options.
        """
        try:
            state = torch.load(self._checkpoint, weights_only=True)
        except FileNotFoundError as error:
            raise TrainingError(
                f'no checkpoint to resume from at {self._checkpoint}: start without --resume'
            ) from error
        except (RuntimeError, EOFError, OSError, pickle.UnpicklingError) as error:
            raise TrainingError(
                f'the checkpoint {self._checkpoint} cannot be read: {error}; start afresh'
            ) from error
        if not isinstance(state, dict) or state.get('run') != self._record:
            found = state.get('run') if isinstance(state, dict) else None
            raise TrainingError(
                f'the checkpoint {self._checkpoint} is of another run: '
                f'{_differences(found, self._record)}; resume with the same options, maps and '
                'weights, or use another directory'
            )
        self._net.load_state_dict(state['net'])
        self._average.load_state_dict(state['average'])
        for optimiser, optimiser_state in zip(self._optimisers, state['optimisers'], strict=True):
            optimiser.load_state_dict(optimiser_state)
        self.step = int(state['step'])

    def run(self, observer: Observer, checkpoint_seconds: float = 180.0) -> MatchMetrics:
        """Train to the last step; leaves checkpoint, log, curves and weights in the directory.

        Raises:
            TrainingError: The directory holds another run, or the loss is no longer finite.
            KeyboardInterrupt: After `stop`, with a checkpoint of the last step.
        """
        with _one_thread():
            return self._run(observer, checkpoint_seconds)

    def _run(self, observer: Observer, checkpoint_seconds: float) -> MatchMetrics:
        self._claim_directory()
        validation = self._source.validation(self.options.validation_graphs)
        metrics, loss = None, None
        if self.step == 0 and self._starts_from_weights:
            self._validate(validation, loss, observer)
        saved_at = time.monotonic()
        for batch in self._batches():
            loss = self._optimise(batch)
            observer.on_step(self.step, loss)
            if self.step % self.options.validate_every == 0:
                metrics = self._validate(validation, loss, observer)
            if self._stops or time.monotonic() - saved_at > checkpoint_seconds:
                self._save_checkpoint()
                saved_at = time.monotonic()
            if self._stops:
                raise KeyboardInterrupt
        if metrics is None or self.step % self.options.validate_every:
            metrics = self._validate(validation, loss, observer)
        self._save_checkpoint()
        return metrics

    def stop(self) -> None:
        """Make `run` end after the step at work: for a signal handler.

        An exception in the middle of a step would leave a network that is half of the next one.
        """
        self._stops = True

    def _claim_directory(self) -> None:
        if self.step == 0:
            check_unused(self._directory)
        self._directory.mkdir(parents=True, exist_ok=True)

    def _batches(self) -> Iterator[GraphBatch]:
        stream = BatchStream(self.options, self._source, first=self.step)
        if not len(stream):
            return
        loader: DataLoader[GraphBatch] = DataLoader(
            stream,
            batch_size=None,
            collate_fn=_as_it_is,  # type: ignore[arg-type] # the hint forgets batch_size=None
            num_workers=1,
            prefetch_factor=16,
            worker_init_fn=_prepare_worker,
            # a fork shares the descriptors of the maps instead of copying them
            multiprocessing_context='fork',
        )
        yield from loader

    def _optimise(self, batch: GraphBatch) -> float:
        loss = self._loss(batch)
        if not math.isfinite(loss.item()):
            raise TrainingError(f'the loss is {loss} at step {self.step}: lower the learning rate')
        loss.backward()  # type: ignore[no-untyped-call]
        for optimiser in self._optimisers:
            for group in optimiser.param_groups:
                group['lr'] = group['initial_lr'] * self._schedule()
            optimiser.step()
            optimiser.zero_grad()
        self._average.update_parameters(self._net)
        self.step += 1
        return loss.item()

    def _loss(self, batch: GraphBatch) -> torch.Tensor:
        labels = torch.from_numpy(batch.labels).float()
        with torch.autocast('cpu', torch.bfloat16, enabled=_fast_bfloat16()):
            logits = self._net(batch.graphs())
        if not self.options.pooled or self.step < self.options.plain_share * self.options.steps:
            return functional.binary_cross_entropy_with_logits(logits, labels)
        graphs = range(labels.shape[1])
        return torch.stack(
            [pooled_cross_entropy(logits[:, i], batch.edges[:, i], labels[:, i]) for i in graphs]
        ).mean()

    def _schedule(self) -> float:
        warm_up = min(1.0, (self.step + 1) / WARM_UP_STEPS)
        fall = 0.5 * (1.0 + math.cos(math.pi * self.step / self.options.steps))
        return warm_up * fall

    def _validate(
        self, validation: list[LabelledGraph], loss: float | None, observer: Observer
    ) -> MatchMetrics:
        average: MatchingNetwork = self._average.module  # type: ignore[assignment]
        metrics = evaluate(average, validation)
        records = self._write_log({'step': self.step, 'loss': loss, **asdict(metrics)})
        _draw_curves(records, self._directory / CURVES_NAME)
        provenance = Provenance(
            steps=self.step,
            planned_steps=self.options.steps,
            seed=self.options.seed,
            extractors=self._source.extractors,
            average_precision=metrics.average_precision,
        )
        save_weights(self._directory / WEIGHTS_NAME, average, provenance)
        observer.on_validation(self.step, metrics)
        return metrics

    def _save_checkpoint(self) -> None:
        temporary = self._checkpoint.with_suffix('.tmp')
        torch.save(
            {
                'run': self._record,
                'step': self.step,
                'net': self._net.state_dict(),
                'average': self._average.state_dict(),
                'optimisers': [optimiser.state_dict() for optimiser in self._optimisers],
            },
            temporary,
        )
        temporary.replace(self._checkpoint)

    def _write_log(self, record: dict[str, Any]) -> list[dict[str, Any]]:
        """The log with a record at its end.

        A resumed run validates again where the killed one did so after its last checkpoint.
        """
        before = read_log(self._directory) if self._log.exists() else []
        records = [other for other in before if other['step'] < self.step] + [record]
        temporary = self._log.with_suffix('.tmp')
        temporary.write_text(''.join(json.dumps(one) + '\n' for one in records), 'utf-8')
        temporary.replace(self._log)
        return records


def _create_optimisers(
    net: MatchingNetwork, options: TrainingOptions
) -> list[torch.optim.Optimizer]:
    """Muon for the matrices between features, AdamW for all else.

    In the same number of steps Muon got further than AdamW alone, by more than its own time.
    """
    matrices = [p for p in net.parameters() if p.ndim == 2 and min(p.shape) >= MIN_MATRIX_SIDE]
    chosen = {id(matrix) for matrix in matrices}
    vectors = [p for p in net.parameters() if id(p) not in chosen]
    optimisers: list[torch.optim.Optimizer] = [
        torch.optim.AdamW(vectors, VECTOR_LEARNING_RATE, weight_decay=WEIGHT_DECAY, fused=True)
    ]
    if matrices:
        muon = torch.optim.Muon(
            matrices,
            options.learning_rate,
            weight_decay=WEIGHT_DECAY,
            adjust_lr_fn='match_rms_adamw',
        )
        optimisers.append(muon)
    for optimiser in optimisers:
        for group in optimiser.param_groups:
            group['initial_lr'] = group['lr']
    return optimisers


def _average_decay(steps: int) -> float:
    return min(AVERAGE_DECAY, max(0.0, 1.0 - 1.0 / (SHORT_AVERAGE_SHARE * steps)))


def _record(
    options: TrainingOptions, maps: Sequence[ReferenceImages], start: Path | None
) -> dict[str, Any]:
    """What makes two runs the same, as a checkpoint can hold and compare it."""
    record: dict[str, Any] = json.loads(json.dumps(asdict(options)))
    record['maps'] = [references.scene_map.manifest.map_id for references in maps]
    record['start'] = None if start is None else hashlib.sha256(start.read_bytes()).hexdigest()
    return record


def _differences(found: object, expected: dict[str, Any]) -> str:
    if not isinstance(found, dict):
        return 'it does not tell its options'
    names = sorted(found.keys() | expected.keys())
    return ', '.join(
        f'{name} is {found.get(name)}, expected {expected.get(name)}'
        for name in names
        if found.get(name) != expected.get(name)
    )


@contextmanager
def _one_thread() -> Iterator[None]:
    """Layers of small graphs gain nothing from a second thread, and lose where cores are busy.

    The other cores draw the graphs. What a run computes then does not depend on their number.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _as_it_is(batch: GraphBatch) -> GraphBatch:
    return batch


def _prepare_worker(_worker: int) -> None:
    """An interrupt of the terminal reaches all processes, but the trainer says when to stop."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)


def _fast_bfloat16() -> bool:
    """Elsewhere bfloat16 is emulated, and slower than float32."""
    return bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())  # noqa: SLF001 - no public way to ask


def read_log(directory: Path) -> list[dict[str, Any]]:
    """The validations of a run so far: step, loss, and the metrics by name."""
    lines = (directory / LOG_NAME).read_text('utf-8').splitlines()
    return [json.loads(line) for line in lines]


def _draw_curves(records: list[dict[str, Any]], path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4), layout='constrained')
    FigureCanvasAgg(figure)
    loss, metrics = figure.subplots(1, 2)
    steps = [record['step'] for record in records]
    loss.plot(steps, [record['loss'] or math.nan for record in records])
    loss.set(title='training loss', xlabel='step')
    for name in ('precision', 'recall', 'average_precision'):
        metrics.plot(steps, [record[name] for record in records], label=name.replace('_', ' '))
    metrics.set(title='validation', xlabel='step', ylim=(0, 1))
    metrics.legend()
    temporary = path.with_suffix('.tmp.png')
    figure.savefig(temporary)
    temporary.replace(path)
