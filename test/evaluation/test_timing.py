# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What is timed is what the methods do; how long they take is nobody's promise."""

from __future__ import annotations

from dataclasses import astuple, replace
from typing import TYPE_CHECKING

import pytest

from gam_relocalizer.errors import UsageError
from gam_relocalizer.evaluation.metrics import THRESHOLDS
from gam_relocalizer.evaluation.query_set import read_query
from gam_relocalizer.evaluation.timing import (
    COMPARED_COUNT,
    DEFAULT_COUNTS,
    Averages,
    Components,
    Method,
    Run,
    SetTiming,
    Speedup,
    counts_of,
    machine_facts,
    mean_speedup,
    speedup_of,
    summarise,
    time_set,
)
from gam_relocalizer.features.registry import create_extractor, global_descriptor_of
from gam_relocalizer.geometry import PoseError, pose_error
from gam_relocalizer.localization.localizer import Localizer, LocalizerOptions
from gam_relocalizer.matching.registry import create_matcher

if TYPE_CHECKING:
    from conftest import Corner

COUNTS = (1, 3)


def parts_of(corner: Corner) -> tuple[object, ...]:
    """Extractor, global descriptor and matcher."""
    return (
        create_extractor('xfeat'),
        global_descriptor_of(corner.query_set.scene_map),
        create_matcher('gam', extractor='xfeat'),
    )


@pytest.fixture(scope='module')
def timing(corner: Corner) -> SetTiming:
    return time_set(corner.query_set, *parts_of(corner), COUNTS, corner.references)


def test_every_query_is_localized_by_both_methods_with_every_count(
    corner: Corner, timing: SetTiming
) -> None:
    assert timing.images == 5
    assert list(timing.runs) == [Method.SCENES, Method.IMAGES]
    for by_count in timing.runs.values():
        assert tuple(by_count) == COUNTS
        for runs in by_count.values():
            assert tuple(runs) == corner.query_set.names
            for run in runs.values():
                assert run.error.position < 0.05
                assert run.error.rotation_deg < 1.0


def test_the_localizer_runs_as_by_itself(corner: Corner, timing: SetTiming) -> None:
    query_set = corner.query_set
    extractor, describer, matcher = parts_of(corner)
    for count, runs in timing.runs[Method.SCENES].items():
        options = LocalizerOptions(retrieved_images=count)
        localizer = Localizer(query_set.scene_map, extractor, matcher, options, describer)
        for name, run in runs.items():
            result = localizer.localize(read_query(query_set, name), query_set.cameras[name])
            pose = query_set.world_from_map.transform_camera_world(result.estimate.camera_from_map)
            assert run.error == pose_error(pose, query_set.truth[name])
            assert run.accepted is result.accepted


def test_parts_fill_the_time_of_a_query(timing: SetTiming) -> None:
    for method, by_count in timing.runs.items():
        for runs in by_count.values():
            for run in runs.values():
                *parts, total = astuple(run.components)
                assert all(part >= 0.0 for part in parts)
                assert 0.0 < sum(parts) <= total * (1.0 + 1e-9)
                described = run.components.local_features + run.components.global_descriptor
                assert run.components.elapsed == pytest.approx(total - described)
                assert (run.components.verdict > 0.0) is (method is Method.SCENES)


def test_image_matching_has_no_verdict_and_takes_up_what_it_matched(timing: SetTiming) -> None:
    few, many = timing.runs[Method.IMAGES].values()
    for name, run in few.items():
        assert run.accepted is None
        assert run.components.matching < many[name].components.matching
        assert run.components.local_features == many[name].components.local_features


def test_without_images_only_the_localizer_is_timed(corner: Corner) -> None:
    told: list[tuple[str, int, int]] = []
    timing = time_set(
        corner.query_set, *parts_of(corner), (1,), progress=lambda *at: told.append(at)
    )
    assert list(timing.runs) == [Method.SCENES]
    assert told == [('localize', 1, 2), ('localize', 2, 2)]
    assert speedup_of(timing) is None


