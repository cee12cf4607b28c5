# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What follows from what the node counts: the conditions under which somebody should act.

docs/ros_interface.md says of each condition what to do.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from enum import Enum, auto, unique
from statistics import median
from typing import TYPE_CHECKING

from gam_relocalizer.localization.result import Status
from gam_relocalizer.ros.health import JUMPS, RECENT, SECOND, UNUSABLE, Activity, State

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from gam_relocalizer.ros.health import Attempts, Health, Images


@dataclass(frozen=True)
class Patience:
    """How long nothing may come.

    Attributes:
        least_s: At least so long [s].
        periods: And so many periods of the node.
    """

    least_s: float
    periods: int

    def seconds(self, period_s: float) -> float:
        """The longer of both [s]."""
        return max(self.least_s, self.periods * period_s)


# The clock of the node stands when it has read the same for so long.
CLOCK_PATIENCE_S = 3.0
INPUT_PATIENCE = Patience(5.0, 3)
UNUSABLE_IN_A_ROW, UNUSABLE_PATIENCE_S = 3, 5.0
UNUSABLE_SHARE = 0.25
# The median of so many stamps says something; an image or two may have been held up.
ENOUGH_IMAGES = 3
MAX_DELAY_S = 1.0
# A bag that loops jumps back less often.
JUMPS_WITHIN_S = 60.0
# A robot that looks at a white wall for a moment is not lost.
FIX_OVERDUE, NO_FIX = Patience(10.0, 5), Patience(60.0, 30)
MIN_ACCEPTANCE = 0.25
ENOUGH_ATTEMPTS = 3
ODOMETRY_MISSING_IN_A_ROW = 3
# Odometry may begin a moment after the node.
BLOCKED_S = 5.0


