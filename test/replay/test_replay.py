# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from recorded_drive import (
    BASE_FROM_CAMERA,
    FOCAL,
    HEIGHT,
    SECOND,
    WIDTH,
    BagWriter,
    KnowingLocalizer,
    camera_from_map_at,
    fill_drive,
    fill_with_odometry,
    map_from_base_at,
    stamp_of,
    write_bag,
)
from scipy.spatial.transform import Rotation

from gam_relocalizer.cameras import parse_camera
from gam_relocalizer.errors import BagError, UsageError
from gam_relocalizer.geometry import pose_error, rigid3d_from_rotation
from gam_relocalizer.localization.continuity import ContinuityOptions
from gam_relocalizer.localization.result import Status
from gam_relocalizer.replay.messages import POSE_TYPES
from gam_relocalizer.replay.replay import (
    REFUSED_SHOWN,
    WORST_SHOWN,
    ReplayOptions,
    replay_bag,
)

if TYPE_CHECKING:
    from pathlib import Path

    import pycolmap

    from gam_relocalizer.replay.result import Attempt, Replay

MOUNTED = ReplayOptions(period=0.0, base_from_camera=BASE_FROM_CAMERA)


def assert_same_pose(found: pycolmap.Rigid3d, truth: pycolmap.Rigid3d) -> None:
    error = pose_error(found.inverse(), truth.inverse())
    assert error.position < 1e-9
    assert error.rotation_deg < 1e-6


def replay_of(
    path: Path,
    fill: Any,  # noqa: ANN401
    localizer: KnowingLocalizer,
    options: ReplayOptions = MOUNTED,
) -> Replay:
    return replay_bag(write_bag(path / 'bag', fill), localizer, options)


def test_poses_are_of_the_base_through_late_static_transforms(
    drive: Path, localizer: KnowingLocalizer
) -> None:
    replay = replay_bag(drive, localizer, ReplayOptions(period=1.0))
    assert [attempt.stamp_ns for attempt in replay.attempts] == [
        stamp_of(index) for index in range(0, 100, 10)
    ]
    for index, attempt in zip(range(0, 100, 10), replay.attempts, strict=True):
        assert attempt.robot_pose is not None
        assert_same_pose(attempt.robot_pose.map_from_base, map_from_base_at(index))


def test_without_base_frame_poses_are_of_the_camera(
    mcap_drive: Path, localizer: KnowingLocalizer
) -> None:
    replay = replay_bag(mcap_drive, localizer, ReplayOptions(period=2.0, base_frame=''))
    for index, attempt in zip(localizer.seen, replay.attempts, strict=True):
        assert attempt.robot_pose is not None
        assert_same_pose(attempt.robot_pose.map_from_base, camera_from_map_at(index).inverse())


@pytest.mark.parametrize(
    ('period', 'expected'),
    [
        (0.0, list(range(100))),
        (0.1, list(range(100))),
        (0.15, list(range(0, 100, 2))),
        (2.0, [0, 20, 40, 60, 80]),
        (3600.0, [0]),
    ],
)
def test_tries_the_first_image_of_every_period(
    mcap_drive: Path, localizer: KnowingLocalizer, period: float, expected: list[int]
) -> None:
    replay_bag(mcap_drive, localizer, ReplayOptions(period=period))
    assert localizer.seen == expected


def test_stamps_strictly_increase_when_images_come_twice_or_late(
    tmp_path: Path, localizer: KnowingLocalizer
) -> None:
    def fill(bag: BagWriter) -> None:
        bag.camera_info(0)
        for index in (0, 1, 1, 3, 2, 4):
            bag.image(index)

    stamps = [a.stamp_ns for a in replay_of(tmp_path, fill, localizer).attempts]
    assert stamps == sorted(set(stamps))


def test_compressed_images_are_read(tmp_path: Path, localizer: KnowingLocalizer) -> None:
    def fill(bag: BagWriter) -> None:
        for index in range(3):
            bag.compressed_image(index)
            bag.camera_info(index)

    replay = replay_of(tmp_path, fill, localizer)
    assert localizer.seen == [0, 1, 2]
    assert all(attempt.result.accepted for attempt in replay.attempts)


def test_camera_comes_from_camera_info(mcap_drive: Path, localizer: KnowingLocalizer) -> None:
    replay_bag(mcap_drive, localizer, ReplayOptions(period=20.0))
    (camera,) = localizer.cameras
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    np.testing.assert_allclose(
        camera.calibration_matrix(), [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]
    )


def test_given_camera_needs_no_camera_info(tmp_path: Path, localizer: KnowingLocalizer) -> None:
    camera = parse_camera(f'PINHOLE {WIDTH} {HEIGHT} 50 51 32 24')
    options = ReplayOptions(camera=camera, base_frame='')
    replay_of(tmp_path, lambda bag: bag.image(0), localizer, options)
    assert localizer.cameras == [camera]