def test_queries_without_truth_are_a_usage_error(corner: Corner) -> None:
    with pytest.raises(UsageError, match='truth'):
        time_set(replace(corner.query_set, truth={}), *parts_of(corner), (1,))


def test_the_default_of_the_localizer_is_always_measured() -> None:
    assert LocalizerOptions().retrieved_images == COMPARED_COUNT
    assert counts_of((20, 1, 1)) == (1, COMPARED_COUNT, 20)
    assert counts_of(DEFAULT_COUNTS) == DEFAULT_COUNTS


def run_of(elapsed: float, position: float | None, *, accepted: bool | None) -> Run:
    """A query of 100 ms for its description and some for the rest."""
    error = None if position is None else PoseError(position, 10.0 * position)
    parts = 80.0, 20.0, 0.0, elapsed, 0.0, 0.0
    return Run(error, accepted, Components(*parts, total=sum(parts)))


def test_errors_and_times_are_summarised() -> None:
    score = summarise(
        [
            run_of(10.0, 0.01, accepted=True),
            run_of(20.0, 0.03, accepted=False),
            run_of(90.0, None, accepted=False),
        ]
    )
    assert (score.found.localized, score.found.queries, score.accepted) == (2, 3, 1)
    assert score.found.median_position == pytest.approx(0.02)
    assert score.found.recall[THRESHOLDS[0]] == pytest.approx(2 / 3)
    assert (score.elapsed.mean, score.elapsed.median) == pytest.approx((40.0, 20.0))
    assert (score.whole.mean, score.whole.median) == pytest.approx((140.0, 120.0))


def test_a_method_without_verdict_accepts_nothing_and_refuses_nothing() -> None:
    assert summarise([run_of(10.0, 0.01, accepted=None)]).accepted is None


def test_times_faster_is_the_ratio_of_the_times(timing: SetTiming) -> None:
    made_up = replace(
        timing,
        runs={
            Method.SCENES: {
                COMPARED_COUNT: {
                    name: run_of(elapsed, 0.01, accepted=True)
                    for name, elapsed in (('a', 10.0), ('b', 20.0), ('c', 60.0))
                }
            },
            Method.IMAGES: {
                COMPARED_COUNT: {
                    name: run_of(elapsed, 0.01, accepted=None)
                    for name, elapsed in (('a', 500.0), ('b', 800.0), ('c', 1700.0))
                }
            },
        },
    )
    speedup = speedup_of(made_up)
    assert speedup.to_pose == speedup.elapsed  # nobody has a verdict here
    assert speedup.elapsed.mean == pytest.approx(3000.0 / 90.0)
    assert speedup.elapsed.median == pytest.approx(40.0)
    assert speedup.whole.mean == pytest.approx(3300.0 / 390.0)
    assert speedup.whole.median == pytest.approx(900.0 / 120.0)


def test_ratios_are_averaged_so_that_twice_and_half_cancel() -> None:
    twice = Speedup(Averages(4.0, 9.0), Averages(2.0, 8.0), Averages(1.0, 3.0))
    half = Speedup(Averages(1.0, 4.0), Averages(0.5, 2.0), Averages(1.0, 3.0))
    mean = mean_speedup([twice, half])
    assert astuple(mean.to_pose) == pytest.approx((2.0, 6.0))
    assert astuple(mean.elapsed) == pytest.approx((1.0, 4.0))
    assert astuple(mean.whole) == pytest.approx((1.0, 3.0))
    assert astuple(mean_speedup([twice]).elapsed) == pytest.approx((2.0, 8.0))


def test_the_machine_has_a_name_and_cores() -> None:
    facts = machine_facts()
    assert all(facts.values())
    assert int(facts['cores']) >= 1
    assert 'torch' in facts['versions']
