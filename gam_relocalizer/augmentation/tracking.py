# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Poses for every frame of a recording, two ways: each by itself, and by corrected odometry.

The second is the paper's application ("Application for Augmented Reality"): there ARKit tells the
motion at frame rate, and a fix every 10 s lays it on the map again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum, unique
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.capture.video import VideoFrames
from gam_relocalizer.errors import BagError, CameraError
from gam_relocalizer.localization.continuity import (
    Continuity,
    ContinuityOptions,
    is_odometry_of,
)
from gam_relocalizer.localization.odometry import OdometryTrack
from gam_relocalizer.mapping.progress import Progress, ignore_progress
from gam_relocalizer.replay.bag import NANOSECONDS, find_image_topic, open_bag
from gam_relocalizer.replay.messages import ODOMETRY, image_in, pose_in
from gam_relocalizer.replay.replay import ReplayOptions, replay_bag
from gam_relocalizer.replay.result import Attempt, OdometrySample

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.capture.keyframes import Frame
    from gam_relocalizer.localization.prior import Prior
    from gam_relocalizer.localization.result import LocalizationResult, Status
    from gam_relocalizer.replay.replay import Localizes

LOCALIZING = 'localizing frames'


@unique
class Way(Enum):
    """Where the pose of a frame comes from."""

    FRAME_BY_FRAME = 'frame_by_frame'
    ODOMETRY = 'odometry'


@dataclass(frozen=True)
class TrackedFrame:
    """A frame with what is known of where it was taken.

    Attributes:
        stamp_ns: When [ns].
        status: The verdict on the frame by itself.
        camera: The camera that took it; None when the frame could not be tried.
        by_itself: camera_from_map, when accepted.
        by_odometry: camera_from_map of corrected odometry, when there is any.
        truth: camera_from_map, when the recording tells.
    """

    stamp_ns: int
    status: Status
    camera: pycolmap.Camera | None = None
    by_itself: pycolmap.Rigid3d | None = None
    by_odometry: pycolmap.Rigid3d | None = None
    truth: pycolmap.Rigid3d | None = None

    def pose(self, way: Way) -> pycolmap.Rigid3d | None:
        """camera_from_map that way."""
        return self.by_itself if way is Way.FRAME_BY_FRAME else self.by_odometry


@dataclass(frozen=True)
class Track:
    """All frames of a recording.

    Attributes:
        frames: In the order of their stamps, which strictly increase.
        ways: What there are poses by.
        corrections: How often a fix corrected the odometry.
        image_topic: Where the frames come from; None for a video.
    """

    frames: tuple[TrackedFrame, ...]
    ways: tuple[Way, ...]
    corrections: int = 0
    image_topic: str | None = None

    @property
    def interval(self) -> float:
        """Median time between two frames [s]."""
        steps = [after.stamp_ns - before.stamp_ns for before, after in pairwise(self.frames)]
        return float(np.median(steps)) / NANOSECONDS if steps else 1.0