def test_calibration_that_changes_on_the_way_is_followed(
    tmp_path: Path, localizer: KnowingLocalizer
) -> None:
    def fill(bag: BagWriter) -> None:
        for index in range(6):
            bag.image(index)
            bag.camera_info(index, focal=FOCAL if index < 3 else 2 * FOCAL)

    replay_of(tmp_path, fill, localizer)
    assert [camera.focal_length_x for camera in localizer.cameras] == [FOCAL] * 3 + [2 * FOCAL] * 3


def test_missing_camera_info_lists_topics(tmp_path: Path, localizer: KnowingLocalizer) -> None:
    with pytest.raises(BagError, match=r'/camera/image .*Image'):
        replay_of(tmp_path, lambda bag: bag.image(0), localizer)


def only_attempt(replay: Replay) -> Attempt:
    (attempt,) = replay.attempts
    assert attempt.robot_pose is None
    return attempt


def test_silent_camera_info_is_no_calibration(tmp_path: Path, localizer: KnowingLocalizer) -> None:
    def fill(bag: BagWriter) -> None:
        bag.topic('/camera/camera_info', 'sensor_msgs/msg/CameraInfo')
        bag.image(0)

    attempt = only_attempt(replay_of(tmp_path, fill, localizer))
    assert attempt.result.status is Status.NO_CALIBRATION


def test_uncalibrated_camera_is_no_calibration(tmp_path: Path, localizer: KnowingLocalizer) -> None:
    def fill(bag: BagWriter) -> None:
        bag.camera_info(0, focal=0.0)
        bag.image(0)

    attempt = only_attempt(replay_of(tmp_path, fill, localizer))
    assert attempt.result.status is Status.NO_CALIBRATION


@pytest.mark.parametrize(
    'changes',
    [{'encoding': '32FC1'}, {'data': np.zeros(10, dtype=np.uint8)}, {'width': 0}, {'step': 1}],
)
def test_undecodable_image_is_an_attempt_with_that_status(
    tmp_path: Path, localizer: KnowingLocalizer, changes: dict[str, Any]
) -> None:
    def fill(bag: BagWriter) -> None:
        bag.camera_info(0)
        bag.image(0, **changes)

    attempt = only_attempt(replay_of(tmp_path, fill, localizer))
    assert attempt.result.status is Status.UNDECODABLE_IMAGE
    assert '/camera/image' in attempt.result.reason


def test_unknown_mount_is_no_transform(tmp_path: Path, localizer: KnowingLocalizer) -> None:
    def fill(bag: BagWriter) -> None:
        bag.camera_info(0)
        bag.image(0)
        bag.transform('base_link', 'lidar', BASE_FROM_CAMERA, stamp_of(0))

    attempt = only_attempt(replay_of(tmp_path, fill, localizer, ReplayOptions()))
    assert attempt.result.status is Status.NO_TRANSFORM
    assert 'camera_optical' in attempt.result.reason
    assert localizer.seen == []


def mast_at(stamp_ns: int) -> pycolmap.Rigid3d:
    """A mast that turns and rises steadily."""
    seconds = (stamp_ns - stamp_of(0)) / SECOND
    return rigid3d_from_rotation(Rotation.from_euler('z', 0.3 * seconds), [0.0, 0.0, seconds])


def test_moving_mount_is_interpolated_at_the_stamp_of_the_image(
    tmp_path: Path, localizer: KnowingLocalizer
) -> None:
    def fill(bag: BagWriter) -> None:
        bag.transform('mast', 'camera_optical', BASE_FROM_CAMERA, stamp_of(0))
        for index in range(20):
            between = stamp_of(index) - SECOND // 30
            bag.transform('base_link', 'mast', mast_at(between), between, topic='/tf')
            bag.image(index)
            bag.camera_info(index)

    replay = replay_of(tmp_path, fill, localizer, ReplayOptions(period=0.0))
    known = replay.attempts[:-1]
    for index, attempt in enumerate(known):
        base_from_camera = mast_at(stamp_of(index)) * BASE_FROM_CAMERA
        map_from_base = (base_from_camera * camera_from_map_at(index)).inverse()
        assert attempt.robot_pose is not None
        assert_same_pose(attempt.robot_pose.map_from_base, map_from_base)
    assert replay.attempts[-1].result.status is Status.NO_TRANSFORM  # nothing is extrapolated


def test_broken_transform_of_another_branch_is_left_out(
    tmp_path: Path, localizer: KnowingLocalizer
) -> None:
    def fill(bag: BagWriter) -> None:
        fill_drive(bag, images=8)
        broken = rigid3d_from_rotation(Rotation.identity(), [np.nan, 0.0, 0.0])
        bag.transform('base_link', 'wheel', broken, stamp_of(8))

    replay = replay_of(tmp_path, fill, localizer, ReplayOptions())
    assert all(attempt.result.accepted for attempt in replay.attempts)


