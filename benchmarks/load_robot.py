# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""A robot that publishes what sensors publish, at their rates; for `node_load.py` and others.

It drives to and fro in the demo's rooms: images of 1280x720 with their calibration at 30 Hz, as
sensor data, odometry at 50 Hz, and on /tf 100 messages per second (odometry, and the joints of a
robot_state_publisher).
"""

from __future__ import annotations

import os
import threading
import time
from array import array
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pycolmap
import rclpy
from geometry_msgs.msg import Transform, TransformStamped, Vector3
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import (
    DurabilityPolicy,
    QoSProfile,
    ReliabilityPolicy,
    qos_profile_sensor_data,
)
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from gam_relocalizer.cameras import PIXEL_CENTRE
from gam_relocalizer.demo import recording, trajectories
from gam_relocalizer.demo.renderer import Renderer
from gam_relocalizer.demo.world import demo_world
from gam_relocalizer.ros.conversions import image_message, pose_message, stamp_from
from gam_relocalizer_msgs.msg import RelocalizationStatus

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray
    from rclpy.node import Node

WIDTH, HEIGHT = 1280, 720
FOCAL_LENGTH = 830.0
# A DDS domain that a robot on the same machine is unlikely to use.
DOMAIN_ID = '78'
IMAGE_TOPIC = '/camera/image'
CAMERA_INFO_TOPIC = '/camera/camera_info'
IMAGE_HZ, ODOMETRY_HZ, JOINTS_HZ = 30.0, 50.0, 50.0
JOINTS = ('front_left', 'front_right', 'rear_left', 'rear_right')
JPEG_QUALITY = 90
VIEWS, VIEWS_HZ = 20, 5.0
BEGIN_S = 5.0
LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
# Large images need a large segment of shared memory at the side that sends them: with the default
# of 512 KiB most raw images of this size are lost before any node sees them.
PROFILE = """<?xml version="1.0" encoding="UTF-8"?>
<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <transport_descriptors>
    <transport_descriptor>
      <transport_id>large_shared_memory</transport_id>
      <type>SHM</type>
      <segment_size>67108864</segment_size>
      <maxMessageSize>16777216</maxMessageSize>
    </transport_descriptor>
    <transport_descriptor>
      <transport_id>udp</transport_id>
      <type>UDPv4</type>
    </transport_descriptor>
  </transport_descriptors>
  <participant profile_name="large_images" is_default_profile="true">
    <rtps>
      <userTransports>
        <transport_id>large_shared_memory</transport_id>
        <transport_id>udp</transport_id>
      </userTransports>
      <useBuiltinTransports>false</useBuiltinTransports>
    </rtps>
  </participant>
</profiles>
"""


@dataclass(frozen=True)
class View:
    """What the camera sees at one time of the drive.

    Attributes:
        pixels: RGB [720,1280,3].
        drive_s: The time of the drive [s].
    """

    pixels: NDArray[np.uint8]
    drive_s: float


def render_views(count: int = VIEWS) -> list[View]:
    """Views along the first seconds of the demo's drive; about half a second of work for each."""
    world = demo_world(rearranged=True)
    renderer = Renderer(world, recording.drive_appearance(world))
    drive = trajectories.drive(world.drive_route)
    camera = _camera()
    times = BEGIN_S + np.arange(count) / VIEWS_HZ
    return [
        View(renderer.render(camera, [drive.camera_from_map(t)], seed), t)
        for seed, t in enumerate(times.tolist())
    ]


@dataclass
class Heard:
    """What the node has answered so far."""

    attempts: int = 0
    fixes: int = 0