@unique
class Level(Enum):
    """Numbers are those of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


@unique
class Condition(Enum):
    """What somebody should act on; each message on /diagnostics begins with the names."""

    TRANSITION_FAILED = auto()
    UNCONFIGURED = auto()
    INACTIVE = auto()
    FINALIZED = auto()
    DISABLED = auto()
    NO_CLOCK = auto()
    CLOCK_STANDS = auto()
    NO_IMAGES = auto()
    IMAGES_UNUSABLE = auto()
    SOME_IMAGES_UNUSABLE = auto()
    STAMPS_OFF = auto()
    TIME_JUMPS = auto()
    NO_FIX = auto()
    FIX_OVERDUE = auto()
    LOW_ACCEPTANCE = auto()
    TOO_SLOW = auto()
    MAP_NOT_METRIC = auto()
    MAP_REFUSED = auto()
    OTHER_BODY = auto()
    ODOMETRY_MISSING = auto()
    ODOMETRY_DOUBTED = auto()
    BROADCAST_BLOCKED = auto()
    NOT_BROADCAST = auto()

    @property
    def level(self) -> Level:
        """ERROR where there is no localization, or a harmful one, until somebody acts."""
        return Level.ERROR if self in _ERRORS else Level.WARN


_ERRORS = frozenset(
    {
        Condition.TRANSITION_FAILED,
        Condition.NO_CLOCK,
        Condition.NO_IMAGES,
        Condition.IMAGES_UNUSABLE,
        Condition.NO_FIX,
        Condition.BROADCAST_BLOCKED,
    }
)


@dataclass(frozen=True)
class Diagnosis:
    """What is to be said about one part of the node.

    Attributes:
        name: The part; it has the same name, and `values` the same keys, in every state.
        level: That of the worst condition.
        message: The conditions, each with its name and in words; or that all is well.
        values: Keys and values; a value that is not known is empty.
    """

    name: str
    level: Level
    message: str
    values: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class _Finding:
    condition: Condition
    text: str

    def __str__(self) -> str:
        return f'{self.condition.name}: {self.text}'


def diagnose(health: Health) -> tuple[Diagnosis, ...]:
    """Everything that is to be said now: one diagnosis for each part of the node."""
    return (
        _state(health),
        _input(health),
        _localization(health),
        _latency(health),
        _map(health),
        _odometry(health),
        _map_to_odom(health),
    )


def _diagnosis(
    name: str, findings: Iterable[_Finding], all_well: str, values: dict[str, str]
) -> Diagnosis:
    worst_first = sorted(findings, key=lambda finding: -finding.condition.level.value)
    level = worst_first[0].condition.level if worst_first else Level.OK
    message = '; '.join(map(str, worst_first)) or all_well
    return Diagnosis(name, level, message, tuple(values.items()))


def _active_diagnosis(
    name: str,
    health: Health,
    findings: Callable[[Health, Activity], Iterable[_Finding]],
    all_well: str,
    values: dict[str, str],
) -> Diagnosis:
    """Of a part that there is only while the node is active; else there is nothing to find."""
    if health.activity is None:
        return _diagnosis(name, (), 'the node is not active', values)
    return _diagnosis(name, findings(health, health.activity), all_well, values)


# The managed node


def _state(health: Health) -> Diagnosis:
    values = {
        'state': health.state.value,
        'enabled': _yes_or_no(health.enabled),
        'error': health.error,
    }
    return _diagnosis('state', _state_findings(health), health.state.value, values)


def _state_findings(health: Health) -> Iterator[_Finding]:
    if health.error:
        yield _Finding(Condition.TRANSITION_FAILED, health.error)
    elif health.state is State.UNCONFIGURED:
        yield _Finding(Condition.UNCONFIGURED, 'no map is loaded; configure and activate the node')
    elif health.state is State.INACTIVE:
        yield _Finding(Condition.INACTIVE, 'the node does not listen; activate it')
    elif health.state is State.FINALIZED:
        yield _Finding(Condition.FINALIZED, 'the node was shut down; start its process again')
    elif not health.enabled:
        yield _Finding(Condition.DISABLED, 'no attempt is made unless a service asks for one')


# What comes in


def _input(health: Health) -> Diagnosis:
    activity = health.activity or Activity()
    images, attempts, now_ns = activity.images, activity.attempts, health.now_ns
    rate, delay = _rate(images, now_ns), _delay_s(images)
    values = {
        'image_topic': images.topic,
        'image_publishers': str(images.publishers),
        'images': str(images.count),
        'images_not_tried': str(max(0, images.count - attempts.count)),
        'image_rate_hz': _number(rate),
        'image_age_s': _number(_age_s(images.last_ns, now_ns)),
        'image_delay_s': _number(delay, '.3f'),
        'unusable_in_a_row': str(attempts.unusable),
        'time_jumps': str(images.jumps),
    }
    all_well = 'no image yet' if rate is None else f'images at {rate:.1f} Hz'
    return _active_diagnosis('input', health, _input_findings, all_well, values)


def _input_findings(health: Health, activity: Activity) -> Iterator[_Finding]:
    if health.clock_stands_s >= CLOCK_PATIENCE_S:
        # nothing can be on time then
        yield _clock_finding(health)
        return
    yield from _silence(activity.images, health)
    yield from _unusable(activity.attempts, health)
    yield from _stamps(activity.images, health)


def _clock_finding(health: Health) -> _Finding:
    if health.clock_ns == 0:
        return _Finding(Condition.NO_CLOCK, 'use_sim_time is set, and nothing comes on /clock')
    return _Finding(
        Condition.CLOCK_STANDS, f'the clock of the node has stood for {health.clock_stands_s:.0f} s'
    )


def _silence(images: Images, health: Health) -> Iterator[_Finding]:
    silent_s = health.seconds_without(images.last_ns)
    if silent_s > INPUT_PATIENCE.seconds(health.period_s):
        yield _Finding(
            Condition.NO_IMAGES,
            f'nothing on {images.topic} for {silent_s:.0f} s; it has {images.publishers} '
            f'publishers',
        )


def _unusable(attempts: Attempts, health: Health) -> Iterator[_Finding]:
    unusable = [status for status in attempts.recent if status in UNUSABLE]
    lasting_s = (health.now_ns - attempts.unusable_since_ns) / SECOND
    if attempts.unusable >= UNUSABLE_IN_A_ROW and lasting_s >= UNUSABLE_PATIENCE_S:
        yield _Finding(
            Condition.IMAGES_UNUSABLE,
            f'{attempts.unusable} in a row, {attempts.recent[-1].name}: {attempts.reason}',
        )
    elif len(unusable) > UNUSABLE_SHARE * RECENT:
        yield _Finding(
            Condition.SOME_IMAGES_UNUSABLE,
            f'{len(unusable)} of the last {len(attempts.recent)}, mostly {_commonest(unusable)}',
        )


def _stamps(images: Images, health: Health) -> Iterator[_Finding]:
    delay_s = _delay_s(images)
    if delay_s is not None and abs(delay_s) > MAX_DELAY_S:
        side = 'behind' if delay_s > 0 else 'ahead of'
        yield _Finding(
            Condition.STAMPS_OFF,
            f'the stamps on {images.topic} are {abs(delay_s):.1f} s {side} the clock of the node',
        )
    jumps = [at_ns for at_ns in images.jumps_ns if health.now_ns - at_ns < JUMPS_WITHIN_S * SECOND]
    if len(jumps) == JUMPS:
        yield _Finding(
            Condition.TIME_JUMPS,
            f'time jumped back {JUMPS} times in the last {JUMPS_WITHIN_S:.0f} s',
        )


def _rate(images: Images, now_ns: int) -> float | None:
    """Of the last images [1/s]; it sinks when they stop."""
    if len(images.arrivals_ns) < ENOUGH_IMAGES or now_ns <= images.arrivals_ns[0]:
        return None
    return len(images.arrivals_ns) * SECOND / (now_ns - images.arrivals_ns[0])


def _delay_s(images: Images) -> float | None:
    """By how much the stamps of the last images are behind the node's clock [s]."""
    if len(images.delays_ns) < ENOUGH_IMAGES:
        return None
    return median(images.delays_ns) / SECOND


