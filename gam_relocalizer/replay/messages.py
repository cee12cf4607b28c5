# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""From the messages of a bag to the plain values that the rest of the project works on."""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from gam_relocalizer.cameras import CameraCalibration
from gam_relocalizer.errors import BagError, TransformError
from gam_relocalizer.geometry import rigid3d_from
from gam_relocalizer.images import decode_compressed, decode_image
from gam_relocalizer.replay.bag import COMPRESSED_IMAGE, nanoseconds

if TYPE_CHECKING:
    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.replay.bag import BagMessage
    from gam_relocalizer.transforms import TransformTree

POSE_STAMPED = 'geometry_msgs/msg/PoseStamped'
POSE_WITH_COVARIANCE_STAMPED = 'geometry_msgs/msg/PoseWithCovarianceStamped'
ODOMETRY = 'nav_msgs/msg/Odometry'
POSE_TYPES = (POSE_STAMPED, POSE_WITH_COVARIANCE_STAMPED, ODOMETRY)

_LOG = logging.getLogger(__name__)


def image_in(message: BagMessage) -> NDArray[np.uint8]:
    """The picture in an Image or CompressedImage: RGB [H,W,3] or grey [H,W].

    Raises:
        ImageError: It cannot be decoded.
    """
    compressed = message.topic.type == COMPRESSED_IMAGE
    return pixels_of(message.value, compressed=compressed, source=message.topic.name)


def pixels_of(value: Any, *, compressed: bool, source: str) -> NDArray[np.uint8]:  # noqa: ANN401
    """The picture in an Image or CompressedImage of any library: RGB [H,W,3] or grey [H,W].

    Args:
        value: The message.
        compressed: Whether it is a CompressedImage.
        source: Topic, for the error.

    Raises:
        ImageError: It cannot be decoded.
    """
    if compressed:
        return decode_compressed(np.frombuffer(value.data, dtype=np.uint8), source)
    return decode_image(
        value.encoding,
        int(value.width),
        int(value.height),
        int(value.step),
        is_bigendian=bool(value.is_bigendian),
        data=value.data,
        source=source,
    )


def calibration_in(message: BagMessage) -> CameraCalibration:
    """The numbers of a CameraInfo in a bag."""
    return calibration_of(message.value)


def calibration_of(info: Any) -> CameraCalibration:  # noqa: ANN401 - a message of any library
    """The numbers of a CameraInfo."""
    return CameraCalibration(
        width=int(info.width),
        height=int(info.height),
        distortion_model=str(info.distortion_model),
        d=_floats(info.d),
        k=_floats(info.k),
        p=_floats(info.p),
        binning=(int(info.binning_x), int(info.binning_y)),
        roi=(
            int(info.roi.x_offset),
            int(info.roi.y_offset),
            int(info.roi.width),
            int(info.roi.height),
        ),
    )


def pose_in(message: BagMessage) -> pycolmap.Rigid3d:
    """`header.frame_id`_from_body of any message of `POSE_TYPES`.

    Raises:
        BagError: Numbers that are no pose.
    """
    pose = message.value.pose
    if message.topic.type != POSE_STAMPED:
        pose = pose.pose
    try:
        return rigid_in(pose.position, pose.orientation)
    except ValueError as err:
        msg = f'{message.topic}: a pose at {message.stamp_ns} ns is no pose: {err}'
        raise BagError(msg) from err


def rigid_in(translation: Any, quaternion: Any) -> pycolmap.Rigid3d:  # noqa: ANN401 - messages
    """A rigid transform from a geometry_msgs vector or point, and a quaternion.

    Raises:
        ValueError: A number is not finite, or the quaternion is zero.
    """
    wxyz = [quaternion.w, quaternion.x, quaternion.y, quaternion.z]
    xyz = [translation.x, translation.y, translation.z]
    if not all(map(math.isfinite, (*wxyz, *xyz))) or math.hypot(*wxyz) < 1e-6:
        msg = f'translation {xyz}, quaternion (w, x, y, z) {wxyz}'
        raise ValueError(msg)
    return rigid3d_from(wxyz, xyz)


def add_transforms(tree: TransformTree, message: BagMessage, *, static: bool) -> None:
    """Adds what is usable of a TFMessage, as tf2 does: a robot's tree often has a broken branch."""
    for stamped in message.value.transforms:
        transform = stamped.transform
        try:
            tree.add(
                stamped.header.frame_id,
                stamped.child_frame_id,
                rigid_in(transform.translation, transform.rotation),
                nanoseconds(stamped.header.stamp),
                static=static,
            )
        except (TransformError, ValueError) as err:
            _LOG.warning('%s: a transform is left out: %s', message.topic.name, err)


def _floats(values: Any) -> tuple[float, ...]:  # noqa: ANN401 - an array of any library
    return tuple(float(value) for value in values)