def test_refused_image_has_no_pose_and_keeps_its_reason(
    mcap_drive: Path, localizer: KnowingLocalizer
) -> None:
    localizer.refuse = [20]
    replay = replay_bag(mcap_drive, localizer, ReplayOptions(period=1.0))
    refused = [attempt for attempt in replay.attempts if not attempt.result.accepted]
    assert [attempt.stamp_ns for attempt in refused] == [stamp_of(20)]
    assert refused[0].robot_pose is None
    assert refused[0].result.reason


def test_truth_is_interpolated_at_the_stamp(tmp_path: Path, localizer: KnowingLocalizer) -> None:
    def fill(bag: BagWriter) -> None:
        for index in range(10):
            bag.image(index)
            bag.camera_info(index)
            if index % 2:
                bag.truth(index)

    options = ReplayOptions(period=0.0, base_frame='', truth_topic='/ground_truth')
    attempts = replay_of(tmp_path, fill, localizer, options).attempts
    assert attempts[0].truth is None
    for index in range(1, 10):
        truth = attempts[index].truth
        assert truth is not None
        error = pose_error(truth.inverse(), map_from_base_at(index).inverse())
        assert error.position < 1e-3
        assert error.rotation_deg < 1e-3


@pytest.mark.parametrize('msgtype', POSE_TYPES)
def test_truth_may_be_of_any_pose_type(
    tmp_path: Path, localizer: KnowingLocalizer, msgtype: str
) -> None:
    def fill(bag: BagWriter) -> None:
        bag.image(3)
        bag.camera_info(3)
        bag.truth(3, msgtype=msgtype)

    options = ReplayOptions(base_frame='', truth_topic='/ground_truth')
    (attempt,) = replay_of(tmp_path, fill, localizer, options).attempts
    assert attempt.truth is not None
    assert_same_pose(attempt.truth, map_from_base_at(3))


def test_a_fix_that_odometry_speaks_against_is_held_back(
    tmp_path: Path, localizer: KnowingLocalizer
) -> None:
    localizer.mistaken = {30: 99}
    options = ReplayOptions(period=1.0, odometry_topic='/odom')
    attempts = replay_of(tmp_path, fill_with_odometry, localizer, options).attempts
    for index, attempt in zip(range(0, 100, 10), attempts, strict=True):
        held = index == 30
        assert attempt.result.status is (Status.IMPLAUSIBLE if held else Status.ACCEPTED)
        assert (attempt.robot_pose is None) == held


def test_without_the_topic_odometry_has_no_say(tmp_path: Path, localizer: KnowingLocalizer) -> None:
    localizer.mistaken = {30: 99}
    replay = replay_of(tmp_path, fill_with_odometry, localizer, ReplayOptions(period=1.0))
    assert all(attempt.result.accepted for attempt in replay.attempts)


def test_odometry_tells_the_localizer_where_to_look_first(
    tmp_path: Path, localizer: KnowingLocalizer
) -> None:
    options = ReplayOptions(period=3.0, odometry_topic='/odom')
    replay_of(tmp_path, fill_with_odometry, localizer, options)
    assert localizer.priors[0] is not None
    assert localizer.priors[0].hint is None
    for index, prior in zip(localizer.seen[1:], localizer.priors[1:], strict=True):
        assert prior is not None
        assert prior.hint is not None
        map_from_camera = camera_from_map_at(index).inverse()
        np.testing.assert_allclose(prior.hint.position, map_from_camera.translation, atol=1e-6)


def test_odometry_comes_back_whole_and_corrected_by_fixes_that_agree(
    tmp_path: Path, localizer: KnowingLocalizer
) -> None:
    localizer.mistaken = {0: 99, 60: 99}
    options = ReplayOptions(period=1.0, odometry_topic='/odom', truth_topic='/ground_truth')
    replay = replay_of(tmp_path, fill_with_odometry, localizer, options)
    assert [sample.stamp_ns for sample in replay.odometry] == [stamp_of(i) for i in range(100)]
    for index, sample in enumerate(replay.odometry):
        assert sample.truth is not None
        assert_same_pose(sample.truth, map_from_base_at(index))
    # the first is wrong; the next is held back, and confirmed by the one after
    corrections = [attempt.correction for attempt in replay.attempts]
    assert corrections[:2] == [None, None]
    for correction in corrections[2:]:
        assert correction is not None
        assert_same_pose(
            correction.map_from_odom * replay.odometry[42].odom_from_base, map_from_base_at(42)
        )
    newest = [correction.stamp_ns for correction in corrections if correction is not None]
    assert newest == [stamp_of(i) for i in (20, 30, 40, 50, 50, 70, 80, 90)]


