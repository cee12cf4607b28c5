# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Runs the localizer over a bag the way the node runs over live topics."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol

from gam_relocalizer.cameras import camera_from_calibration
from gam_relocalizer.errors import BagError, CameraError, ImageError, TransformError, UsageError
from gam_relocalizer.localization.continuity import (
    Continuity,
    ContinuityOptions,
    is_odometry_of,
)
from gam_relocalizer.localization.pictures import Foremost, Illustration
from gam_relocalizer.localization.result import LocalizationResult, Status
from gam_relocalizer.localization.robot_pose import CovarianceOptions, robot_pose
from gam_relocalizer.replay.bag import (
    CAMERA_INFO,
    NANOSECONDS,
    find_camera_info_topic,
    find_image_topic,
    open_bag,
)
from gam_relocalizer.replay.messages import (
    ODOMETRY,
    POSE_TYPES,
    add_transforms,
    calibration_in,
    image_in,
    pose_in,
)
from gam_relocalizer.replay.result import Attempt, OdometrySample, Replay, TimedIllustration
from gam_relocalizer.replay.summary import row_of
from gam_relocalizer.transforms import TransformTree

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    import numpy as np
    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.cameras import CameraCalibration
    from gam_relocalizer.localization.prior import Prior
    from gam_relocalizer.replay.bag import Bag, BagMessage, Topic

TF = '/tf'
TF_STATIC = '/tf_static'

# A transform or odometry for the time of an image may be recorded a little after the image.
DELAY_NS = NANOSECONDS

# So many images of each kind are kept for pictures.
WORST_SHOWN = 3
REFUSED_SHOWN = 3


class Localizes(Protocol):
    """What a replay needs of a localizer."""

    def localize(
        self, image: NDArray[np.uint8], camera: pycolmap.Camera, prior: Prior | None = None
    ) -> LocalizationResult:
        """Finds the camera's pose; always a result."""


@dataclass(frozen=True)
class ReplayOptions:
    """How to replay.

    Attributes:
        period: Seconds between attempts, by the stamps of the images; 0 takes every image.
        base_frame: The body whose pose is wanted; empty for the camera itself.
        map_frame: Frame of the poses, and the one that the truth must be in.
        base_from_camera: The mount of the camera; without it the bag's transforms tell.
        camera: The camera; without it the bag's CameraInfo tells.
        image_topic: Needed only when the bag has several.
        camera_info_topic: Needed only when it is not beside the image topic.
        odometry_topic: Odometry of the body, to compare the fixes with and to be corrected by them.
        truth_topic: Poses of the body in the map frame to compare with.
        image_is_rectified: The images are rectified: use P of the CameraInfo, no distortion.
        covariance: Scales and floors of the covariance.
        continuity: What is known about the robot and its map.

    Raises:
        UsageError: On construction: a period that is no time, or a map frame without a name.
    """

    period: float = 2.0
    base_frame: str = 'base_link'
    map_frame: str = 'map'
    base_from_camera: pycolmap.Rigid3d | None = None
    camera: pycolmap.Camera | None = None
    image_topic: str | None = None
    camera_info_topic: str | None = None
    odometry_topic: str | None = None
    truth_topic: str | None = None
    image_is_rectified: bool = False
    covariance: CovarianceOptions = field(default_factory=CovarianceOptions)
    continuity: ContinuityOptions = field(default_factory=ContinuityOptions)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.period) and self.period >= 0.0):
            msg = f'period is {self.period}; expected seconds, 0 or more'
            raise UsageError(msg)
        if not self.map_frame:
            msg = 'the map frame has no name; expected one, such as `map`'
            raise UsageError(msg)


