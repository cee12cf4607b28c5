# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What follows from what the node counts: the conditions under which somebody should act."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from enum import Enum, unique
from statistics import median
from typing import TYPE_CHECKING, NamedTuple

from gam_relocalizer.localization.result import Status
from gam_relocalizer.ros.health import (
    JUMPS,
    RECENT,
    RECENTLY_NS,
    SECOND,
    UNUSABLE,
    Activity,
    State,
)

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

    def __str__(self) -> str:
        return f'{self.least_s:g} s and {self.periods} periods'


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
OVERDUE_PATIENCE, NO_FIX_PATIENCE = Patience(10.0, 5), Patience(60.0, 30)
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
class Part(Enum):
    """What is reported on by itself."""

    STATE = 'state'
    INPUT = 'input'
    LOCALIZATION = 'localization'
    LATENCY = 'latency'
    MAP = 'map'
    ODOMETRY = 'odometry'
    MAP_TO_ODOM = 'map_to_odom'


@unique
class Condition(Enum):
    """What somebody should act on; each message on /diagnostics begins with the names.

    A level is ERROR where there is no localization, or a harmful one, until somebody acts.

    Attributes:
        part: Where it is reported.
        level: How bad it is.
        when: What it means.
        remedy: What to do.
    """

    TRANSITION_FAILED = (
        Part.STATE,
        Level.ERROR,
        'a transition came to nothing, and none has succeeded since',
        'The message has the file or parameter and what is wrong with it. Mend it, then configure '
        'and activate, or start again.',
    )
    UNCONFIGURED = (
        Part.STATE,
        Level.WARN,
        'no map is loaded',
        'Configure and activate the node, or have it do so with `autostart: true`.',
    )
    INACTIVE = (
        Part.STATE,
        Level.WARN,
        'a map is loaded, and the node does not listen',
        'Activate it.',
    )
    FINALIZED = (
        Part.STATE,
        Level.WARN,
        'a lifecycle *shutdown* was asked for',
        'The node has let go of everything, refuses every request, and no transition leads back. '
        'Start its process again.',
    )
    DISABLED = (
        Part.STATE,
        Level.WARN,
        '`~/set_enabled` said so',
        'Call `~/set_enabled` with true, or leave it so and use `~/relocalize`.',
    )
    NO_CLOCK = (
        Part.INPUT,
        Level.ERROR,
        f"the node's clock has read 0 for {CLOCK_PATIENCE_S:g} s",
        '`use_sim_time` is set and nobody publishes `/clock`: start the simulation, play the bag '
        'with `--clock`, or set `use_sim_time: false`.',
    )
    CLOCK_STANDS = (
        Part.INPUT,
        Level.WARN,
        f"the node's clock has not moved for {CLOCK_PATIENCE_S:g} s",
        'The bag or the simulation is paused or gone. No attempt is made until it goes on, and '
        'nothing else is said of the input.',
    )
    NO_IMAGES = (
        Part.INPUT,
        Level.ERROR,
        f'no image for {INPUT_PATIENCE}',
        'With 0 publishers the camera is off or the topic has another name: remap `image`. With '
        'some, see `image_transport`, `image_reliability` and the log for incompatible quality of '
        'service.',
    )
    IMAGES_UNUSABLE = (
        Part.INPUT,
        Level.ERROR,
        f'for {UNUSABLE_PATIENCE_S:g} s, and {UNUSABLE_IN_A_ROW} times in a row, no attempt could '
        f'be made',
        'Status and reason of the last one follow: '
        + ', '.join(status.name for status in Status if status in UNUSABLE)
        + '. Do as [their table](#statuses) says.',
    )
    SOME_IMAGES_UNUSABLE = (
        Part.INPUT,
        Level.WARN,
        f'more than {UNUSABLE_SHARE * RECENT:g} of the last {RECENT} attempts could not be made, '
        f'and not IMAGES_UNUSABLE',
        'The same, now and then: a transform that comes late, a driver that repeats stamps, a '
        'lossy transport.',
    )
    STAMPS_OFF = (
        Part.INPUT,
        Level.WARN,
        f"the median stamp lately is more than {MAX_DELAY_S:g} s behind the node's clock, or ahead",
        'Fixes carry that stamp, and filters will misplace or drop them. Synchronize the clocks of '
        'camera and computer; for a bag set `use_sim_time` and play it with `--clock`.',
    )
    TIME_JUMPS = (
        Part.INPUT,
        Level.WARN,
        f'time, or the stamps of the images, jumped back {JUMPS} times within {JUMPS_WITHIN_S:g} s',
        'The node forgets its last fix each time. Two cameras on one topic, or a driver without a '
        'steady clock; a short bag that loops does it, too.',
    )
    FIX_OVERDUE = (
        Part.LOCALIZATION,
        Level.WARN,
        f'no fix for {OVERDUE_PATIENCE}',
        'The message has the most frequent refusal lately; [its row](#statuses) says what to do. '
        'After "no attempt was made" see `input`. It passes where the robot comes out of a place '
        'that is not in the map.',
    )
    NO_FIX = (
        Part.LOCALIZATION,
        Level.ERROR,
        f'no fix for {NO_FIX_PATIENCE}',
        'As above. The robot has only its odometry: stop it, or drive it to where the map is good.',
    )
    LOW_ACCEPTANCE = (
        Part.LOCALIZATION,
        Level.WARN,
        f'less than {MIN_ACCEPTANCE:.0%} of the last {RECENT} attempts gave a fix, and none of the '
        f'above; with periods of {OVERDUE_PATIENCE.least_s / RECENT:g} s and more',
        'The place has changed, the light is another, or the camera looks elsewhere than in the '
        'map. See the most frequent refusal; map the place again.',
    )
    TOO_SLOW = (
        Part.LATENCY,
        Level.WARN,
        f'the median time of an attempt lately, of at least {ENOUGH_ATTEMPTS}, is longer than the '
        f'period',
        'Attempts come as fast as they can, and keep a core or more busy. Set a longer `period`, '
        'or `max_keypoints`, `max_scenes` or `scene_images` lower, or see what else takes the '
        'processor.',
    )
    MAP_NOT_METRIC = (
        Part.MAP,
        Level.WARN,
        'the map is from images alone',
        'Its poses are no frame in the sense of REP-105, and odometry, `initialpose`, '
        '`max_tilt_deg` and `publish_map_odom` do nothing. Align it with `map align`, or build it '
        'with `--poses`.',
    )
    MAP_REFUSED = (
        Part.MAP,
        Level.WARN,
        '`~/load_map` failed, and none has succeeded since',
        'The map before is still in use. Mend what the message says, and load it again.',
    )
    OTHER_BODY = (
        Part.ODOMETRY,
        Level.WARN,
        'odometry of another frame than `base_frame` came within the last '
        f'{RECENTLY_NS // SECOND} s',
        'It is not used. Set `base_frame` to its `child_frame_id`, or remap `odom`.',
    )
    ODOMETRY_MISSING = (
        Part.ODOMETRY,
        Level.WARN,
        f'there is odometry, and {ODOMETRY_MISSING_IN_A_ROW} fixes in a row had none at their '
        f'stamp',
        'Fixes are not compared with it. It has stopped, has gaps of more than a second, or its '
        "clock is another than the camera's.",
    )
    ODOMETRY_DOUBTED = (
        Part.ODOMETRY,
        Level.WARN,
        'five good poses in a row fitted neither it nor each other, and two in a row have not '
        'agreed by it since',
        "Fixes pass unchecked. Slipping wheels, another robot's odometry, wrong units; or a map "
        'with many places that look alike.',
    )
    BROADCAST_BLOCKED = (
        Part.MAP_TO_ODOM,
        Level.ERROR,
        f'with `publish_map_odom`: for {BLOCKED_S:g} s something other than a missing fix keeps it '
        f'from being broadcast',
        'The message says what: no odometry, another owner of the frame, frames without names, a '
        'map that is not metric.',
    )
    NOT_BROADCAST = (
        Part.MAP_TO_ODOM,
        Level.WARN,
        f'with `publish_map_odom`: it has not been broadcast for {OVERDUE_PATIENCE}, and not '
        f'BROADCAST_BLOCKED',
        'There has been no fix with odometry at its stamp yet: see `localization` and `odometry`. '
        'Or tf2_msgs is not installed.',
    )

    def __init__(self, part: Part, level: Level, when: str, remedy: str) -> None:
        self.part = part
        self.level = level
        self.when = when
        self.remedy = remedy