def track_bag(
    path: Path,
    localizer: Localizes,
    options: ReplayOptions,
    *,
    every: int = 1,
    correction_period: float = 10.0,
    progress: Progress = ignore_progress,
) -> Track:
    """Localizes the frames of a bag, each by itself, and carries odometry on if it has any.

    Args:
        path: The rosbag2.
        localizer: The localizer.
        options: Topics, frames and camera; odometry is used if its topic is named and the map is
            metric. The period is chosen here.
        every: Every so many frames are taken.
        correction_period: Seconds between the fixes that correct the odometry.
        progress: Told of the step `LOCALIZING`.

    Raises:
        BagError: The bag is damaged, or a topic is missing.
    """
    with open_bag(path) as bag:
        topic = find_image_topic(bag, options.image_topic).name
        stamps = [message.stamp_ns for message in bag.messages([topic])]
    watched = _Watched(localizer)
    cameras: list[pycolmap.Camera | None] = []
    total = -(-len(stamps) // every)

    def note(_attempt: Attempt, _share: float) -> None:
        cameras.append(watched.take_camera())
        progress(LOCALIZING, min(len(cameras), total), total)

    # without metres nothing is known beforehand, and so each frame stands by itself
    alone = replace(
        options,
        period=_period_of(stamps, every),
        odometry_topic=None,
        continuity=ContinuityOptions(metric=False),
    )
    attempts = replay_bag(path, watched, alone, note).attempts
    progress(LOCALIZING, total, total)
    mounts = _Mounts(attempts)
    frames = tuple(
        _frame_of(attempt, camera, mounts)
        for attempt, camera in zip(attempts, cameras, strict=True)
    )
    if not (options.odometry_topic and options.continuity.metric):
        return Track(frames, (Way.FRAME_BY_FRAME,), image_topic=topic)
    odometry = _read_odometry(path, options)
    carried = carry_on(odometry, attempts, options.continuity, correction_period)
    frames = tuple(
        replace(frame, by_odometry=mounts.camera_from_map(pose, frame.stamp_ns))
        for frame, pose in zip(frames, carried.map_from_base, strict=True)
    )
    return Track(frames, (Way.FRAME_BY_FRAME, Way.ODOMETRY), carried.corrections, topic)


def track_video(
    path: Path,
    localizer: Localizes,
    camera: pycolmap.Camera,
    *,
    every: int = 1,
    progress: Progress = ignore_progress,
) -> Track:
    """Localizes the frames of a video, each by itself.

    Args:
        path: The video file.
        localizer: The localizer.
        camera: Of the upright frames.
        every: Every so many frames are taken.
        progress: Told of the step `LOCALIZING`.

    Raises:
        VideoError: Missing, no video, or damaged from its start.
        CameraError: The camera is not of the size of the frames.
    """
    frames = []
    for frame in video_frames(path, every, progress):
        if (frame.image.shape[1], frame.image.shape[0]) != (camera.width, camera.height):
            msg = (
                f'{path}: frames are {frame.image.shape[1]} x {frame.image.shape[0]} pixels, but '
                f'the camera is {camera.width} x {camera.height}; give the camera of the upright '
                f'frames'
            )
            raise CameraError(msg)
        result = localizer.localize(frame.image, camera)
        frames.append(
            TrackedFrame(frame.stamp_ns, result.status, camera, by_itself=_accepted_pose(result))
        )
    return Track(tuple(frames), (Way.FRAME_BY_FRAME,))


def video_frames(path: Path, every: int, progress: Progress = ignore_progress) -> Iterator[Frame]:
    """Every so many frames of a video, RGB.

    Raises:
        VideoError: Missing, no video, or damaged from its start.
    """
    frames = VideoFrames(path, lambda _step, done, total: progress(LOCALIZING, done, total))
    return (frame for index, frame in enumerate(frames.frames()) if index % every == 0)


def bag_frames(path: Path, track: Track) -> Iterator[tuple[TrackedFrame, NDArray[np.uint8]]]:
    """The frames of a track from a bag that have an image that can be decoded: RGB or grey.

    Raises:
        BagError: The bag is damaged.
    """
    by_stamp = {frame.stamp_ns: frame for frame in track.frames if frame.camera is not None}
    with open_bag(path) as bag:
        for message in bag.messages([track.image_topic or '']):
            frame = by_stamp.pop(message.stamp_ns, None)
            if frame is not None:
                yield frame, image_in(message)


@dataclass(frozen=True)
class Carried:
    """Where the body was, by corrected odometry.

    Attributes:
        map_from_base: A pose for each attempt, or None while there is no correction.
        corrections: How often a fix corrected the odometry.
    """

    map_from_base: tuple[pycolmap.Rigid3d | None, ...]
    corrections: int


def carry_on(
    odometry: Sequence[OdometrySample],
    attempts: Sequence[Attempt],
    options: ContinuityOptions,
    period: float,
) -> Carried:
    """Lays the odometry on the newest correction, at the time of each attempt.

    A fix is taken when the last correction is older than the period, and of every frame while
    there is none: two fixes have to agree by the odometry before anything is believed
    (`Continuity`). Nothing is put right afterwards.

    Args:
        odometry: In the order of its stamps.
        attempts: Each frame by itself, in the order of their stamps.
        options: What is known about the robot and its map.
        period: Seconds between corrections.
    """
    track, continuity = OdometryTrack(), Continuity(options)
    samples = iter(odometry)
    poses: list[pycolmap.Rigid3d | None] = []
    seen: set[int] = set()
    newest = -1
    for attempt in attempts:
        # one sample beyond the frame, so that there is something to interpolate with
        while newest < attempt.stamp_ns and (sample := next(samples, None)) is not None:
            newest = sample.stamp_ns
            track.add(newest, sample.odom_from_base)
            continuity.add_odometry(newest, sample.odom_from_base)
        correction = continuity.correction
        due = correction is None or attempt.stamp_ns - correction.stamp_ns >= period * NANOSECONDS
        if due and attempt.robot_pose is not None:
            continuity.judge(attempt.stamp_ns, attempt.result, attempt.robot_pose)
            correction = continuity.correction
        reading = track.at(attempt.stamp_ns)
        if correction is None or reading is None:
            poses.append(None)
            continue
        seen.add(correction.stamp_ns)
        poses.append(correction.map_from_odom * reading.odom_from_base)
    return Carried(tuple(poses), len(seen))


class _Watched:
    """A localizer that remembers the camera of the image that it was given last."""

    def __init__(self, localizer: Localizes) -> None:
        self._localizer = localizer
        self._camera: pycolmap.Camera | None = None

    def localize(
        self, image: NDArray[np.uint8], camera: pycolmap.Camera, prior: Prior | None = None
    ) -> LocalizationResult:
        """See `Localizes`."""
        self._camera = camera
        return self._localizer.localize(image, camera, prior)

    def take_camera(self) -> pycolmap.Camera | None:
        """None when no image was given since the last time."""
        camera, self._camera = self._camera, None
        return camera


class _Mounts:
    """base_from_camera as it was at the accepted frames; at others, as at the nearest of them."""

    def __init__(self, attempts: Sequence[Attempt]) -> None:
        accepted = [
            (attempt.stamp_ns, attempt.robot_pose.map_from_base, attempt.result.estimate)
            for attempt in attempts
            if attempt.robot_pose is not None
        ]
        self._mounts = {
            stamp_ns: map_from_base.inverse() * estimate.camera_from_map.inverse()
            for stamp_ns, map_from_base, estimate in accepted
            if estimate is not None
        }
        self._stamps = np.array(list(self._mounts), np.int64)

    def camera_from_map(
        self, map_from_base: pycolmap.Rigid3d | None, stamp_ns: int
    ) -> pycolmap.Rigid3d | None:
        """None when the pose of the body is not known, or no mount at all."""
        if map_from_base is None or not len(self._stamps):
            return None
        nearest = int(self._stamps[np.argmin(np.abs(self._stamps - stamp_ns))])
        return (map_from_base * self._mounts[nearest]).inverse()


def _frame_of(attempt: Attempt, camera: pycolmap.Camera | None, mounts: _Mounts) -> TrackedFrame:
    return TrackedFrame(
        attempt.stamp_ns,
        attempt.result.status,
        camera,
        by_itself=_accepted_pose(attempt.result),
        truth=mounts.camera_from_map(attempt.truth, attempt.stamp_ns),
    )


def _accepted_pose(result: LocalizationResult) -> pycolmap.Rigid3d | None:
    if not result.accepted or result.estimate is None:
        return None
    return result.estimate.camera_from_map


def _period_of(stamps: Sequence[int], every: int) -> float:
    """Seconds that let every so many frames pass, though they do not come quite evenly."""
    if every == 1 or len(stamps) < 2:
        return 0.0
    return max(0.0, (every - 0.5) * float(np.median(np.diff(np.sort(stamps)))) / NANOSECONDS)


def _read_odometry(path: Path, options: ReplayOptions) -> list[OdometrySample]:
    """The odometry of the body, without stragglers."""
    samples: list[OdometrySample] = []
    with open_bag(path) as bag:
        topic = bag.require(options.odometry_topic or '', (ODOMETRY,), '--odom-topic')
        for message in bag.messages([topic.name]):
            if not is_odometry_of(message.value.child_frame_id, options.base_frame):
                msg = (
                    f'{topic}: odometry of `{message.value.child_frame_id}`, not of '
                    f'`{options.base_frame}` (--base-frame)'
                )
                raise BagError(msg)
            if not samples or message.stamp_ns > samples[-1].stamp_ns:
                samples.append(OdometrySample(message.stamp_ns, pose_in(message)))
    return samples
