# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import weakref
from itertools import pairwise

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from moving_camera import FRAME_NS, HEIGHT, WIDTH, blurred, chosen_of, frames_of, seen_at

from gam_relocalizer.capture.keyframes import (
    DUE_DISPLACEMENT,
    EARLIEST,
    LATEST,
    MILLISECOND,
    NEIGHBOURS,
    Frame,
    select_keyframes,
)

DUE = DUE_DISPLACEMENT * WIDTH


def sliding(step: float, count: int, start: float = 0.0) -> list[Frame]:
    return frames_of(seen_at(start + step * index) for index in range(count))


def places_of(chosen: list[int], step: float) -> np.ndarray:
    return step * np.array(chosen)


@pytest.mark.parametrize('step', [2.0, 5.0, 11.0])
def test_a_sliding_camera_gives_keyframes_at_the_due_distance(step: float) -> None:
    chosen, counts = chosen_of(sliding(step, int(600 / step)))

    gaps = np.diff(places_of(chosen, step))
    assert chosen[0] == 0
    assert len(chosen) > 8
    assert gaps.min() > EARLIEST * DUE - 1.0
    assert gaps.max() < LATEST * DUE + 1.0
    assert (counts.late, counts.empty, counts.blurred) == (0, 0, 0)
    assert counts.chosen == len(chosen)


def test_frames_that_are_nearly_due_each_are_all_chosen() -> None:
    step = 0.9 * DUE
    assert chosen_of(sliding(step, 20))[0] == list(range(20))


def test_a_leap_is_made_smaller_by_the_frame_before_it() -> None:
    half_way = 0.5 * DUE
    frames = frames_of([seen_at(0.0), seen_at(half_way), seen_at(half_way + DUE)])
    assert chosen_of(frames)[0] == [0, 1, 2]


def test_a_camera_at_rest_gives_one_keyframe_whatever_its_sensor_does() -> None:
    random = np.random.default_rng(1)
    gains = 1.0 + 0.15 * np.sin(np.arange(150) / 15.0)
    noisy = [
        np.clip(gain * seen_at(50.0) + random.normal(0.0, 4.0, (HEIGHT, WIDTH, 3)), 0, 255)
        for gain in gains
    ]

    chosen, counts = chosen_of(frames_of(image.astype(np.uint8) for image in noisy))

    assert chosen == [0]
    assert counts.read == 150


def test_someone_who_walks_by_a_camera_at_rest_gives_no_keyframe() -> None:
    def with_passer_by(index: int) -> np.ndarray:
        image = seen_at(50.0)
        left = 12 * index - 80
        image[:, max(0, left) : max(0, left + 80)] = 90
        return image

    chosen, _ = chosen_of(frames_of(with_passer_by(index) for index in range(45)))
    assert chosen == [0]


def test_a_turn_about_the_optical_axis_gives_keyframes() -> None:
    def turned(angle: float) -> np.ndarray:
        turn = cv2.getRotationMatrix2D((WIDTH / 2, HEIGHT / 2), angle, 1.0)
        return cv2.warpAffine(seen_at(400.0), turn, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT)

    chosen, _ = chosen_of(frames_of(turned(2.0 * index) for index in range(91)))

    assert len(chosen) > 4
    assert 2.0 * np.diff(chosen).max() < 50.0


def test_walking_forward_gives_keyframes() -> None:
    def nearer(scale: float) -> np.ndarray:
        patch = cv2.getRectSubPix(
            seen_at(400.0), (round(WIDTH / scale), round(HEIGHT / scale)), (WIDTH / 2, HEIGHT / 2)
        )
        return cv2.resize(patch, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)

    scales = 1.02 ** np.arange(60)
    chosen, _ = chosen_of(frames_of(nearer(float(scale)) for scale in scales))

    steps = np.diff(np.log(scales[chosen]))
    assert len(chosen) > 2
    assert steps.max() < np.log(2.0)


def test_frames_between_which_nothing_can_be_followed_are_all_keyframes() -> None:
    chosen, _ = chosen_of(frames_of(seen_at(400.0 * index) for index in range(7)))
    assert chosen == list(range(7))


def test_texture_after_a_bare_wall_is_a_keyframe() -> None:
    ramp = np.tile(np.linspace(60, 180, WIDTH), (HEIGHT, 1)).astype(np.uint8)
    bare = np.repeat(ramp[:, :, None], 3, axis=2)
    chosen, _ = chosen_of(frames_of([bare] * 20 + [seen_at(0.0)] * 20))
    assert chosen == [0, 20]


def test_noise_before_a_bare_wall_gives_no_keyframes() -> None:
    random = np.random.default_rng(2)
    ramp = np.tile(np.linspace(60, 180, 640), (480, 1))
    noisy = (ramp + random.normal(0.0, 5.0, ramp.shape) for _ in range(30))
    chosen, _ = chosen_of(frames_of(np.clip(image, 0, 255).astype(np.uint8) for image in noisy))
    assert chosen == [0]


def test_blurred_frames_are_counted_and_never_chosen() -> None:
    shaken = {20, 21, 22, 47, 48, 60}
    frames = frames_of(
        blurred(seen_at(4.0 * index)) if index in shaken else seen_at(4.0 * index)
        for index in range(100)
    )

    chosen, counts = chosen_of(frames)

    assert counts.blurred == len(shaken)
    assert not shaken.intersection(chosen)
    assert np.diff(places_of(chosen, 4.0)).max() < LATEST * DUE + 4.0


