# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What a bag tells of where its images were taken: odometry, GPS, or the robot's transforms."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import Counter, deque
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.alignment.constraints import GpsFixes, Poses, Positions
from gam_relocalizer.alignment.similarity import MIN_PLACES
from gam_relocalizer.capture.capture import Reference
from gam_relocalizer.errors import BagError, TransformError
from gam_relocalizer.localization.odometry import OdometryTrack
from gam_relocalizer.replay.messages import ODOMETRY, POSE_TYPES, add_transforms, pose_in
from gam_relocalizer.replay.replay import DELAY_NS, TF, TF_STATIC
from gam_relocalizer.transforms import TransformTree

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import pycolmap

    from gam_relocalizer.alignment.constraints import Triple
    from gam_relocalizer.capture.capture import Keyframe
    from gam_relocalizer.replay.bag import Bag, BagMessage

GPS_FIX = 'sensor_msgs/msg/NavSatFix'
MAP_FRAME = 'map'
BASE_FRAME = 'base_link'
# Receivers tell their place once a second, or more often; a car drives 30 m in that time.
MAX_GPS_GAP_NS = 2_500_000_000


@dataclass(frozen=True)
class WhereaboutsTopics:
    """Where to look.

    Attributes:
        odometry: Topic of the odometry, or of any poses of the robot; None takes the only
            nav_msgs/Odometry there is.
        gps: Topic of the GPS fixes; None takes the only one there is.
        camera_frame: Frame of the camera; None takes that of the images.
        base_frame: Whose poses those are that do not say so; empty for the camera itself.
    """

    odometry: str | None = None
    gps: str | None = None
    camera_frame: str | None = None
    base_frame: str = BASE_FRAME

    def found_in(self, bag: Bag) -> WhereaboutsTopics:
        """The same with the topics that the bag has; None where it has none.

        Raises:
            BagError: A topic is missing or of a wrong type, or there are several to choose from.
        """
        return replace(
            self,
            odometry=_found(bag, self.odometry, POSE_TYPES, ODOMETRY, '--odom-topic'),
            gps=_found(bag, self.gps, (GPS_FIX,), GPS_FIX, '--gps-topic'),
        )


def _found(
    bag: Bag, wanted: str | None, types: Sequence[str], usual: str, option: str
) -> str | None:
    if wanted is not None:
        return bag.require(wanted, types, option).name
    return bag.only((usual,), option).name if bag.of_types((usual,)) else None


def read_whereabouts(
    bag: Bag, keyframes: Sequence[Keyframe], topics: WhereaboutsTopics
) -> tuple[tuple[Reference, ...], tuple[str, ...]]:
    """What the bag tells of where its keyframes were taken, the best first, and warnings.

    Odometry comes first: it is smooth, metric and level. It counts as long as it is unbroken; of
    several parts the one with most keyframes is taken. Then GPS, and then the pose of the robot in
    `map`, if that was recorded on /tf. With the mount of the camera (/tf_static, /tf) odometry
    gives poses of the camera. Without, it gives places of the robot, which lie about where the
    camera was, and nothing of how the camera was turned: up then comes from the images.

    Raises:
        BagError: The bag is damaged, or a pose in it is none.
    """
    noted = _Noted(topics)
    for message in bag.messages([TF_STATIC]):
        add_transforms(noted.transforms, message, static=True)
    moving = [name for name in (TF, topics.odometry, topics.gps) if name is not None]
    waiting = deque(keyframes)
    for message in bag.messages(moving):
        while waiting and message.log_ns > waiting[0].log_ns + DELAY_NS:
            noted.note(waiting.popleft())
        noted.take_in(message)
    for keyframe in waiting:
        noted.note(keyframe)
    found = (noted.by_odometry(), noted.by_gps(keyframes), noted.by_transforms())
    return tuple(one for one in found if one is not None), tuple(noted.warnings)


@dataclass(frozen=True)
class _Moment:
    """What odometry says at the time of a keyframe.

    Attributes:
        part: Number of the unbroken part of the odometry.
        odom_from_base: The robot.
        base_from_camera: The mount, where it is known.
    """

    part: int
    odom_from_base: pycolmap.Rigid3d
    base_from_camera: pycolmap.Rigid3d | None


