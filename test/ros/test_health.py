# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import gc
import re
import weakref
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gam_relocalizer.localization.result import LocalizationResult, Status, Timings
from gam_relocalizer.ros.conditions import Condition, Diagnosis, Level, Part, diagnose
from gam_relocalizer.ros.health import RECENT, SECOND, Health, State
from gam_relocalizer.scene_map import (
    ExtractorIdentity,
    Manifest,
    MapContent,
    MapFrame,
    SceneMap,
    map_in_memory,
)

if TYPE_CHECKING:
    from collections.abc import Callable

REPOSITORY = Path(__file__).parents[2]
PERIOD_S = 2.0
FIX = LocalizationResult(Status.ACCEPTED, timings=Timings(40.0, 10.0, 200.0, 30.0, 20.0))
WALL = LocalizationResult(Status.TOO_FEW_FEATURES, '3 keypoints', timings=Timings(40.0))
NO_MOUNT = LocalizationResult(
    Status.NO_TRANSFORM, 'no transform to `camera`', timings=Timings(40.0)
)


def scene_map(*, metric: bool = True) -> SceneMap:
    manifest = Manifest(
        ExtractorIdentity('xfeat', 64, ''), 'vlad', MapFrame(metric=metric), {'images': 2}
    )
    content = MapContent(
        image_names=('a.png', 'b.png'),
        camera_from_sfm=(),
        points=np.zeros((7, 3)),
        descriptors=np.zeros((7, 64)),
        observation_offsets=np.zeros(3, np.int64),
        observation_points=np.zeros(0, np.int32),
        global_descriptors=np.zeros((2, 3), np.float32),
        codebook=np.zeros((1, 3), np.float32),
    )
    return map_in_memory(Path('/maps/hall'), content, manifest)


class Simulated:
    """A robot's life as its node counts it, by clocks that the test sets."""

    def __init__(self) -> None:
        self.steady_ns = 5 * SECOND
        self.clock_ns = 1_700_000_000 * SECOND
        self.publishers = 1
        self.health = Health(lambda: self.steady_ns)

    def activate(self, *, period_s: float = PERIOD_S, broadcasts: bool = False) -> None:
        self.health.map_loaded(scene_map(), 'cpu, 2 threads')
        self.health.activated('/camera/image', period_s, broadcasts=broadcasts)

    def wait(self, seconds: float, *, clock_runs: bool = True) -> None:
        """Time passes, and each second there is a report."""
        end_ns = self.steady_ns + round(seconds * SECOND)
        while self.steady_ns < end_ns:
            step_ns = min(SECOND, end_ns - self.steady_ns)
            self.steady_ns += step_ns
            self.clock_ns += step_ns if clock_runs else 0
            self.health.observe(self.clock_ns, self.publishers)

    def drive(
        self, seconds: float, result: LocalizationResult | None = FIX, *, delay_s: float = 0.05
    ) -> None:
        """Images come at 10 Hz, and each period gives the same result."""
        for tick in range(round(seconds * 10)):
            self.wait(0.1)
            self.health.image_came(round(delay_s * SECOND))
            if result is not None and tick % round(self.health.period_s * 10) == 0:
                self.health.period_over(busy=False)
                self.health.attempt_finished(result)

    def report(self, part: str) -> Diagnosis:
        return next(one for one in diagnose(self.health) if one.part.value == part)

    def value(self, part: str, key: str) -> str:
        return next(value.text for value in self.report(part).values if value.key == key)

    def found(self) -> set[Condition]:
        """The conditions that are reported, wherever."""
        names = {
            word
            for one in diagnose(self.health)
            for word in re.findall('[A-Z_]+(?=: )', one.message)
        }
        return {Condition[name] for name in names if name in Condition.__members__}


@pytest.fixture
def robot() -> Simulated:
    robot = Simulated()
    robot.activate()
    return robot


