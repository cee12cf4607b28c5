# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The topics and services of the node: it creates them from this, and the documentation lists them.

The tables in docs/ros_interface.md come from here (scripts/generate_interface_docs.py).
"""

from __future__ import annotations

from enum import Enum
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry, Path
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
from std_srvs.srv import SetBool

from gam_relocalizer_msgs.msg import RelocalizationStatus
from gam_relocalizer_msgs.srv import LoadMap, LocalizeImage, Relocalize

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # an installation of ROS 2 from pip has no tf2_msgs of its own
    TFMessage = None

__all__ = ['MAP_POINTS_SHOWN', 'PATH_LENGTH', 'Service', 'TFMessage', 'Topic']

PATH_LENGTH = 1000
# 1.2 MB: the message is kept for late subscribers, and sent to each of them at once.
MAP_POINTS_SHOWN = 100_000


def _reliable(depth: int) -> QoSProfile:
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE)


def _latched(depth: int) -> QoSProfile:
    """Late subscribers get the last messages, too."""
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )


def _best_effort(depth: int) -> QoSProfile:
    """SensorDataQoS with a depth of its own."""
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)


class Topic(Enum):
    """A topic that the node listens to, or publishes on.

    Attributes:
        topic: Its name, before it is remapped.
        kind: Type of its messages; None for those of tf2_msgs where that is not installed.
        qos: What the node asks of the other side, or offers.
        is_input: Whether the node listens.
        description: What it carries.
    """

    IMAGE = (
        'image',
        Image,
        _best_effort(1),
        True,
        'The images of the camera. The parameter `image_reliability` may ask for `reliable`.',
    )
    COMPRESSED_IMAGE = (
        'image/compressed',
        CompressedImage,
        _best_effort(1),
        True,
        'The same as JPEG or PNG, instead of `image`, with `image_transport: compressed`. The name '
        'follows that which `image` is remapped to.',
    )
    CAMERA_INFO = ('camera_info', CameraInfo, _best_effort(1), True, 'The calibration of them.')
    # room for what a quick odometry sends while the thread that listens has no turn
    ODOMETRY = (
        'odom',
        Odometry,
        _best_effort(50),
        True,
        'Optional. Only its pose is used, see '
        '[below](#odometry-and-other-things-known-beforehand).',
    )
    INITIAL_POSE = (
        'initialpose',
        PoseWithCovarianceStamped,
        _reliable(10),
        True,
        'Optional. Where to look first, see [below](#odometry-and-other-things-known-beforehand).',
    )
    # the qualities of service of both are those of tf2_ros
    TF = (
        '/tf',
        TFMessage,
        _reliable(100),
        True,
        'The mount of the camera where it moves; with `publish_map_odom`, who else broadcasts the '
        'frame of the odometry.',
    )
    TF_STATIC = ('/tf_static', TFMessage, _latched(100), True, 'The mount of the camera.')
    POSE = (
        '/relocalized_pose',
        PoseWithCovarianceStamped,
        _latched(1),
        False,
        'The pose of `base_frame` in `map_frame`; a fix, or nothing.',
    )
    STATUS = (
        '~/status',
        RelocalizationStatus,
        _reliable(10),
        False,
        'The verdict on every attempt.',
    )
    CAMERA_POSE = (
        '~/camera_pose',
        PoseStamped,
        _reliable(10),
        False,
        "With each fix: the camera's optical frame in `map_frame`.",
    )
    MAP_POINTS = (
        '~/map_points',
        PointCloud2,
        _latched(1),
        False,
        'The points of the map, once on activation and with another map; of a map with more than '
        f'{MAP_POINTS_SHOWN} points only every n-th, so that there are at most as many.',
    )
    DEBUG_IMAGE = (
        '~/debug_image',
        Image,
        _best_effort(5),
        False,
        "When somebody listens: each attempt's image with its inliers and verdict.",
    )
    PATH = (
        '~/path',
        Path,
        _reliable(1),
        False,
        f'When somebody listens: the last {PATH_LENGTH} fixes.',
    )
    MAP_ODOM = (
        '/tf',
        TFMessage,
        _reliable(100),
        False,
        'With `publish_map_odom`: the transform [`map -> odom`](#map---odom).',
    )
    DIAGNOSTICS = (
        '/diagnostics',
        DiagnosticArray,
        _reliable(10),
        False,
        'Each second, see [below](#diagnostics).',
    )

    def __init__(
        self,
        topic: str,
        kind: Any,  # noqa: ANN401 - a message type
        qos: QoSProfile,
        is_input: bool,  # noqa: FBT001 - of a row of the table
        description: str,
    ) -> None:
        self.topic = topic
        self.kind = kind
        self.qos = qos
        self.is_input = is_input
        self.description = description

    @property
    def type(self) -> str:
        """Type of its messages, such as `sensor_msgs/Image`."""
        return _name_of(self.kind)


class Service(Enum):
    """A service that the node offers, in every state.

    Attributes:
        service: Its name, before it is remapped.
        kind: Its type.
        description: What it does.
    """

    RELOCALIZE = (
        '~/relocalize',
        Relocalize,
        'Tries the next image that comes, without waiting for the period, and answers with the '
        'pose of the base, its covariance and the status. What it gives is published as well. '
        'When the attempt has not begun within `timeout` (wall clock; 0: 5 s) the answer is '
        'NO_IMAGE, NO_CALIBRATION or BUSY. Who asks at the same time gets the same attempt.',
    )
    LOCALIZE_IMAGE = (
        '~/localize_image',
        LocalizeImage,
        'Tries an image with its CameraInfo that the caller brings along, of whatever camera, and '
        'answers with the pose of **that camera** (optical frame). Nothing is published; odometry, '
        'hints and the last fix have no say. Up to 4 images wait, further ones are BUSY. Camera '
        'and callers take turns.',
    )
    LOAD_MAP = (
        '~/load_map',
        LoadMap,
        'Replaces the map. The one in use serves until the other one is ready, and stays when that '
        'cannot be loaded; `message` says which file is wrong. Continuity with earlier fixes ends, '
        '`~/map_points` shows the new map, the parameter `map` names it. A node that is '
        'unconfigured for want of a map starts with it (with `autostart`).',
    )
    SET_ENABLED = (
        '~/set_enabled',
        SetBool,
        '`false`: no attempts but those that somebody asks for with `~/relocalize` or '
        '`~/localize_image`. `true`: one each period again. Every activation starts with `true`.',
    )

    def __init__(self, service: str, kind: Any, description: str) -> None:  # noqa: ANN401 - a service type
        self.service = service
        self.kind = kind
        self.description = description

    @property
    def type(self) -> str:
        """Its type, such as `std_srvs/SetBool`."""
        return _name_of(self.kind)


def _name_of(kind: Any) -> str:  # noqa: ANN401 - a message or service type
    package, *_ = kind.__module__.split('.')
    return f'{package}/{kind.__name__}'