# What comes of it


def _localization(health: Health) -> Diagnosis:
    activity = health.activity or Activity()
    attempts = activity.attempts
    share = _acceptance(attempts)
    age_s = _age_s(attempts.last_fix_ns, health.now_ns)
    values = {
        'attempts': str(attempts.count),
        'fixes': str(attempts.fixes),
        'last_fix_age_s': _number(age_s),
        'acceptance': _number(share, '.2f'),
        'refusals_in_a_row': str(attempts.refusals),
        'commonest_refusal': _commonest(_refusals(attempts)),
        'last_status': attempts.recent[-1].name if attempts.recent else '',
        'last_reason': attempts.reason,
    }
    all_well = 'no fix yet' if age_s is None else f'last fix {age_s:.1f} s ago'
    return _active_diagnosis('localization', health, _localization_findings, all_well, values)


def _localization_findings(health: Health, activity: Activity) -> Iterator[_Finding]:
    if not health.enabled:
        return
    attempts = activity.attempts
    without_s = health.seconds_without(attempts.last_fix_ns)
    enough = len(attempts.recent) == RECENT and RECENT * health.period_s >= FIX_OVERDUE.least_s
    share = _acceptance(attempts)
    if without_s > NO_FIX.seconds(health.period_s):
        yield _Finding(Condition.NO_FIX, _without_fix(without_s, attempts))
    elif without_s > FIX_OVERDUE.seconds(health.period_s):
        yield _Finding(Condition.FIX_OVERDUE, _without_fix(without_s, attempts))
    elif enough and share is not None and share < MIN_ACCEPTANCE:
        yield _Finding(
            Condition.LOW_ACCEPTANCE,
            f'{share:.0%} of the last {RECENT} attempts gave a fix; the others mostly '
            f'{_commonest(_refusals(attempts))}',
        )


def _without_fix(without_s: float, attempts: Attempts) -> str:
    if not attempts.refusals:
        return f'none for {without_s:.0f} s; no attempt was made'
    return (
        f'none for {without_s:.0f} s; {attempts.refusals} refusals in a row, lately mostly '
        f'{_commonest(_refusals(attempts))}'
    )


def _refusals(attempts: Attempts) -> list[Status]:
    return [status for status in attempts.recent if status is not Status.ACCEPTED]


def _acceptance(attempts: Attempts) -> float | None:
    if not attempts.recent:
        return None
    return sum(status is Status.ACCEPTED for status in attempts.recent) / len(attempts.recent)


# How long it takes


def _latency(health: Health) -> Diagnosis:
    activity = health.activity or Activity()
    timings = activity.attempts.timings
    total_ms = _median(one.total for one in timings)
    values = {
        'device': health.device,
        'period_s': _number(health.period_s or None, 'g'),
        'extraction_ms': _number(_median(one.extraction for one in timings)),
        'retrieval_ms': _number(_median(one.retrieval for one in timings)),
        'matching_ms': _number(_median(one.matching for one in timings)),
        'pose_ms': _number(_median(one.pose for one in timings)),
        'total_ms': _number(total_ms),
        'longest_ms': _number(max((one.total for one in timings), default=None)),
        'periods_missed': str(activity.attempts.periods_missed),
    }
    all_well = 'no attempt yet' if total_ms is None else f'{total_ms:.0f} ms'
    return _active_diagnosis('latency', health, _latency_findings, all_well, values)