def test_a_robot_that_drives_normally_is_all_ok(robot: Simulated) -> None:
    assert robot.found() == set()
    for _ in range(60):
        robot.drive(PERIOD_S)
        assert [one.level for one in diagnose(robot.health)] == [Level.OK] * 7
    assert robot.value('localization', 'acceptance') == '1.00'
    assert float(robot.value('localization', 'last_fix_age_s')) <= PERIOD_S
    assert float(robot.value('input', 'image_rate_hz')) == pytest.approx(10.0, rel=0.1)
    assert robot.value('input', 'image_delay_s') == '0.050'
    assert robot.value('latency', 'period_s') == '2'
    assert robot.value('localization', 'attempts') == '60'
    assert robot.value('localization', 'fixes') == '60'
    assert robot.value('input', 'images') == '1200'
    assert robot.value('input', 'images_not_tried') == str(20 * 60 - 60)


def test_a_node_that_has_just_been_activated_has_time(robot: Simulated) -> None:
    counts = {
        'input': ('images', 'images_not_tried', 'unusable_in_a_row', 'time_jumps'),
        'localization': ('attempts', 'fixes', 'refusals_in_a_row'),
        'latency': ('periods_missed',),
        'odometry': ('fixes_without_in_a_row',),
    }
    assert {robot.value(part, key) for part, keys in counts.items() for key in keys} == {'0'}
    robot.wait(5.0)
    assert robot.found() == set()
    robot.drive(5.0, result=None)
    assert robot.found() == set()


def test_a_white_wall_for_a_moment_is_nothing(robot: Simulated) -> None:
    robot.drive(60.0)
    robot.drive(4.0, WALL)
    assert robot.found() == set()
    robot.drive(2.0)
    assert robot.found() == set()


def test_a_wall_that_stays_is_a_warning_with_its_reason_and_then_an_error(
    robot: Simulated,
) -> None:
    robot.drive(60.0)
    robot.drive(14.0, WALL)
    report = robot.report('localization')
    assert report.level is Level.WARN
    assert '7 refusals in a row, lately mostly' in report.message
    robot.drive(46.0, WALL)
    report = robot.report('localization')
    assert report.level is Level.ERROR
    assert 'TOO_FEW_FEATURES' in report.message
    assert robot.value('localization', 'last_reason') == '3 keypoints'
    assert robot.value('localization', 'refusals_in_a_row') == '30'
    robot.drive(2.0)
    assert robot.value('localization', 'refusals_in_a_row') == '0'
    assert robot.report('localization').level is not Level.ERROR


def test_few_fixes_are_a_warning_even_when_the_last_one_is_fresh(robot: Simulated) -> None:
    for _ in range(RECENT):
        robot.drive(8.0, WALL)
        robot.drive(2.0, FIX)
    report = robot.report('localization')
    assert robot.found() == {Condition.LOW_ACCEPTANCE}
    assert robot.value('localization', 'acceptance') == '0.20'
    assert 'TOO_FEW_FEATURES' in report.message


def test_longer_periods_bring_longer_patience() -> None:
    robot = Simulated()
    robot.activate(period_s=30.0)
    robot.drive(90.0, WALL)
    assert robot.found() == set()
    robot.wait(89.0)
    assert Condition.NO_IMAGES not in robot.found()
    robot.wait(2.0)
    assert Condition.NO_IMAGES in robot.found()


@pytest.mark.parametrize('publishers', [0, 2])
def test_a_camera_that_falls_silent_is_an_error_with_its_topic(
    robot: Simulated, publishers: int
) -> None:
    robot.drive(20.0)
    robot.publishers = publishers
    robot.wait(4.0)
    assert robot.found() == set()
    robot.wait(4.0)
    report = robot.report('input')
    assert report.level is Level.ERROR
    assert '/camera/image' in report.message
    assert f'{publishers} publishers' in report.message
    assert robot.value('input', 'image_publishers') == str(publishers)
    assert float(robot.value('input', 'image_rate_hz')) < 3.0
    robot.drive(1.0)
    assert robot.report('input').level is Level.OK