class _Noted:
    """Takes in the motion that a bag holds, and notes it where a keyframe was taken.

    Attributes:
        transforms: The robot's frames.
        warnings: What is to be said of what was found.
    """

    def __init__(self, topics: WhereaboutsTopics) -> None:
        self.transforms = TransformTree()
        self.warnings: list[str] = []
        self._topics = topics
        self._track = OdometryTrack()
        self._breaks: list[int] = []
        self._base_frame = topics.base_frame
        self._no_poses: list[str] = []
        self._no_mount: list[str] = []
        self._moments: dict[str, _Moment] = {}
        self._camera_from_map: dict[str, pycolmap.Rigid3d] = {}
        self._fixes: list[tuple[int, Triple]] = []

    def take_in(self, message: BagMessage) -> None:
        """The next message of any of the topics."""
        if message.topic.name == TF:
            add_transforms(self.transforms, message, static=False)
        elif message.topic.type == GPS_FIX:
            self._add_fix(message)
        else:
            self._add_odometry(message)

    def _add_fix(self, message: BagMessage) -> None:
        fix = message.value
        place = (float(fix.latitude), float(fix.longitude), float(fix.altitude))
        if fix.status.status >= 0 and all(map(math.isfinite, place)):
            self._fixes.append((message.stamp_ns, place))

    def _add_odometry(self, message: BagMessage) -> None:
        try:
            odom_from_base = pose_in(message)
        except BagError as err:
            self._no_poses.append(str(err))
            return
        if message.topic.type == ODOMETRY:
            self._base_frame = message.value.child_frame_id or self._topics.base_frame
        self._track.add(message.stamp_ns, odom_from_base)
        unbroken_since_ns = self._track.unbroken_since_ns
        if unbroken_since_ns > (self._breaks[-1] if self._breaks else 0):
            self._breaks.append(unbroken_since_ns)

    def note(self, keyframe: Keyframe) -> None:
        """Notes what is known at the time of a keyframe, and must be known by now."""
        stamp_ns = keyframe.stamp_ns
        camera_frame = self._topics.camera_frame or keyframe.frame_id
        reading = self._track.at(stamp_ns)
        if reading is not None:
            part = bisect_right(self._breaks, stamp_ns)
            mount = self._mount(camera_frame, stamp_ns)
            self._moments[keyframe.name] = _Moment(part, reading.odom_from_base, mount)
        with suppress(TransformError):
            camera_from_map = self.transforms.lookup(camera_frame, MAP_FRAME, stamp_ns)
            self._camera_from_map[keyframe.name] = camera_from_map

    def _mount(self, camera_frame: str, stamp_ns: int) -> pycolmap.Rigid3d | None:
        try:
            return self.transforms.lookup(self._base_frame or camera_frame, camera_frame, stamp_ns)
        except TransformError as err:
            self._no_mount.append(str(err))
            return None

    def by_odometry(self) -> Reference | None:
        """Poses of the camera in the odometry's frame, or else places of the robot."""
        topic = self._topics.odometry
        if topic is None:
            return None
        if self._no_poses:
            self.warnings.append(f'{len(self._no_poses)} poses are left out: {self._no_poses[0]}')
        moments = self._longest_part()
        mounted = {
            name: (moment.odom_from_base * moment.base_from_camera).inverse()
            for name, moment in moments.items()
            if moment.base_from_camera is not None
        }
        if len(mounted) >= MIN_PLACES:
            return Reference(f'odometry of {topic}', Poses(mounted))
        if len(moments) < MIN_PLACES:
            self.warnings.append(f'{topic} tells where {len(moments)} keyframes were taken: no use')
            return None
        self.warnings.append(
            f'the mount of the camera is not known, so {topic} tells where the robot was and not '
            f'how the camera was turned: {self._no_mount[0]}'
        )
        places = {name: _place(moment.odom_from_base) for name, moment in moments.items()}
        return Reference(f'places of the robot in {topic}', Positions(places, level=True))

    def _longest_part(self) -> dict[str, _Moment]:
        """Of the odometry, that which counts from one origin for most keyframes."""
        parts = Counter(moment.part for moment in self._moments.values())
        if len(parts) <= 1:
            return self._moments
        longest, count = parts.most_common(1)[0]
        self.warnings.append(
            f'{self._topics.odometry} pauses or jumps {len(parts) - 1} times between keyframes; '
            f'its part with most of them is used: {count} of {len(self._moments)}'
        )
        return {name: one for name, one in self._moments.items() if one.part == longest}

    def by_gps(self, keyframes: Sequence[Keyframe]) -> Reference | None:
        """Fixes, interpolated between two that are close in time."""
        topic = self._topics.gps
        if topic is None:
            return None
        fixes = _interpolated(dict(self._fixes), keyframes)
        if len(fixes) < MIN_PLACES:
            self.warnings.append(
                f'{topic} tells where {len(fixes)} keyframes were taken: no use; it has '
                f'{len(self._fixes)} fixes'
            )
            return None
        return Reference(f'GPS fixes of {topic}', GpsFixes(fixes, level=True))

    def by_transforms(self) -> Reference | None:
        """Poses of the camera in the frame `map`."""
        if len(self._camera_from_map) < MIN_PLACES:
            return None
        return Reference(f'transforms from {MAP_FRAME} on {TF}', Poses(self._camera_from_map))


def _place(odom_from_base: pycolmap.Rigid3d) -> Triple:
    x, y, z = (float(value) for value in odom_from_base.translation)
    return x, y, z


def _interpolated(fixes: Mapping[int, Triple], keyframes: Sequence[Keyframe]) -> dict[str, Triple]:
    """Latitude, longitude and altitude by name of keyframe, where they are known."""
    stamps = sorted(fixes)
    columns = np.array([fixes[stamp] for stamp in stamps]).reshape(-1, 3)
    # past the date line, longitude goes on
    columns[:, 1] = np.unwrap(columns[:, 1], period=360.0)
    places: dict[str, Triple] = {}
    for keyframe in keyframes:
        after = bisect_right(stamps, keyframe.stamp_ns)
        if not 0 < after < len(stamps) or stamps[after] - stamps[after - 1] > MAX_GPS_GAP_NS:
            continue
        before = stamps[after - 1]
        share = (keyframe.stamp_ns - before) / (stamps[after] - before)
        latitude, longitude, altitude = (
            (1.0 - share) * columns[after - 1] + share * columns[after]
        ).tolist()
        places[keyframe.name] = (latitude, longitude, altitude)
    return places
