# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest
from sensor_msgs.msg import Image

from gam_relocalizer.cameras import CameraCalibration
from gam_relocalizer.localization.localizer import LocalizerOptions
from gam_relocalizer.localization.prior import Prior
from gam_relocalizer.localization.result import LocalizationResult, Status
from gam_relocalizer.ros.attempt import Attempt
from gam_relocalizer.ros.schedule import StampedImage
from gam_relocalizer.ros.worker import Worker

if TYPE_CHECKING:
    from collections.abc import Iterator

LIMIT_S = 10.0
CALIBRATION = CameraCalibration(
    width=2, height=1, distortion_model='', d=(), k=(1, 0, 1, 0, 1, 1, 0, 0, 1), p=(0.0,) * 12
)


class GatedLocalizer:
    """Answers when it is let; its reason tells the options it had."""

    def __init__(
        self, gate: threading.Event, options: LocalizerOptions, map_id: str = 'abc'
    ) -> None:
        self.gate = gate
        self.options = options
        self.scene_map = SimpleNamespace(manifest=SimpleNamespace(map_id=map_id))

    def with_options(self, options: LocalizerOptions) -> GatedLocalizer:
        return GatedLocalizer(self.gate, options)

    def localize(self, image: Any, *_unused: object) -> LocalizationResult:  # noqa: ANN401
        assert self.gate.wait(LIMIT_S)
        if image.max() == 255:
            msg = 'a defect'
            raise ZeroDivisionError(msg)
        return LocalizationResult(Status.NO_POSE, f'{self.options.max_scenes} scenes')


def attempt(brightness: int = 0) -> Attempt:
    image = Image(height=1, width=2, encoding='mono8', step=2, data=bytes([brightness] * 2))
    return Attempt(
        StampedImage(image, 7), '/image', CALIBRATION, image_is_rectified=False, prior=Prior()
    )


class Bench:
    def __init__(self) -> None:
        self.gate = threading.Event()
        self.done = threading.Event()
        self.worker = Worker(GatedLocalizer(self.gate, LocalizerOptions()), self.done.set)
        self.results: list[LocalizationResult] = []

    def begin(self, brightness: int = 0) -> None:
        self.worker.begin(attempt(brightness), self.results.append)

    def let_finish(self) -> None:
        self.gate.set()
        assert self.done.wait(LIMIT_S)
        self.done.clear()
        self.gate.clear()


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    yield bench
    bench.gate.set()
    bench.worker.close()


def test_it_is_busy_until_its_result_is_handed_on(bench: Bench) -> None:
    assert not bench.worker.busy
    bench.begin()
    assert bench.worker.busy
    bench.worker.finish()
    assert bench.worker.busy
    bench.let_finish()
    assert bench.worker.busy
    assert not bench.results
    bench.worker.finish()
    assert [result.status for result in bench.results] == [Status.NO_POSE]
    assert not bench.worker.busy


def test_it_takes_no_second_attempt_while_busy(bench: Bench) -> None:
    bench.begin()
    with pytest.raises(RuntimeError):
        bench.begin()


def test_whoever_takes_a_result_may_begin_the_next_attempt(bench: Bench) -> None:
    bench.worker.begin(attempt(), lambda _result: bench.begin())
    for _ in range(2):
        bench.let_finish()
        bench.worker.finish()
    assert len(bench.results) == 1


def test_other_options_hold_from_the_next_attempt_on(bench: Bench) -> None:
    bench.begin()
    bench.worker.use(LocalizerOptions(max_scenes=9))
    bench.let_finish()
    bench.worker.finish()
    bench.begin()
    bench.let_finish()
    bench.worker.finish()
    default = f'{LocalizerOptions().max_scenes} scenes'
    assert [result.reason for result in bench.results] == [default, '9 scenes']


def test_another_model_serves_from_the_next_attempt_on(bench: Bench) -> None:
    bench.begin()
    bench.worker.replace(GatedLocalizer(bench.gate, LocalizerOptions(max_scenes=7), 'xyz'))
    assert bench.worker.map_id == 'xyz'
    bench.let_finish()
    bench.worker.finish()
    bench.begin()
    bench.let_finish()
    bench.worker.finish()
    default = f'{LocalizerOptions().max_scenes} scenes'
    assert [result.reason for result in bench.results] == [default, '7 scenes']


def test_a_defect_comes_out_where_the_result_is_handed_on(bench: Bench) -> None:
    bench.begin(brightness=255)
    bench.let_finish()
    with pytest.raises(ZeroDivisionError):
        bench.worker.finish()
    assert not bench.worker.busy


def test_closing_waits_for_the_attempt_under_way(bench: Bench) -> None:
    bench.begin()
    threading.Timer(0.1, bench.gate.set).start()
    bench.worker.close()
    bench.worker.finish()
    assert len(bench.results) == 1