def test_a_camera_that_never_speaks_is_an_error(robot: Simulated) -> None:
    robot.wait(7.0)
    assert robot.found() == {Condition.NO_IMAGES}


def test_attempts_that_cannot_be_made_are_an_error_of_the_input(robot: Simulated) -> None:
    robot.drive(20.0)
    robot.drive(4.0, NO_MOUNT)
    assert robot.found() == set()
    robot.drive(4.0, NO_MOUNT)
    report = robot.report('input')
    assert report.level is Level.ERROR
    assert 'NO_TRANSFORM: no transform to `camera`' in report.message
    assert robot.value('input', 'unusable_in_a_row') == '4'
    robot.drive(2.0, WALL)  # one that could be made, though it gave nothing
    assert Condition.IMAGES_UNUSABLE not in robot.found()


def test_a_quick_burst_of_failures_is_no_error_yet() -> None:
    robot = Simulated()
    robot.activate(period_s=0.1)
    robot.drive(0.5, NO_MOUNT)
    assert robot.found() == set()
    robot.drive(2.0, NO_MOUNT)
    assert robot.found() == {Condition.SOME_IMAGES_UNUSABLE}
    robot.drive(3.0, NO_MOUNT)
    assert robot.found() == {Condition.IMAGES_UNUSABLE}


def test_a_camera_that_fails_now_and_then_is_a_warning(robot: Simulated) -> None:
    for _ in range(10):
        robot.drive(2.0, LocalizationResult(Status.UNDECODABLE_IMAGE, 'truncated'))
        robot.drive(4.0)
    assert robot.found() == {Condition.SOME_IMAGES_UNUSABLE}
    assert 'UNDECODABLE_IMAGE' in robot.report('input').message


@pytest.mark.parametrize(('delay_s', 'side'), [(30.0, 'behind'), (-30.0, 'ahead of')])
def test_stamps_far_from_the_clock_are_a_warning(
    robot: Simulated, delay_s: float, side: str
) -> None:
    robot.drive(4.0, delay_s=delay_s)
    assert robot.found() == {Condition.STAMPS_OFF}
    assert f'30.0 s {side}' in robot.report('input').message
    robot.drive(4.0)
    assert robot.found() == set()


@pytest.mark.parametrize(('delay_s', 'found'), [(0.9, set()), (1.1, {Condition.STAMPS_OFF})])
def test_stamps_may_be_off_by_a_second(
    robot: Simulated, delay_s: float, found: set[Condition]
) -> None:
    robot.drive(0.2, delay_s=delay_s)
    assert robot.found() == set()  # one image or two may have been held up
    robot.drive(0.1, delay_s=delay_s)
    assert robot.found() == found


def test_one_image_that_was_held_up_is_nothing(robot: Simulated) -> None:
    robot.drive(1.0)
    robot.drive(0.1, delay_s=100.0)
    assert robot.found() == set()


def test_time_that_jumps_back_again_and_again_is_a_warning(robot: Simulated) -> None:
    for _ in range(3):
        robot.drive(30.0)
        robot.health.time_jumped()
    assert robot.found() == set()
    robot.drive(6.0)
    robot.health.time_jumped()
    robot.health.time_jumped()
    assert robot.found() == {Condition.TIME_JUMPS}
    assert robot.value('input', 'time_jumps') == '5'
    robot.drive(61.0)
    assert robot.found() == set()


def test_nothing_is_late_in_a_paused_bag(robot: Simulated) -> None:
    robot.drive(20.0)
    age_s = robot.value('localization', 'last_fix_age_s')
    robot.wait(3600.0, clock_runs=False)
    assert robot.found() == {Condition.CLOCK_STANDS}
    assert robot.report('input').level is Level.WARN
    assert robot.value('localization', 'last_fix_age_s') == age_s
    robot.wait(1.0)
    assert robot.found() == set()