class Value(NamedTuple):
    """A value that is reported.

    Attributes:
        key: Its name.
        text: The value; empty when it is not known.
        meaning: What it is.
    """

    key: str
    text: str
    meaning: str


@dataclass(frozen=True)
class Diagnosis:
    """What is to be said about one part of the node.

    Attributes:
        part: What it is about; `values` have the same keys in every state.
        level: That of the worst condition.
        message: The conditions, each with its name and in words; or that all is well.
        values: What is reported beside the message.
    """

    part: Part
    level: Level
    message: str
    values: tuple[Value, ...]


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
    part: Part, findings: Iterable[_Finding], all_well: str, values: tuple[Value, ...]
) -> Diagnosis:
    worst_first = sorted(findings, key=lambda finding: -finding.condition.level.value)
    level = worst_first[0].condition.level if worst_first else Level.OK
    message = '; '.join(map(str, worst_first)) or all_well
    return Diagnosis(part, level, message, values)


def _active_diagnosis(
    part: Part,
    health: Health,
    findings: Callable[[Health, Activity], Iterable[_Finding]],
    all_well: str,
    values: tuple[Value, ...],
) -> Diagnosis:
    """Of a part that there is only while the node is active; else there is nothing to find."""
    if health.activity is None:
        return _diagnosis(part, (), 'the node is not active', values)
    return _diagnosis(part, findings(health, health.activity), all_well, values)


