# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Poses for every frame: alone, and by odometry that fixes correct."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from recorded_drive import (
    KnowingLocalizer,
    camera_from_map_at,
    fill_with_odometry,
    map_from_base_at,
    stamp_of,
    write_bag,
)

from gam_relocalizer.augmentation.tracking import Way, bag_frames, carry_on, track_bag, track_video
from gam_relocalizer.augmentation.video import video_file
from gam_relocalizer.cameras import parse_camera
from gam_relocalizer.errors import BagError, CameraError
from gam_relocalizer.geometry import pose_error
from gam_relocalizer.localization.continuity import ContinuityOptions
from gam_relocalizer.localization.result import LocalizationResult, Status
from gam_relocalizer.localization.robot_pose import RobotPose
from gam_relocalizer.replay.replay import ReplayOptions
from gam_relocalizer.replay.result import Attempt, OdometrySample

if TYPE_CHECKING:
    from pathlib import Path

    import pycolmap

    from gam_relocalizer.scene_map import SceneMap

OPTIONS = ReplayOptions(odometry_topic='/odom', truth_topic='/ground_truth')


@pytest.fixture(scope='module')
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_bag(tmp_path_factory.mktemp('tracking') / 'bag', fill_with_odometry)


def assert_equal_poses(found: pycolmap.Rigid3d | None, expected: pycolmap.Rigid3d) -> None:
    assert found is not None
    error = pose_error(found, expected)
    assert error.position < 1e-6
    assert error.rotation_deg < 1e-4


def test_each_frame_stands_by_itself_and_odometry_goes_on_where_it_fails(
    drive: Path, wall_map: SceneMap
) -> None:
    localizer = KnowingLocalizer(wall_map.points, refuse=[20, 21, 22])
    track = track_bag(drive, localizer, OPTIONS, correction_period=3.0)
    assert track.ways == (Way.FRAME_BY_FRAME, Way.ODOMETRY)
    assert [frame.stamp_ns for frame in track.frames] == [stamp_of(index) for index in range(100)]
    assert track.interval == pytest.approx(0.1)
    for index, frame in enumerate(track.frames):
        expected = camera_from_map_at(index)
        assert_equal_poses(frame.truth, expected)
        if index in (20, 21, 22):
            assert frame.by_itself is None
            assert frame.status is Status.TOO_FEW_INLIERS
        else:
            assert_equal_poses(frame.by_itself, expected)
        if index:
            assert_equal_poses(frame.by_odometry, expected)
    # one fix alone corrects nothing
    assert track.frames[0].by_odometry is None
    assert track.corrections == 4


def test_wrong_fix_shows_by_itself_and_does_not_move_the_odometry(
    drive: Path, wall_map: SceneMap
) -> None:
    localizer = KnowingLocalizer(wall_map.points)
    localizer.mistaken = {31: 99}
    track = track_bag(drive, localizer, OPTIONS, correction_period=0.0)
    assert_equal_poses(track.frames[31].by_itself, camera_from_map_at(99))
    assert_equal_poses(track.frames[31].by_odometry, camera_from_map_at(31))


def test_every_third_frame_can_be_taken(drive: Path, wall_map: SceneMap) -> None:
    track = track_bag(drive, KnowingLocalizer(wall_map.points), OPTIONS, every=3)
    assert [frame.stamp_ns for frame in track.frames] == [
        stamp_of(index) for index in range(0, 100, 3)
    ]


def test_map_that_is_not_metric_leaves_odometry_out(drive: Path, wall_map: SceneMap) -> None:
    options = replace(OPTIONS, continuity=ContinuityOptions(metric=False))
    track = track_bag(drive, KnowingLocalizer(wall_map.points), options, every=20)
    assert track.ways == (Way.FRAME_BY_FRAME,)


def test_frames_come_back_with_their_images(drive: Path, wall_map: SceneMap) -> None:
    track = track_bag(drive, KnowingLocalizer(wall_map.points), OPTIONS, every=10)
    found = [(frame.stamp_ns, int(image.mean())) for frame, image in bag_frames(drive, track)]
    assert found == [(stamp_of(index), index) for index in range(0, 100, 10)]


def test_odometry_of_another_body_is_refused(drive: Path, wall_map: SceneMap) -> None:
    options = replace(OPTIONS, base_frame='', truth_topic=None, base_from_camera=None)
    with pytest.raises(BagError, match='base_link'):
        track_bag(drive, KnowingLocalizer(wall_map.points), options, every=50)


def attempt_at(index: int) -> Attempt:
    found = LocalizationResult(Status.ACCEPTED)
    pose = RobotPose(map_from_base_at(index), 1e-6 * np.eye(6))
    return Attempt(stamp_of(index), found, pose)


def test_drift_grows_for_one_period_and_is_then_taken_out() -> None:
    samples = []
    for index in range(400):
        pose = map_from_base_at(index)
        pose.translation = 1.03 * pose.translation
        samples.append(OdometrySample(stamp_of(index), pose))
    attempts = [attempt_at(index) for index in range(400)]
    carried = carry_on(samples, attempts, ContinuityOptions(), 10.0)
    assert carried.map_from_base[0] is None
    errors = [
        0.0
        if pose is None
        else pose_error(pose.inverse(), map_from_base_at(index).inverse()).position
        for index, pose in enumerate(carried.map_from_base)
    ]
    assert carried.corrections == 4
    corrected_at = [
        index for index in range(2, 400) if errors[index] < 0.01 and errors[index - 1] > 0.015
    ]
    assert corrected_at == [101, 201, 301]
    assert max(errors) > 0.02


def test_video_is_localized_frame_by_frame_and_its_camera_must_fit(
    tmp_path: Path, wall_map: SceneMap
) -> None:
    file = tmp_path / 'walk.webm'
    with video_file(file, 10.0) as video:
        for index in range(12):
            video.write(np.full((48, 64, 3), 10 * index, np.uint8))
    camera = parse_camera('PINHOLE 64 48 60 60 32 24')
    track = track_video(file, KnowingLocalizer(wall_map.points), camera, every=2)
    assert len(track.frames) == 6
    assert track.interval == pytest.approx(0.2)
    assert track.ways == (Way.FRAME_BY_FRAME,)
    with pytest.raises(CameraError, match='64 x 48'):
        track_video(
            file, KnowingLocalizer(wall_map.points), parse_camera('PINHOLE 48 64 60 60 24 32')
        )