def test_a_clock_that_never_began_is_an_error() -> None:
    robot = Simulated()
    robot.clock_ns = 0
    robot.activate()
    robot.wait(4.0, clock_runs=False)
    assert robot.found() == {Condition.NO_CLOCK}
    assert robot.report('input').level is Level.ERROR


def test_a_correction_of_the_systems_clock_makes_nothing_late(robot: Simulated) -> None:
    robot.drive(20.0)
    robot.clock_ns += 10**9 * SECOND
    robot.drive(2.0)
    robot.clock_ns -= 2 * 10**9 * SECOND
    robot.drive(2.0)
    assert robot.found() == set()


def test_attempts_longer_than_the_period_are_a_warning(robot: Simulated) -> None:
    slow = LocalizationResult(Status.ACCEPTED, timings=Timings(500.0, 100.0, 1400.0, 200.0, 100.0))
    robot.drive(40.0)
    robot.drive(4.0, slow)  # one in between says nothing
    robot.health.period_over(busy=True)
    assert robot.found() == set()
    assert robot.value('latency', 'longest_ms') == '2300.0'
    assert robot.value('latency', 'total_ms') == '300.0'
    robot.drive(40.0, slow)
    assert robot.found() == {Condition.TOO_SLOW}
    assert robot.value('latency', 'extraction_ms') == '500.0'
    assert robot.value('latency', 'verdict_ms') == '100.0'
    assert robot.value('latency', 'periods_missed') == '1'
    robot.health.period_s = 5.0
    assert robot.found() == set()


def test_the_first_attempts_may_take_long(robot: Simulated) -> None:
    cold = LocalizationResult(Status.ACCEPTED, timings=Timings(extraction=2001.0))
    robot.drive(4.0, cold)
    assert robot.found() == set()
    robot.drive(2.0, cold)
    assert robot.found() == {Condition.TOO_SLOW}


def test_states_that_localize_nothing_are_warnings() -> None:
    robot = Simulated()
    assert robot.found() == {Condition.UNCONFIGURED}
    robot.health.map_loaded(scene_map(), 'cpu')
    assert robot.found() == {Condition.INACTIVE}
    robot.health.activated('/image', PERIOD_S, broadcasts=False)
    assert robot.found() == set()
    robot.health.set_enabled(enabled=False)
    assert robot.found() == {Condition.DISABLED}
    robot.health.deactivated()
    assert robot.found() == {Condition.INACTIVE}
    robot.health.unloaded()
    assert robot.found() == {Condition.UNCONFIGURED}
    assert robot.health.state is State.UNCONFIGURED
    robot.activate()
    robot.health.shut_down()
    assert robot.found() == {Condition.FINALIZED}


def test_a_map_that_cannot_be_loaded_is_an_error_until_one_is(robot: Simulated) -> None:
    robot.health.unloaded()
    robot.health.failed('map /maps/hall: points.npy is damaged')
    report = robot.report('state')
    assert report.level is Level.ERROR
    assert 'points.npy' in report.message
    assert robot.value('map', 'map_id') == ''
    robot.activate()
    assert robot.found() == set()


def test_another_map_that_cannot_be_loaded_is_a_warning_until_one_is(robot: Simulated) -> None:
    robot.health.map_refused('/maps/cellar: no such directory')
    assert robot.found() == {Condition.MAP_REFUSED}
    assert '/maps/cellar' in robot.report('map').message
    assert robot.value('map', 'path') == '/maps/hall'
    robot.health.map_loaded(scene_map(), 'cpu')
    assert robot.found() == set()


def test_a_map_that_is_not_metric_is_a_warning(robot: Simulated) -> None:
    robot.health.map_loaded(scene_map(metric=False), 'cpu')
    assert robot.found() == {Condition.MAP_NOT_METRIC}
    assert (robot.value('map', 'images'), robot.value('map', 'points')) == ('2', '7')