def test_in_a_map_without_metres_odometry_is_left_out(
    tmp_path: Path, localizer: KnowingLocalizer
) -> None:
    options = ReplayOptions(
        period=1.0, odometry_topic='/odom', continuity=ContinuityOptions(metric=False)
    )
    replay = replay_of(tmp_path, fill_with_odometry, localizer, options)
    assert replay.odometry == ()
    assert {attempt.correction for attempt in replay.attempts} == {None}


def test_odometry_of_another_body_is_refused(tmp_path: Path, localizer: KnowingLocalizer) -> None:
    def fill(bag: BagWriter) -> None:
        bag.odometry(0, child_frame='trailer')
        fill_drive(bag, images=8)

    with pytest.raises(BagError, match='trailer'):
        replay_of(tmp_path, fill, localizer, ReplayOptions(odometry_topic='/odom'))


def test_a_topic_that_holds_no_odometry_is_refused(
    mcap_drive: Path, localizer: KnowingLocalizer
) -> None:
    with pytest.raises(BagError, match=r'--odom-topic.*nav_msgs/msg/Odometry'):
        replay_bag(mcap_drive, localizer, ReplayOptions(odometry_topic='/ground_truth'))


@pytest.mark.parametrize('period', [-1.0, float('nan'), float('inf')])
def test_period_that_is_no_time_is_refused(period: float) -> None:
    with pytest.raises(UsageError):
        ReplayOptions(period=period)


def test_map_frame_without_a_name_is_refused() -> None:
    with pytest.raises(UsageError):
        ReplayOptions(map_frame='')


def test_truth_in_another_frame_is_refused(tmp_path: Path, localizer: KnowingLocalizer) -> None:
    def fill(bag: BagWriter) -> None:
        bag.image(0)
        bag.camera_info(0)
        bag.truth(0, frame='odom')

    with pytest.raises(BagError, match='odom'):
        replay_of(tmp_path, fill, localizer, ReplayOptions(truth_topic='/ground_truth'))


def test_missing_truth_lists_topics(mcap_drive: Path, localizer: KnowingLocalizer) -> None:
    with pytest.raises(BagError, match=r'/truth .*--truth-topic.*/ground_truth'):
        replay_bag(mcap_drive, localizer, ReplayOptions(truth_topic='/truth'))


def shown_in(replay: Replay) -> list[int]:
    """Which images are kept, by their index."""
    for timed in replay.illustrations:
        assert stamp_of(int(timed.illustration.image[0, 0])) == timed.stamp_ns
    return [int(timed.illustration.image[0, 0]) for timed in replay.illustrations]


def test_best_image_and_those_with_fewest_inliers_are_kept(
    mcap_drive: Path, localizer: KnowingLocalizer
) -> None:
    replay = replay_bag(mcap_drive, localizer, ReplayOptions(period=1.0))
    by_inliers = sorted(range(0, 100, 10), key=lambda index: index % 7)
    best, *worst = shown_in(replay)
    assert best % 7 == by_inliers[-1] % 7
    assert [index % 7 for index in worst] == [index % 7 for index in by_inliers[:WORST_SHOWN]]


def test_images_with_the_largest_errors_are_kept_where_the_truth_is_known(
    mcap_drive: Path, localizer: KnowingLocalizer
) -> None:
    localizer.mistaken = {30: 25, 50: 58, 70: 69}
    options = ReplayOptions(period=1.0, truth_topic='/ground_truth')
    _, *worst = shown_in(replay_bag(mcap_drive, localizer, options))
    assert worst[:3] == [50, 30, 70]


def test_refused_images_are_kept_with_their_rejected_pose_but_not_all(
    mcap_drive: Path, localizer: KnowingLocalizer
) -> None:
    localizer.doubt = [0, 10, 20, 30, 40, 50]
    replay = replay_bag(mcap_drive, localizer, ReplayOptions(period=1.0))
    by_inliers = sorted(localizer.doubt, key=lambda index: -(index % 7))
    assert shown_in(replay)[-REFUSED_SHOWN:] == by_inliers[:REFUSED_SHOWN]
    assert len(replay.illustrations) <= 1 + WORST_SHOWN + REFUSED_SHOWN


def test_progress_is_told_of_every_attempt(mcap_drive: Path, localizer: KnowingLocalizer) -> None:
    told: list[tuple[int, float]] = []
    replay = replay_bag(
        mcap_drive,
        localizer,
        ReplayOptions(period=1.0),
        lambda attempt, share: told.append((attempt.stamp_ns, share)),
    )
    assert [stamp for stamp, _ in told] == [attempt.stamp_ns for attempt in replay.attempts]
    shares = [share for _, share in told]
    assert shares == sorted(shares)
    assert 0.0 <= shares[0] <= shares[-1] <= 1.0
