# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""A robot for the node: publishes what sensors publish, hears what the node says."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import pytest
import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import (
    PoseStamped,
    PoseWithCovarianceStamped,
    Quaternion,
    Transform,
    TransformStamped,
    Vector3,
)
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import SetParameters
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from gam_relocalizer.geometry import quaternion_wxyz, rigid3d_from
from gam_relocalizer_msgs.msg import RelocalizationStatus

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    import numpy as np
    import pycolmap
    from numpy.typing import NDArray
    from rclpy.node import Node

T = TypeVar('T')
REPOSITORY = Path(__file__).parents[2]
NODE = '/gam_relocalizer'
LIMIT_S = 60.0
PATIENCE_S = 5.0
QUICK = {
    'period': 0.05,
    'image_reliability': 'reliable',
    'max_keypoints': 1000,
    'torch_threads': 1,
}
LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
CAMERA_FRAME = 'camera_optical'
BASE_FROM_CAMERA = rigid3d_from((0.5, -0.5, 0.5, -0.5), (0.2, -0.1, 0.3))


def wait_for(condition: Callable[[], T | None], what: str, limit: float = LIMIT_S) -> T:
    """The first true answer of a condition."""
    give_up = time.monotonic() + limit
    while not (answer := condition()):
        if time.monotonic() > give_up:
            pytest.fail(f'{what}: not within {limit} s')
        time.sleep(0.01)
    return answer


class NodeProcess:
    """The node as its own process."""

    def __init__(
        self, log: Path, *arguments: str, remap: Sequence[str] = (), **parameters: object
    ) -> None:
        self._log = log
        values = QUICK | parameters
        settings = [word for item in values.items() for word in ('-p', _assignment(*item))]
        settings += [word for rule in remap for word in ('-r', rule)]
        command = [sys.executable, '-m', 'gam_relocalizer', 'node', *arguments]
        with log.open('wb') as output:
            self.process = subprocess.Popen(
                [*command, '--ros-args', *settings],
                stdout=output,
                stderr=subprocess.STDOUT,
                cwd=REPOSITORY,
            )

    @property
    def log(self) -> str:
        return self._log.read_text(encoding='utf-8')

    @property
    def alive(self) -> bool:
        return self.process.poll() is None

    def wait_for_log(self, text: str) -> str:
        wait_for(lambda: text in self.log or not self.alive, f'`{text}` in the log')
        assert text in self.log, self.log
        return self.log

    def stop(self, *signals: signal.Signals) -> int:
        """Sends signals, waits for the end, and hands back the exit code."""
        for number in signals or (signal.SIGINT,):
            self.process.send_signal(number)
        return self.process.wait(LIMIT_S)


def _assignment(name: str, value: object) -> str:
    return f'{name}:={str(value).lower() if isinstance(value, bool) else value}'


@dataclass
class Heard:
    """Everything the node has published so far."""

    statuses: list[RelocalizationStatus] = field(default_factory=list)
    poses: list[PoseWithCovarianceStamped] = field(default_factory=list)
    camera_poses: list[PoseStamped] = field(default_factory=list)