def test_a_map_is_not_kept_in_memory(robot: Simulated) -> None:
    large = scene_map()
    robot.health.map_loaded(large, 'cpu')
    reference = weakref.ref(large)
    del large
    gc.collect()
    assert reference() is None


def test_a_node_that_was_disabled_is_not_blamed_for_the_time_without_fixes(
    robot: Simulated,
) -> None:
    robot.drive(10.0)
    robot.health.set_enabled(enabled=False)
    robot.drive(100.0, result=None)
    assert robot.found() == {Condition.DISABLED}
    robot.health.set_enabled(enabled=True)
    assert robot.found() == set()
    robot.drive(11.0, result=None)
    assert robot.found() == {Condition.FIX_OVERDUE}
    assert 'no attempt was made' in robot.report('localization').message


def test_each_activation_counts_anew(robot: Simulated) -> None:
    robot.drive(100.0, WALL)
    robot.health.deactivated()
    robot.wait(100.0)
    robot.health.activated('/camera/image', PERIOD_S, broadcasts=False)
    assert robot.found() == set()
    assert robot.value('localization', 'attempts') == '0'


def test_odometry_that_cannot_be_used_is_a_warning_while_it_comes(robot: Simulated) -> None:
    robot.drive(4.0)
    robot.health.odometry_was_of('trailer')
    assert robot.found() == {Condition.OTHER_BODY}
    assert '`trailer`' in robot.report('odometry').message
    robot.drive(11.0)
    assert robot.found() == set()


def test_odometry_is_a_warning_when_it_misses_several_fixes_or_is_doubted(
    robot: Simulated,
) -> None:
    assert robot.report('odometry').message == 'none is used'
    robot.health.odometry_came()
    assert robot.report('odometry').message == 'used'
    for _ in range(2):
        robot.health.fix_compared(missing=True, doubted=False)
    assert robot.found() == set()
    robot.health.fix_compared(missing=True, doubted=False)
    assert robot.found() == {Condition.ODOMETRY_MISSING}
    robot.health.fix_compared(missing=False, doubted=True)
    assert robot.found() == {Condition.ODOMETRY_DOUBTED}
    assert robot.value('odometry', 'fixes_without_in_a_row') == '0'
    robot.health.fix_compared(missing=False, doubted=False)
    assert robot.found() == set()


def test_an_obstacle_to_map_to_odom_is_an_error_when_it_stays() -> None:
    robot = Simulated()
    robot.activate(broadcasts=True)
    for _ in range(6):
        robot.health.map_to_odom_was_due('somebody else broadcasts the frame', sent=False)
        assert robot.found() == set()
        robot.drive(1.0)
    robot.health.map_to_odom_was_due('somebody else broadcasts the frame', sent=False)
    assert robot.found() == {Condition.BROADCAST_BLOCKED}
    assert 'somebody else' in robot.report('map_to_odom').message
    robot.health.map_to_odom_was_due('', sent=True)
    assert robot.found() == set()


def test_map_to_odom_that_does_not_come_about_is_a_warning_where_it_is_wanted() -> None:
    for wanted in (False, True):
        robot = Simulated()
        robot.activate(broadcasts=wanted)
        robot.drive(11.0)
        assert robot.found() == ({Condition.NOT_BROADCAST} if wanted else set())