def replay_bag(
    path: Path,
    localizer: Localizes,
    options: ReplayOptions,
    progress: Callable[[Attempt, float], None] = lambda _attempt, _share: None,
) -> Replay:
    """Localizes the images of a bag that are due.

    Args:
        path: The bag.
        localizer: The localizer.
        options: How to replay.
        progress: Called after each attempt with the share of the bag that is done, 0 to 1.

    Raises:
        BagError: The bag is damaged, or a topic is missing.
    """
    with open_bag(path) as bag, open_bag(path) as motion_bag:
        topic = find_image_topic(bag, options.image_topic)
        facts = _read_facts(bag, topic, options)
        continuity = Continuity(options.continuity)
        motion = _Motion(motion_bag, facts, continuity, options)
        begin_ns, end_ns = bag.time_range
        throttle, illustrations = _Throttle(options.period), _Illustrations()
        attempts: list[Attempt] = []
        for message in bag.messages([topic.name]):
            if not throttle.is_due(message.stamp_ns):
                continue
            motion.advance_to(message.log_ns + DELAY_NS)
            attempt = _attempt(message, localizer, options, facts, continuity, illustrations)
            attempt = replace(attempt, correction=continuity.correction)
            attempts.append(attempt)
            progress(attempt, (message.log_ns - begin_ns) / (end_ns - begin_ns))
        motion.advance_to(end_ns)
    return Replay(
        tuple(attempts), topic.name, topic.count, illustrations.chosen(), tuple(motion.odometry)
    )


class _Throttle:
    """Lets an image pass when a period has gone by since the last one that passed."""

    def __init__(self, period: float) -> None:
        self._period_ns = max(1, round(period * NANOSECONDS))
        self._last_ns: int | None = None

    def is_due(self, stamp_ns: int) -> bool:
        if self._last_ns is not None and stamp_ns < self._last_ns + self._period_ns:
            return False
        self._last_ns = stamp_ns
        return True


@dataclass(frozen=True)
class _Facts:
    """What the small topics of a bag say.

    Attributes:
        calibrations: Stamp and numbers of the CameraInfo, each time they change.
        transforms: The tree of /tf_static; /tf is added while the images pass.
        truth: The body's poses, as a tree with one edge from the body to the map frame.
    """

    calibrations: list[tuple[int, CameraCalibration]] = field(default_factory=list)
    transforms: TransformTree = field(default_factory=TransformTree)
    truth: TransformTree = field(default_factory=lambda: TransformTree(history_ns=2**63))

    def calibration_at(self, stamp_ns: int) -> CameraCalibration:
        """The newest at that time; before the first one, the first.

        Raises:
            CameraError: There is none.
        """
        if not self.calibrations:
            msg = 'the bag holds no CameraInfo message; give the camera with --camera'
            raise CameraError(msg)
        newer = bisect_right(self.calibrations, stamp_ns, key=lambda entry: entry[0])
        return self.calibrations[max(0, newer - 1)][1]

    def truth_at(self, stamp_ns: int, options: ReplayOptions) -> pycolmap.Rigid3d | None:
        """map_from_base, when the bag tells."""
        try:
            return self.truth.lookup(options.map_frame, _truth_frame(options), stamp_ns)
        except TransformError:
            return None


def _read_facts(bag: Bag, image_topic: Topic, options: ReplayOptions) -> _Facts:
    """Reads the small topics once, before the images: they may come late in a recording."""
    topics = [TF_STATIC]
    if options.camera is None:
        info = find_camera_info_topic(bag, image_topic.name, options.camera_info_topic)
        topics.append(info.name)
    if options.truth_topic:
        topics.append(bag.require(options.truth_topic, POSE_TYPES, '--truth-topic').name)
    facts = _Facts()
    for message in bag.messages(topics):
        if message.topic.name == TF_STATIC:
            add_transforms(facts.transforms, message, static=True)
        elif message.topic.type == CAMERA_INFO:
            calibration = calibration_in(message)
            if not facts.calibrations or facts.calibrations[-1][1] != calibration:
                facts.calibrations.append((message.stamp_ns, calibration))
        else:
            _add_truth(facts.truth, message, options)
    return facts


def _truth_frame(options: ReplayOptions) -> str:
    return f'truth of {options.base_frame}'


def _add_truth(truth: TransformTree, message: BagMessage, options: ReplayOptions) -> None:
    frame = message.value.header.frame_id.strip('/')
    if frame != options.map_frame:
        msg = (
            f'{message.topic}: poses are in frame `{frame}`, the map is `{options.map_frame}`; '
            f'they can be compared in one frame only (--map-frame)'
        )
        raise BagError(msg)
    truth.add(frame, _truth_frame(options), pose_in(message), message.stamp_ns, static=False)