def test_a_soft_lens_is_not_blur() -> None:
    frames = frames_of(blurred(seen_at(4.0 * index)) for index in range(60))
    chosen, counts = chosen_of(frames)
    assert counts.blurred == 0
    assert len(chosen) > 3


def test_the_sharpest_frame_around_the_due_moment_is_chosen() -> None:
    sharp = 7
    frames = frames_of(
        seen_at(4.0 * index) if index == sharp else blurred(seen_at(4.0 * index), 0.6)
        for index in range(11)
    )
    assert EARLIEST * DUE < 4.0 * sharp < LATEST * DUE
    assert chosen_of(frames)[0] == [0, sharp]


def test_black_frames_and_those_of_one_colour_are_left_out() -> None:
    frames = sliding(4.0, 60)
    for index in (0, 1, 30):
        frames[index].image[:] = 0
    frames[31].image[:] = 200

    chosen, counts = chosen_of(frames)

    assert counts.empty == 4
    assert chosen[0] == 2
    assert not {30, 31}.intersection(chosen)


def test_frames_whose_stamps_do_not_rise_are_left_out() -> None:
    frames = sliding(12.0, 30)
    back = [Frame(frame.stamp_ns - 10 * FRAME_NS, frame.image) for frame in frames[20:]]

    kept: list[Frame] = []
    counts = select_keyframes(frames[:20] + back, kept.append)

    stamps = [frame.stamp_ns for frame in kept]
    assert counts.late == 10
    assert (np.diff(stamps) >= MILLISECOND).all()


def test_another_image_size_starts_with_a_keyframe() -> None:
    small = [cv2.resize(seen_at(40.0), (WIDTH // 2, HEIGHT // 2)) for _ in range(10)]
    chosen, _ = chosen_of(frames_of([seen_at(40.0)] * 10 + small))
    assert chosen == [0, 10]


def test_grey_frames_give_the_keyframes_of_coloured_ones() -> None:
    frames = sliding(7.0, 40)
    grey = [Frame(one.stamp_ns, cv2.cvtColor(one.image, cv2.COLOR_RGB2GRAY)) for one in frames]
    assert chosen_of(grey)[0] == chosen_of(frames)[0]


def test_large_frames_are_judged_as_small_ones() -> None:
    frames = sliding(12.0, 25)
    large = [Frame(one.stamp_ns, cv2.resize(one.image, (4 * WIDTH, 4 * HEIGHT))) for one in frames]
    gaps = np.diff(places_of(chosen_of(large)[0], 12.0))
    assert gaps.max() < LATEST * DUE + 1.0
    assert gaps.min() > EARLIEST * DUE - 1.0


def test_no_frames_give_no_keyframes() -> None:
    chosen, counts = chosen_of([])
    assert chosen == []
    assert counts.read == 0


def test_few_frames_are_held_at_a_time() -> None:
    alive: weakref.WeakSet[Frame] = weakref.WeakSet()
    most = 0

    def stream():  # noqa: ANN202
        nonlocal most
        for frame in frames_of_endless():
            alive.add(frame)
            most = max(most, len(alive))
            yield frame

    def frames_of_endless():  # noqa: ANN202
        for index in range(80):
            yield Frame(index * FRAME_NS, seen_at(5.0 * index))

    counts = select_keyframes(stream(), lambda _frame: None)

    assert counts.read == 80
    assert most <= NEIGHBOURS + 5


walks = st.lists(st.floats(-40.0, 40.0), min_size=1, max_size=25).map(
    lambda steps: np.clip(np.cumsum([800.0, *steps]), 0.0, 2800.0)
)


@settings(max_examples=15, deadline=None)
@given(walks, st.data())
def test_a_repeated_frame_never_makes_a_keyframe(places: np.ndarray, data: st.DataObject) -> None:
    repeats = data.draw(st.lists(st.integers(1, 3), min_size=len(places), max_size=len(places)))
    images = [
        seen_at(float(x)) for x, times in zip(places, repeats, strict=True) for _ in range(times)
    ]
    kept: list[Frame] = []

    select_keyframes(frames_of(images), kept.append)

    for before, after in pairwise(kept):
        assert (before.image != after.image).any()


@settings(max_examples=15, deadline=None)
@given(walks)
def test_a_repeated_run_chooses_the_same(places: np.ndarray) -> None:
    images = [seen_at(float(x)) for x in places]
    assert chosen_of(frames_of(images)) == chosen_of(frames_of(images))


@settings(max_examples=6, deadline=None)
@given(st.floats(8.0, 15.0), st.integers(2, 3))
def test_a_higher_frame_rate_does_not_multiply_keyframes(step: float, factor: int) -> None:
    count = int(300 / step)
    slow, _ = chosen_of(sliding(step, count))
    quick, _ = chosen_of(sliding(step / factor, count * factor))
    assert len(quick) <= LATEST / EARLIEST * len(slow) + 1


@settings(max_examples=10, deadline=None)
@given(walks)
def test_neighbouring_keyframes_of_a_slow_camera_overlap(places: np.ndarray) -> None:
    slow = np.interp(np.arange(0.0, len(places) - 0.99, 0.2), np.arange(len(places)), places)
    chosen, _ = chosen_of(frames_of(seen_at(float(x)) for x in slow))
    assert np.abs(np.diff(slow[chosen])).max(initial=0.0) < 2.0 * LATEST * DUE