EVENTS: dict[str, Callable[[Simulated], Any]] = {
    'load': lambda robot: robot.health.map_loaded(scene_map(metric=False), 'cpu'),
    'refuse': lambda robot: robot.health.map_refused('nowhere'),
    'fail': lambda robot: robot.health.failed('damaged'),
    'unload': lambda robot: robot.health.unloaded(),
    'activate': lambda robot: robot.activate(broadcasts=True),
    'deactivate': lambda robot: robot.health.deactivated(),
    'enable': lambda robot: robot.health.set_enabled(enabled=True),
    'disable': lambda robot: robot.health.set_enabled(enabled=False),
    'image': lambda robot: robot.health.image_came(-5 * SECOND),
    'jump': lambda robot: robot.health.time_jumped(),
    'miss': lambda robot: robot.health.period_over(busy=True),
    'fix': lambda robot: robot.health.attempt_finished(FIX),
    'wall': lambda robot: robot.health.attempt_finished(WALL),
    'unusable': lambda robot: robot.health.attempt_finished(NO_MOUNT),
    'odometry': lambda robot: robot.health.odometry_came(),
    'trailer': lambda robot: robot.health.odometry_was_of('trailer'),
    'compare': lambda robot: robot.health.fix_compared(missing=True, doubted=True),
    'sent': lambda robot: robot.health.map_to_odom_was_due('', sent=True),
    'blocked': lambda robot: robot.health.map_to_odom_was_due('amcl does', sent=False),
    'wait': lambda robot: robot.wait(7.0),
    'pause': lambda robot: robot.wait(7.0, clock_runs=False),
    'while': lambda robot: robot.wait(70.0),
}
LIVES = st.lists(st.sampled_from(sorted(EVENTS)), max_size=40)


def lived(events: list[str]) -> Simulated:
    robot = Simulated()
    for event in events:
        EVENTS[event](robot)
    return robot


@given(LIVES)
def test_whatever_happens_the_parts_and_keys_stay_and_the_worst_condition_decides(
    events: list[str],
) -> None:
    reports, first = diagnose(lived(events).health), diagnose(Health())
    for report, before in zip(reports, first, strict=True):
        assert report.part is before.part
        assert [one.key for one in report.values] == [one.key for one in before.values]
        assert all(isinstance(one.text, str) for one in report.values)
        named = [name for name in Condition.__members__ if f'{name}: ' in report.message]
        assert all(Condition[name].part is report.part for name in named)
        levels = [Condition[name].level.value for name in named]
        assert report.level.value == max(levels, default=Level.OK.value)


@given(LIVES)
def test_no_age_is_negative_and_what_is_not_active_has_nothing_to_complain_of(
    events: list[str],
) -> None:
    robot = lived(events)
    for report in diagnose(robot.health):
        assert all(float(one.text or 0) >= 0 for one in report.values if one.key.endswith('age_s'))
        if robot.health.activity is None and report.part not in {Part.STATE, Part.MAP}:
            assert (report.level, report.message) == (Level.OK, 'the node is not active')


@given(LIVES)
def test_a_deactivated_node_forgets_whatever_happened(events: list[str]) -> None:
    robot = lived([*events, 'unload', 'activate'])
    fresh = lived(['activate'])
    robot.clock_ns = fresh.clock_ns
    robot.health.failed('')
    told_anyway = {Part.INPUT, Part.STATE}
    reports = [one for one in diagnose(robot.health) if one.part not in told_anyway]
    assert reports == [one for one in diagnose(fresh.health) if one.part not in told_anyway]


def test_memory_is_bounded() -> None:
    robot = Simulated()
    robot.activate()
    for _ in range(3):
        for name in sorted(EVENTS):
            EVENTS[name](robot)
    robot.activate()
    sizes = []
    for _ in range(2):
        for _ in range(100):
            for name in (
                'image',
                'jump',
                'fix',
                'wall',
                'unusable',
                'trailer',
                'blocked',
                'compare',
            ):
                EVENTS[name](robot)
        activity = robot.health.activity
        assert activity is not None
        images, attempts = activity.images, activity.attempts
        sizes.append(
            [
                *map(len, (images.arrivals_ns, images.delays_ns, images.jumps_ns)),
                *map(len, (attempts.recent, attempts.timings)),
            ]
        )
    assert sizes[0] == sizes[1]