class _Motion:
    """Takes in the moving transforms and the odometry of a bag, a little ahead of the images.

    Attributes:
        odometry: What was taken in so far, without stragglers.
    """

    def __init__(
        self, bag: Bag, facts: _Facts, continuity: Continuity, options: ReplayOptions
    ) -> None:
        topics = [TF]
        if options.odometry_topic:
            topics.append(bag.require(options.odometry_topic, (ODOMETRY,), '--odom-topic').name)
        self.odometry: list[OdometrySample] = []
        self._messages = bag.messages(topics)
        self._facts = facts
        self._continuity = continuity
        self._options = options
        self._next = next(self._messages, None)

    def advance_to(self, log_ns: int) -> None:
        while self._next is not None and self._next.log_ns <= log_ns:
            self._take_in(self._next)
            self._next = next(self._messages, None)

    def _take_in(self, message: BagMessage) -> None:
        if message.topic.name == TF:
            add_transforms(self._facts.transforms, message, static=False)
            return
        child_frame, base_frame = message.value.child_frame_id, self._options.base_frame
        if not is_odometry_of(child_frame, base_frame):
            msg = (
                f'{message.topic}: odometry of `{child_frame}`, the poses are those of '
                f'`{base_frame}` (empty: the camera); they can be compared for one body '
                f'only (--base-frame)'
            )
            raise BagError(msg)
        stamp_ns, odom_from_base = message.stamp_ns, pose_in(message)
        self._continuity.add_odometry(stamp_ns, odom_from_base)
        is_newer = not self.odometry or stamp_ns > self.odometry[-1].stamp_ns
        if is_newer and self._options.continuity.metric:
            truth = self._facts.truth_at(stamp_ns, self._options)
            self.odometry.append(OdometrySample(stamp_ns, odom_from_base, truth))


def _attempt(
    message: BagMessage,
    localizer: Localizes,
    options: ReplayOptions,
    facts: _Facts,
    continuity: Continuity,
    illustrations: _Illustrations,
) -> Attempt:
    truth = facts.truth_at(message.stamp_ns, options)
    try:
        image = image_in(message)
        camera = options.camera or camera_from_calibration(
            facts.calibration_at(message.stamp_ns), image_is_rectified=options.image_is_rectified
        )
        base_from_camera = _base_from_camera(message, options, facts.transforms)
    except (ImageError, CameraError, TransformError) as err:
        refused = LocalizationResult(_STATUS_OF[type(err)], reason=str(err))
        return Attempt(message.stamp_ns, refused, truth=truth)
    prior = continuity.prior(message.stamp_ns, base_from_camera)
    result = localizer.localize(image, camera, prior)
    attempt = Attempt(message.stamp_ns, result, truth=truth)
    if result.estimate is None:
        return attempt
    if result.accepted:
        pose = robot_pose(result.estimate, base_from_camera, options.covariance)
        judged = continuity.judge(message.stamp_ns, result, pose)
        attempt = replace(attempt, result=judged, robot_pose=pose if judged.accepted else None)
    illustrations.consider(attempt, Illustration(image, camera, result.estimate))
    return attempt


_STATUS_OF: dict[type[Exception], Status] = {
    ImageError: Status.UNDECODABLE_IMAGE,
    CameraError: Status.NO_CALIBRATION,
    TransformError: Status.NO_TRANSFORM,
}


def _base_from_camera(
    message: BagMessage, options: ReplayOptions, transforms: TransformTree
) -> pycolmap.Rigid3d:
    if options.base_from_camera is not None:
        return options.base_from_camera
    camera_frame = message.value.header.frame_id
    base_frame = options.base_frame or camera_frame
    return transforms.lookup(base_frame, camera_frame, message.stamp_ns)


class _Illustrations:
    """Remembers a few images and no other: the best one, the worst ones, and refused ones."""

    def __init__(self) -> None:
        self._best = Foremost[TimedIllustration](1)
        self._worst = Foremost[TimedIllustration](WORST_SHOWN)
        self._refused = Foremost[TimedIllustration](REFUSED_SHOWN)

    def consider(self, attempt: Attempt, illustration: Illustration) -> None:
        timed = TimedIllustration(attempt.stamp_ns, illustration)
        error, inliers = row_of(attempt).error, illustration.estimate.inliers
        if attempt.robot_pose is None:
            self._refused.consider(timed, inliers)
            return
        self._best.consider(timed, inliers)
        # where the truth is known, the error tells more than the inliers
        self._worst.consider(timed, -1.0 if error is None else error.position, -inliers)

    def chosen(self) -> tuple[TimedIllustration, ...]:
        every = (*self._best.items, *self._worst.items, *self._refused.items)
        return tuple({timed.stamp_ns: timed for timed in every}.values())