class Robot:
    """Publishes in a thread of its own while it is in use as a context."""

    def __init__(self, node: Node, views: Sequence[View], *, compressed: bool) -> None:
        self.node = node
        self.heard = Heard()
        self.images_sent = 0
        self._views = views
        world = demo_world(rearranged=True)
        self._drive = trajectories.drive(world.drive_route)
        self._images = [_image_message(view.pixels, compressed=compressed) for view in views]
        self._calibration = _calibration(_camera())
        sensor, create = qos_profile_sensor_data, node.create_publisher
        kind, suffix = (CompressedImage, '/compressed') if compressed else (Image, '')
        self._image = create(kind, IMAGE_TOPIC + suffix, sensor)
        self._camera_info = create(CameraInfo, CAMERA_INFO_TOPIC, sensor)
        self._odometry = create(Odometry, '/odom', sensor)
        self._tf = create(TFMessage, '/tf', 100)
        self._tf_static = create(TFMessage, '/tf_static', LATCHED)
        node.create_subscription(RelocalizationStatus, '/gam_relocalizer/status', self._hear, 10)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._publish, daemon=True)

    def __enter__(self) -> Robot:
        mount = _transform(trajectories.BASE_FROM_CAMERA, 'base_link', recording.CAMERA_FRAME)
        self._tf_static.publish(TFMessage(transforms=[mount]))
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _hear(self, status: RelocalizationStatus) -> None:
        self.heard.attempts += 1
        self.heard.fixes += bool(status.accepted)

    def _publish(self) -> None:
        """Every sensor at its rate; what could not be sent in time is left out."""
        sensors: list[tuple[float, Callable[[int], None]]] = [
            (IMAGE_HZ, self._publish_image),
            (ODOMETRY_HZ, self._publish_odometry),
            (JOINTS_HZ, self._publish_joints),
        ]
        due = [time.monotonic() + index * 0.003 for index in range(len(sensors))]
        while not self._stop.is_set():
            which = int(np.argmin(due))
            self._stop.wait(max(0.0, due[which] - time.monotonic()))
            rate, publish = sensors[which]
            publish(time.time_ns())
            due[which] = max(due[which] + 1 / rate, time.monotonic() - 1 / rate)

    def _drive_s(self, stamp_ns: int) -> float:
        """To and fro over the time of the views."""
        span = (len(self._views) - 1) / VIEWS_HZ
        phase = stamp_ns / 1e9 % (2 * span)
        return BEGIN_S + min(phase, 2 * span - phase)

    def _publish_image(self, stamp_ns: int) -> None:
        image = self._images[round((self._drive_s(stamp_ns) - BEGIN_S) * VIEWS_HZ)]
        image.header.stamp = self._calibration.header.stamp = stamp_from(stamp_ns)
        self._camera_info.publish(self._calibration)
        self._image.publish(image)
        self.images_sent += 1

    def _publish_odometry(self, stamp_ns: int) -> None:
        odom_from_base = self._drive.map_from_base(self._drive_s(stamp_ns))
        message = Odometry(child_frame_id='base_link')
        message.header = Header(stamp=stamp_from(stamp_ns), frame_id='odom')
        message.pose.pose = pose_message(odom_from_base)
        self._odometry.publish(message)
        moved = _transform(odom_from_base, 'odom', 'base_link', stamp_ns)
        self._tf.publish(TFMessage(transforms=[moved]))

    def _publish_joints(self, stamp_ns: int) -> None:
        joints = [
            _transform(pycolmap.Rigid3d(), 'base_link', f'{name}_wheel', stamp_ns)
            for name in JOINTS
        ]
        self._tf.publish(TFMessage(transforms=joints))


@contextmanager
def robot_in(folder: Path, views: Sequence[View], *, compressed: bool) -> Iterator[Robot]:
    """A robot whose images arrive, whatever their size; its Fast DDS profile goes to a folder."""
    profile = folder / 'large_images.xml'
    profile.write_text(PROFILE, encoding='utf-8')
    os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(profile)
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node('robot', context=context)
    # read when the first node is made; the node under load is to have its own default
    del os.environ['FASTRTPS_DEFAULT_PROFILES_FILE']
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    thread = threading.Thread(target=_spin, args=(executor,), daemon=True)
    try:
        robot = Robot(node, views, compressed=compressed)
        thread.start()
        with robot:
            yield robot
    finally:
        executor.shutdown()
        thread.join()
        node.destroy_node()
        rclpy.try_shutdown(context=context)


def _spin(executor: SingleThreadedExecutor) -> None:
    try:
        executor.spin()
    except ExternalShutdownException:
        return


def _camera() -> pycolmap.Camera:
    parameters = [FOCAL_LENGTH, FOCAL_LENGTH, WIDTH / 2, HEIGHT / 2]
    return pycolmap.Camera(model='PINHOLE', width=WIDTH, height=HEIGHT, params=parameters)


def _calibration(camera: pycolmap.Camera) -> CameraInfo:
    fx, fy, cx, cy = map(float, camera.params)
    cx, cy = cx - PIXEL_CENTRE, cy - PIXEL_CENTRE
    return CameraInfo(
        header=Header(frame_id=recording.CAMERA_FRAME),
        width=camera.width,
        height=camera.height,
        distortion_model='plumb_bob',
        d=[0.0] * 5,
        k=[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        p=[fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    )


def _image_message(pixels: NDArray[np.uint8], *, compressed: bool) -> Image | CompressedImage:
    header = Header(frame_id=recording.CAMERA_FRAME)
    if not compressed:
        return image_message(pixels, header)
    bgr = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    encoded = cv2.imencode('.jpg', bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    return CompressedImage(header=header, format='jpeg', data=array('B', encoded.tobytes()))


def _transform(
    parent_from_child: pycolmap.Rigid3d, parent: str, child: str, stamp_ns: int = 0
) -> TransformStamped:
    pose = pose_message(parent_from_child)
    place = pose.position
    return TransformStamped(
        header=Header(stamp=stamp_from(stamp_ns), frame_id=parent),
        child_frame_id=child,
        transform=Transform(
            translation=Vector3(x=place.x, y=place.y, z=place.z), rotation=pose.orientation
        ),
    )
