# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Between messages and the values of the core.

Fields of messages are not type-checked by default, and a NumPy scalar or an int in the place of a
float is serialised as a wrong number without a word: everything written here is a plain float, int
or bool.
"""

from __future__ import annotations

from array import array
from typing import TYPE_CHECKING

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseStamped, PoseWithCovarianceStamped, Quaternion
from sensor_msgs.msg import CompressedImage, Image, PointCloud2, PointField

from gam_relocalizer.errors import TransformError
from gam_relocalizer.geometry import quaternion_wxyz
from gam_relocalizer.replay.messages import pixels_of, rigid_in
from gam_relocalizer_msgs.msg import RelocalizationStatus

if TYPE_CHECKING:
    import pycolmap
    from geometry_msgs.msg import Transform
    from numpy.typing import NDArray
    from std_msgs.msg import Header

    from gam_relocalizer.localization.result import LocalizationResult
    from gam_relocalizer.localization.robot_pose import RobotPose

NANOSECONDS = 10**9


def nanoseconds_from(stamp: Time) -> int:
    """A stamp as one integer [ns]."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def stamp_from(nanoseconds: int) -> Time:
    """One integer [ns] as a stamp."""
    seconds, rest = divmod(nanoseconds, NANOSECONDS)
    return Time(sec=int(seconds), nanosec=int(rest))


def pixels_from(message: Image | CompressedImage, topic: str) -> NDArray[np.uint8]:
    """The pixels of an image message, RGB [H,W,3] or grey [H,W].

    Args:
        message: sensor_msgs/Image or sensor_msgs/CompressedImage.
        topic: Where it came from, for the error.

    Raises:
        ImageError: It cannot be decoded.
    """
    return pixels_of(message, compressed=isinstance(message, CompressedImage), source=topic)


def rigid3d_from_message(transform: Transform) -> pycolmap.Rigid3d:
    """A geometry_msgs/Transform as `parent_from_child`.

    Raises:
        TransformError: Its quaternion is zero, or a number is not finite.
    """
    try:
        return rigid_in(transform.translation, transform.rotation)
    except ValueError as err:
        msg = f'a transform is none: {err}'
        raise TransformError(msg) from err


def image_message(pixels: NDArray[np.uint8], header: Header) -> Image:
    """An RGB picture [H,W,3]."""
    height, width = pixels.shape[:2]
    # an ndarray as data would be copied byte by byte
    data = array('B', np.ascontiguousarray(pixels).tobytes())
    return Image(
        header=header, height=height, width=width, encoding='rgb8', step=3 * width, data=data
    )


def point_cloud_message(points: NDArray[np.float64], header: Header) -> PointCloud2:
    """Points [N,3] as an unordered cloud of x, y, z (float32)."""
    fields = [
        PointField(name=name, offset=4 * index, datatype=PointField.FLOAT32, count=1)
        for index, name in enumerate('xyz')
    ]
    return PointCloud2(
        header=header,
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=12,
        row_step=12 * len(points),
        data=array('B', points.astype('<f4').tobytes()),
        is_dense=True,
    )


def pose_message(map_from_body: pycolmap.Rigid3d) -> Pose:
    """A body's pose; its quaternion has unit length and w >= 0."""
    x, y, z = (float(value) for value in map_from_body.translation)
    qw, qx, qy, qz = (float(value) for value in quaternion_wxyz(map_from_body))
    return Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))


def pose_with_covariance_message(
    robot_pose: RobotPose, header: Header
) -> PoseWithCovarianceStamped:
    """The message of /relocalized_pose."""
    message = PoseWithCovarianceStamped(header=header)
    message.pose.pose = pose_message(robot_pose.map_from_base)
    message.pose.covariance = [float(value) for value in robot_pose.covariance.ravel()]
    return message


def pose_stamped_message(map_from_body: pycolmap.Rigid3d, header: Header) -> PoseStamped:
    """A pose without a covariance."""
    return PoseStamped(header=header, pose=pose_message(map_from_body))


def status_message(result: LocalizationResult, header: Header, map_id: str) -> RelocalizationStatus:
    """The verdict on one attempt."""
    estimate, timings = result.estimate, result.timings
    message = RelocalizationStatus(
        header=header,
        status=result.status.value,
        status_name=result.status.name,
        reason=result.reason,
        accepted=bool(result.accepted),
        map_id=map_id,
        scene=result.scene,
        scenes_tried=int(result.scenes_tried),
        keypoints=int(result.keypoints),
        matches=int(result.matches),
        inliers=int(result.inliers),
        confidence=float(result.confidence),
        extraction_ms=float(timings.extraction),
        retrieval_ms=float(timings.retrieval),
        matching_ms=float(timings.matching),
        pose_ms=float(timings.pose),
        verdict_ms=float(timings.verdict),
        total_ms=float(timings.total),
    )
    if estimate is not None:
        message.inlier_ratio = float(estimate.inlier_ratio)
        message.coverage = float(estimate.coverage)
        message.reprojection_error_px = float(estimate.reprojection_error)
    return message