class Robot:
    """The other side of the node's topics and services."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self.heard = Heard()
        self.camera_info: CameraInfo | None = None
        self._image = node.create_publisher(Image, '/image', 1)
        self._compressed = node.create_publisher(CompressedImage, '/front/image/compressed', 1)
        self._camera_info = node.create_publisher(CameraInfo, '/camera_info', 1)
        self._tf_static = node.create_publisher(TFMessage, '/tf_static', LATCHED)
        node.create_subscription(
            RelocalizationStatus, f'{NODE}/status', self.heard.statuses.append, 100
        )
        node.create_subscription(
            PoseWithCovarianceStamped, '/relocalized_pose', self.heard.poses.append, 100
        )
        node.create_subscription(
            PoseStamped, f'{NODE}/camera_pose', self.heard.camera_poses.append, 100
        )

    def connect(self, node: NodeProcess, *, compressed: bool = False) -> None:
        """Waits until the node is active, and all topics have found each other."""
        publishers = [self._compressed if compressed else self._image, self._camera_info]
        topics = ['/relocalized_pose', f'{NODE}/status', f'{NODE}/camera_pose']

        def connected() -> bool:
            assert node.alive, node.log
            return all(p.get_subscription_count() for p in publishers) and all(
                self.node.count_publishers(topic) for topic in topics
            )

        wait_for(connected, 'the node to subscribe')

    def wait_until_alone(self) -> None:
        """Waits until nobody subscribes to the images any more."""
        wait_for(lambda: not self._image.get_subscription_count(), 'the end of a subscription')

    def mount_camera(
        self, base_from_camera: pycolmap.Rigid3d = BASE_FROM_CAMERA, frame: str = CAMERA_FRAME
    ) -> None:
        qw, qx, qy, qz = map(float, quaternion_wxyz(base_from_camera))
        x, y, z = map(float, base_from_camera.translation)
        transform = Transform(
            translation=Vector3(x=x, y=y, z=z), rotation=Quaternion(x=qx, y=qy, z=qz, w=qw)
        )
        header = Header(frame_id='base_link')
        self._tf_static.publish(
            TFMessage(
                transforms=[
                    TransformStamped(header=header, child_frame_id=frame, transform=transform)
                ]
            )
        )

    def show(self, image: Image | CompressedImage) -> None:
        """Publishes an image as a driver does, with its calibration."""
        if self.camera_info is not None:
            self._camera_info.publish(self.camera_info)
        publisher = self._compressed if isinstance(image, CompressedImage) else self._image
        publisher.publish(image)

    def ask(self, image: Image | CompressedImage) -> RelocalizationStatus:
        """Shows an image until the node has said its verdict on it."""
        self.show(image)
        return wait_for(lambda: self.verdict_on(image), 'a status for the image')

    def wait_for_first_fix(self, pixels: NDArray[np.uint8], stamps: Iterator[float]) -> None:
        """Until the node has heard mount and calibration, which come by topics of their own."""
        wait_for(lambda: self.ask(image_message(pixels, next(stamps))).accepted, 'the first fix')

    def verdict_on(self, image: Image | CompressedImage) -> RelocalizationStatus | None:
        return _of_stamp(self.heard.statuses, image.header.stamp)

    def fix_of(self, image: Image | CompressedImage) -> PoseWithCovarianceStamped:
        return wait_for(
            lambda: _of_stamp(self.heard.poses, image.header.stamp), 'a pose for the image'
        )

    def change_state(self, transition: int) -> bool:
        self.state()  # so that the two ends have found each other: this must not be asked twice
        request = ChangeState.Request(transition=Transition(id=transition))
        answer = self._call(ChangeState, f'{NODE}/change_state', request, patience=LIMIT_S)
        return bool(answer.success)

    def request_state(self, transition: int) -> None:
        """As `change_state`, for a request that gets no answer."""
        self.state()
        client = self.node.create_client(ChangeState, f'{NODE}/change_state')
        assert client.wait_for_service(LIMIT_S)
        client.call_async(ChangeState.Request(transition=Transition(id=transition)))

    def state(self) -> str:
        response = self._call(GetState, f'{NODE}/get_state', GetState.Request())
        return str(response.current_state.label)

    def set_parameter(self, name: str, value: object) -> tuple[bool, str]:
        request = SetParameters.Request(
            parameters=[Parameter(name, value=value).to_parameter_msg()]
        )
        result = self._call(SetParameters, f'{NODE}/set_parameters', request).results[0]
        return bool(result.successful), str(result.reason)

    def _call(self, kind: type, name: str, request: object, patience: float = PATIENCE_S) -> Any:  # noqa: ANN401 - a response
        """The answer; asked again, as DDS can lose a request while both ends find each other."""
        client = self.node.create_client(kind, name)
        assert client.wait_for_service(LIMIT_S), name
        asked = time.monotonic()
        futures = [client.call_async(request)]

        def answered() -> Any:  # noqa: ANN401
            nonlocal asked
            if time.monotonic() > asked + patience:
                asked = time.monotonic()
                futures.append(client.call_async(request))
            return next((future for future in futures if future.done()), None)

        future = wait_for(answered, name)
        self.node.destroy_client(client)
        return future.result()


def _of_stamp(messages: list[T], stamp: Time) -> T | None:
    return next((message for message in messages if message.header.stamp == stamp), None)


def image_message(
    pixels: NDArray[np.uint8], stamp: float, encoding: str = 'rgb8', frame: str = CAMERA_FRAME
) -> Image:
    """Pixels [H,W,C] as a message."""
    return Image(
        header=Header(stamp=time_message(stamp), frame_id=frame),
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        step=pixels.strides[0],
        data=pixels.tobytes(),
    )


def time_message(seconds: float) -> Time:
    whole, rest = divmod(round(seconds * 1e9), 10**9)
    return Time(sec=whole, nanosec=rest)


def camera_info(camera: pycolmap.Camera) -> CameraInfo:
    """The calibration of a pinhole camera, the way ROS counts pixels."""
    fx, fy, cx, cy = map(float, camera.params)
    cx, cy = cx - 0.5, cy - 0.5
    return CameraInfo(
        header=Header(frame_id=CAMERA_FRAME),
        width=camera.width,
        height=camera.height,
        distortion_model='plumb_bob',
        d=[0.0] * 5,
        k=[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        p=[fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    )


@contextmanager
def spinning_node(name: str) -> Iterator[Node]:
    """A node in this process with a thread of its own."""
    context = rclpy.Context()
    rclpy.init(args=[], context=context)
    node = rclpy.create_node(name, context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    thread = threading.Thread(target=_spin, args=(executor,))
    thread.start()
    try:
        yield node
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
