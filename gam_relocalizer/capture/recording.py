# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframes of a rosbag2, their cameras, and what the bag tells of where they were taken."""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from gam_relocalizer.cameras import camera_from_calibration
from gam_relocalizer.capture.capture import Capture, keep_keyframes
from gam_relocalizer.capture.keyframes import Frame
from gam_relocalizer.capture.whereabouts import WhereaboutsTopics, read_whereabouts
from gam_relocalizer.errors import ImageError
from gam_relocalizer.image_set import ImageSet
from gam_relocalizer.mapping.progress import Progress, ignore_progress
from gam_relocalizer.replay.bag import (
    CAMERA_INFO,
    find_camera_info_topic,
    find_image_topic,
    open_bag,
)
from gam_relocalizer.replay.messages import calibration_in, image_in

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    import pycolmap

    from gam_relocalizer.cameras import CameraCalibration
    from gam_relocalizer.capture.capture import Keyframe, Selection
    from gam_relocalizer.mapping.workspace import Workspace
    from gam_relocalizer.replay.bag import Bag, Topic


@dataclass(frozen=True)
class BagOptions:
    """What to take from a bag.

    Attributes:
        image_topic: Needed only when the bag has several.
        camera_info_topic: Needed only when it is not beside the image topic.
        camera: The camera; without it the bag's CameraInfo tells.
        image_is_rectified: The images are rectified: use P of the CameraInfo, no distortion.
        whereabouts: What tells where the images were taken; None when nobody wants to know.
    """

    image_topic: str | None = None
    camera_info_topic: str | None = None
    camera: pycolmap.Camera | None = None
    image_is_rectified: bool = False
    whereabouts: WhereaboutsTopics | None = field(default_factory=WhereaboutsTopics)


def capture_bag(
    path: Path,
    workspace: Workspace,
    options: BagOptions | None = None,
    progress: Progress = ignore_progress,
) -> Capture:
    """Chooses the keyframes of a bag and reads what it knows of them.

    Args:
        path: The rosbag2; only read.
        workspace: Where the keyframes are stored.
        options: See there.
        progress: Told of the step frames.

    Raises:
        BagError: The bag is damaged, a topic is missing, or there are several to choose from.
        CameraError: A CameraInfo with a calibration that cannot be understood.
        MapBuildError: The keyframes cannot be stored, or there are none.
    """
    options = options or BagOptions()
    with open_bag(path) as bag:
        topic = find_image_topic(bag, options.image_topic)
        info = _camera_info_topic(bag, topic, options)
        whereabouts = options.whereabouts and options.whereabouts.found_in(bag)
        selection = keep_keyframes(_BagFrames(bag, topic, progress), workspace)
        cameras, camera_warnings = _cameras(bag, info, selection, options)
        references, warnings = (
            read_whereabouts(bag, selection.keyframes, whereabouts) if whereabouts else ((), ())
        )
    return Capture(
        name=str(path),
        images=ImageSet(selection.folder, selection.names, cameras, source=path.absolute().name),
        counts=selection.counts,
        references=references,
        warnings=(*selection.warnings, *camera_warnings, *warnings),
    )


class _BagFrames:
    """The images of a topic.

    Attributes:
        name: Of bag and topic.
        identity: The files of the bag as they were found, and the topic.
        warnings: Filled when all frames were read.
    """

    def __init__(self, bag: Bag, topic: Topic, progress: Progress) -> None:
        files = [bag.path] if bag.path.is_file() else sorted(bag.path.iterdir())
        found = [(file.name, file.stat()) for file in files]
        self.name = f'{bag.path}: {topic}'
        self.identity = {
            'bag': str(bag.path.absolute()),
            'files': [[name, stat.st_size, stat.st_mtime_ns] for name, stat in found],
            'topic': topic.name,
        }
        self.warnings: list[str] = []
        self._bag = bag
        self._topic = topic
        self._progress = progress

    def frames(self) -> Iterator[Frame]:
        """All images that can be decoded, with the stamps of their headers.

        A stamp of zero, which a driver leaves that knows no time, counts as the time of recording.
        """
        damaged: list[str] = []
        for done, message in enumerate(self._bag.messages([self._topic.name]), start=1):
            self._progress('frames', done, max(done, self._topic.count))
            try:
                image = image_in(message)
            except ImageError as err:
                damaged.append(str(err))
                continue
            stamp_ns = message.stamp_ns or message.log_ns
            yield Frame(stamp_ns, image, message.log_ns, message.value.header.frame_id)
        if damaged:
            self.warnings.append(
                f'{len(damaged)} of {self._topic.count} images cannot be decoded and are left out; '
                f'the first: {damaged[0]}'
            )


def _camera_info_topic(bag: Bag, image_topic: Topic, options: BagOptions) -> Topic | None:
    """None when the camera is given, or the bag has no CameraInfo at all."""
    wanted = options.camera_info_topic
    if options.camera is not None or (wanted is None and not bag.of_types((CAMERA_INFO,))):
        return None
    return find_camera_info_topic(bag, image_topic.name, wanted)


def _cameras(
    bag: Bag, info: Topic | None, selection: Selection, options: BagOptions
) -> tuple[dict[str, pycolmap.Camera], list[str]]:
    """The camera of each keyframe that has a known one, and what to say of the others.

    Raises:
        CameraError: A calibration that cannot be understood.
    """
    calibrations = [] if info is None else _calibrations(bag, info)
    cameras: dict[str, pycolmap.Camera] = {}
    unknown: Counter[str] = Counter()
    for keyframe in selection.keyframes:
        camera = options.camera
        if camera is None:
            calibration = _newest_at(keyframe.stamp_ns, calibrations)
            if calibration is None:
                unknown['the bag holds no CameraInfo for them'] += 1
                continue
            if not _is_calibrated(calibration, options):
                unknown['their CameraInfo says that the camera is not calibrated'] += 1
                continue
            camera = camera_from_calibration(
                calibration, image_is_rectified=options.image_is_rectified
            )
        if (camera.width, camera.height) == (keyframe.width, keyframe.height):
            cameras[keyframe.name] = camera
        else:
            unknown[_mismatch(keyframe, camera)] += 1
    warnings = [
        f'the camera of {count} of {len(selection.keyframes)} keyframes is guessed: {why}'
        for why, count in unknown.items()
    ]
    return cameras, warnings


def _calibrations(bag: Bag, info: Topic) -> list[tuple[int, CameraCalibration]]:
    """Stamp and numbers of the CameraInfo, each time they change."""
    calibrations: list[tuple[int, CameraCalibration]] = []
    for message in bag.messages([info.name]):
        calibration = calibration_in(message)
        if not calibrations or calibrations[-1][1] != calibration:
            calibrations.append((message.stamp_ns, calibration))
    return calibrations


def _newest_at(
    stamp_ns: int, calibrations: Sequence[tuple[int, CameraCalibration]]
) -> CameraCalibration | None:
    """Before the first one, the first."""
    if not calibrations:
        return None
    newer = bisect_right(calibrations, stamp_ns, key=lambda entry: entry[0])
    return calibrations[max(0, newer - 1)][1]


def _is_calibrated(calibration: CameraCalibration, options: BagOptions) -> bool:
    matrix = calibration.p if options.image_is_rectified else calibration.k
    return bool(matrix[0])


def _mismatch(keyframe: Keyframe, camera: pycolmap.Camera) -> str:
    return (
        f'they are {keyframe.width} x {keyframe.height} pixels and the known camera has '
        f'{camera.width} x {camera.height}'
    )
