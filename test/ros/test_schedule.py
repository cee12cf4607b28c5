# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from gam_relocalizer.ros.schedule import RESTART_NS, Schedule, StampedImage

SECOND = 10**9


def image(stamp_ns: int) -> StampedImage:
    return StampedImage('pixels', stamp_ns)


def test_the_first_image_is_due_at_once() -> None:
    schedule = Schedule()
    assert not schedule.ready
    schedule.offer(image(1))
    assert schedule.ready
    assert schedule.take().stamp_ns == 1


def test_after_an_attempt_a_period_has_to_pass() -> None:
    schedule = Schedule()
    schedule.offer(image(1))
    schedule.take()
    schedule.offer(image(2))
    assert not schedule.ready
    schedule.tick()
    assert schedule.take().stamp_ns == 2


def test_periods_do_not_pile_up() -> None:
    schedule = Schedule()
    for _ in range(5):
        schedule.tick()
    schedule.offer(image(1))
    schedule.take()
    schedule.offer(image(2))
    assert not schedule.ready


def test_no_image_is_tried_twice() -> None:
    schedule = Schedule()
    schedule.offer(image(1))
    schedule.take()
    schedule.tick()
    assert not schedule.ready


@given(st.lists(st.one_of(st.none(), st.integers(0, 10**18))))
def test_what_is_taken_is_the_last_offered_and_stamps_accepted_rise(
    events: list[int | None],
) -> None:
    schedule, newest, accepted = Schedule(), None, []
    for stamp_ns in events:
        if stamp_ns is not None:
            schedule.offer(image(stamp_ns))
            newest = stamp_ns
            continue
        schedule.tick()
        if schedule.ready:
            taken = schedule.take().stamp_ns
            assert taken == newest
            if schedule.accepts(taken):
                accepted.append(taken)
    assert accepted == sorted(set(accepted))


def test_a_straggler_is_no_restart_but_an_old_image_is() -> None:
    schedule = Schedule()
    assert not schedule.went_back(0)
    assert schedule.accepts(100 * SECOND)
    assert not schedule.went_back(100 * SECOND - RESTART_NS)
    assert schedule.went_back(100 * SECOND - RESTART_NS - 1)
    schedule.restart()
    assert schedule.accepts(SECOND)