def _latency_findings(health: Health, activity: Activity) -> Iterator[_Finding]:
    timings = activity.attempts.timings
    total_ms = _median(one.total for one in timings)
    if len(timings) < ENOUGH_ATTEMPTS or total_ms is None:
        return
    if total_ms > health.period_s * 1e3:
        yield _Finding(
            Condition.TOO_SLOW,
            f'an attempt takes {total_ms:.0f} ms, and one is due each {health.period_s:g} s',
        )


# The map


def _map(health: Health) -> Diagnosis:
    facts = health.map
    values = {
        'map_id': facts.map_id if facts else '',
        'path': facts.path if facts else '',
        'images': str(facts.images) if facts else '',
        'points': str(facts.points) if facts else '',
        'metric': _yes_or_no(facts.metric) if facts else '',
    }
    all_well = f'map {facts.map_id}' if facts else 'no map is loaded'
    return _diagnosis('map', _map_findings(health), all_well, values)


def _map_findings(health: Health) -> Iterator[_Finding]:
    if health.map_error:
        yield _Finding(Condition.MAP_REFUSED, f'the one before stays in use: {health.map_error}')
    if health.map is not None and not health.map.metric:
        yield _Finding(
            Condition.MAP_NOT_METRIC,
            'its poses are not in metres, and neither odometry nor map -> odom can be used',
        )


# Odometry


def _odometry(health: Health) -> Diagnosis:
    odometry = (health.activity or Activity()).odometry
    now_ns = health.now_ns
    values = {
        'odometry_age_s': _number(_age_s(odometry.last_ns, now_ns)),
        'doubted': _yes_or_no(odometry.doubted),
        'fixes_without_in_a_row': str(odometry.missing),
    }
    all_well = 'none is used' if odometry.last_ns is None else 'used'
    return _active_diagnosis('odometry', health, _odometry_findings, all_well, values)


def _odometry_findings(health: Health, activity: Activity) -> Iterator[_Finding]:
    odometry = activity.odometry
    if odometry.other_body and health.is_recent(odometry.other_body_ns):
        yield _Finding(
            Condition.OTHER_BODY, f'odometry of `{odometry.other_body}` comes and is not used'
        )
    if odometry.missing >= ODOMETRY_MISSING_IN_A_ROW:
        yield _Finding(
            Condition.ODOMETRY_MISSING,
            f'there was none at the stamps of the last {odometry.missing} fixes',
        )
    if odometry.doubted:
        yield _Finding(
            Condition.ODOMETRY_DOUBTED,
            'several fixes in a row disagreed with it, and fixes pass unchecked',
        )


# map -> odom


def _map_to_odom(health: Health) -> Diagnosis:
    broadcast = (health.activity or Activity()).broadcast
    values = {
        'wanted': _yes_or_no(broadcast.wanted),
        'broadcast_age_s': _number(_age_s(broadcast.last_ns, health.now_ns)),
        'obstacle': broadcast.obstacle,
    }
    all_well = 'broadcast' if broadcast.wanted else 'not asked for'
    return _active_diagnosis('map_to_odom', health, _map_to_odom_findings, all_well, values)


def _map_to_odom_findings(health: Health, activity: Activity) -> Iterator[_Finding]:
    broadcast = activity.broadcast
    if not broadcast.wanted:
        return
    blocked_s = health.seconds_without(broadcast.obstacle_since_ns)
    without_s = health.seconds_without(broadcast.last_ns)
    if broadcast.obstacle and blocked_s > BLOCKED_S:
        yield _Finding(Condition.BROADCAST_BLOCKED, broadcast.obstacle)
    elif health.enabled and without_s > FIX_OVERDUE.seconds(health.period_s):
        yield _Finding(
            Condition.NOT_BROADCAST, f'none for {without_s:.0f} s; is there a fix, and tf2_msgs?'
        )


# Values


def _commonest(statuses: Iterable[Status]) -> str:
    """Name of the most frequent one, empty without any."""
    commonest = Counter(status.name for status in statuses).most_common(1)
    return commonest[0][0] if commonest else ''


def _median(numbers: Iterable[float]) -> float | None:
    numbers = list(numbers)
    return median(numbers) if numbers else None


def _age_s(at_ns: int | None, now_ns: int) -> float | None:
    return None if at_ns is None else max(0, now_ns - at_ns) / SECOND


def _number(number: float | None, form: str = '.1f') -> str:
    return '' if number is None else format(number, form)


def _yes_or_no(answer: bool) -> str:  # noqa: FBT001 - what it is about
    return 'yes' if answer else 'no'