# The managed node


def _state(health: Health) -> Diagnosis:
    values = (
        Value('state', health.state.value, 'unconfigured, inactive, active or finalized'),
        Value(
            'enabled',
            _yes_or_no(health.enabled),
            'whether attempts are made without being asked for',
        ),
        Value('error', health.error, 'why the last transition failed'),
    )
    return _diagnosis(Part.STATE, _state_findings(health), health.state.value, values)


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
    values = (
        Value('image_topic', images.topic, 'topic of the images, resolved'),
        Value('image_publishers', str(images.publishers), 'how many publish there'),
        Value('images', str(images.count), 'images that came'),
        Value(
            'images_not_tried',
            str(max(0, images.count - attempts.count)),
            'those passed over, because a newer one came before an attempt was due; most of them, '
            'with any camera',
        ),
        Value('image_rate_hz', _number(rate), 'images per second lately'),
        Value('image_age_s', _number(_age_s(images.last_ns, now_ns)), 'since the last image came'),
        Value(
            'image_delay_s',
            _number(delay, '.3f'),
            "by how much stamps are behind the node's clock when images come, median lately",
        ),
        Value(
            'unusable_in_a_row',
            str(attempts.unusable),
            'attempts that could not be made, since one could',
        ),
        Value('time_jumps', str(images.jumps), 'how often time jumped back'),
    )
    all_well = 'no image yet' if rate is None else f'images at {rate:.1f} Hz'
    return _active_diagnosis(Part.INPUT, health, _input_findings, all_well, values)


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
    values = (
        Value('attempts', str(attempts.count), 'images with a verdict on `~/status`'),
        Value('fixes', str(attempts.fixes), 'those that were accepted'),
        Value('last_fix_age_s', _number(age_s), 'since the last fix was published'),
        Value('acceptance', _number(share, '.2f'), 'share of fixes lately, 0 to 1'),
        Value('refusals_in_a_row', str(attempts.refusals), 'refusals since the last fix'),
        Value(
            'commonest_refusal',
            _commonest(_refusals(attempts)),
            'the most frequent status of a refusal lately',
        ),
        Value(
            'last_status',
            attempts.recent[-1].name if attempts.recent else '',
            'status of the last attempt',
        ),
        Value('last_reason', attempts.reason, 'and its reason'),
    )
    all_well = 'no fix yet' if age_s is None else f'last fix {age_s:.1f} s ago'
    return _active_diagnosis(Part.LOCALIZATION, health, _localization_findings, all_well, values)


def _localization_findings(health: Health, activity: Activity) -> Iterator[_Finding]:
    if not health.enabled:
        return
    attempts = activity.attempts
    without_s = health.seconds_without(attempts.last_fix_ns)
    enough = len(attempts.recent) == RECENT and RECENT * health.period_s >= OVERDUE_PATIENCE.least_s
    share = _acceptance(attempts)
    if without_s > NO_FIX_PATIENCE.seconds(health.period_s):
        yield _Finding(Condition.NO_FIX, _without_fix(without_s, attempts))
    elif without_s > OVERDUE_PATIENCE.seconds(health.period_s):
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
    values = (
        Value('device', health.device, 'where the networks run, and threads'),
        Value('period_s', _number(health.period_s or None, 'g'), 'the parameter `period`'),
        Value(
            'extraction_ms',
            _number(_median(one.extraction for one in timings)),
            'time for the features, the median lately, as the next five',
        ),
        Value(
            'retrieval_ms',
            _number(_median(one.retrieval for one in timings)),
            'time for the most similar reference images',
        ),
        Value(
            'matching_ms',
            _number(_median(one.matching for one in timings)),
            'time for matching, over all scenes',
        ),
        Value(
            'pose_ms', _number(_median(one.pose for one in timings)), 'time for pose and covariance'
        ),
        Value(
            'verdict_ms',
            _number(_median(one.verdict for one in timings)),
            'time for all that decides whether to believe the pose',
        ),
        Value('total_ms', _number(total_ms), 'time of an attempt'),
        Value(
            'longest_ms',
            _number(max((one.total for one in timings), default=None)),
            'time of the longest attempt lately',
        ),
        Value(
            'periods_missed',
            str(activity.attempts.periods_missed),
            'how often an attempt was due while another was under way',
        ),
    )
    all_well = 'no attempt yet' if total_ms is None else f'{total_ms:.0f} ms'
    return _active_diagnosis(Part.LATENCY, health, _latency_findings, all_well, values)


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
    values = (
        Value(
            'map_id',
            facts.map_id if facts else '',
            'identity of the map in use; it changes with every byte of it',
        ),
        Value('path', facts.path if facts else '', 'its directory'),
        Value('images', str(facts.images) if facts else '', 'its reference images'),
        Value('points', str(facts.points) if facts else '', 'its points'),
        Value('metric', _yes_or_no(facts.metric) if facts else '', 'whether it is metric'),
    )
    all_well = f'map {facts.map_id}' if facts else 'no map is loaded'
    return _diagnosis(Part.MAP, _map_findings(health), all_well, values)


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
    values = (
        Value(
            'odometry_age_s',
            _number(_age_s(odometry.last_ns, now_ns)),
            'since the last message that can be used; empty without any',
        ),
        Value('doubted', _yes_or_no(odometry.doubted), 'whether fixes pass although they disagree'),
        Value(
            'fixes_without_in_a_row',
            str(odometry.missing),
            'fixes without odometry at their stamp, since one with it',
        ),
    )
    all_well = 'none is used' if odometry.last_ns is None else 'used'
    return _active_diagnosis(Part.ODOMETRY, health, _odometry_findings, all_well, values)


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
    values = (
        Value('wanted', _yes_or_no(broadcast.wanted), 'the parameter `publish_map_odom`'),
        Value(
            'broadcast_age_s',
            _number(_age_s(broadcast.last_ns, health.now_ns)),
            'since the last broadcast',
        ),
        Value('obstacle', broadcast.obstacle, 'what keeps it from being broadcast'),
    )
    all_well = 'broadcast' if broadcast.wanted else 'not asked for'
    return _active_diagnosis(Part.MAP_TO_ODOM, health, _map_to_odom_findings, all_well, values)


def _map_to_odom_findings(health: Health, activity: Activity) -> Iterator[_Finding]:
    broadcast = activity.broadcast
    if not broadcast.wanted:
        return
    blocked_s = health.seconds_without(broadcast.obstacle_since_ns)
    without_s = health.seconds_without(broadcast.last_ns)
    if broadcast.obstacle and blocked_s > BLOCKED_S:
        yield _Finding(Condition.BROADCAST_BLOCKED, broadcast.obstacle)
    elif health.enabled and without_s > OVERDUE_PATIENCE.seconds(health.period_s):
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
