# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""A robot for the node: publishes what sensors publish, hears what the node says."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar
from uuid import uuid4

import numpy as np
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

from gam_relocalizer.geometry import pose_error, quaternion_wxyz, rigid3d_from
from gam_relocalizer_msgs.msg import RelocalizationStatus

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    import pycolmap
    from geometry_msgs.msg import Pose
    from numpy.typing import NDArray
    from rclpy.client import Client
    from rclpy.node import Node
    from tiny_place import TinyPlace

T = TypeVar('T')
REPOSITORY = Path(__file__).parents[2]
NODE = '/gam_relocalizer'
MARK = 'GAM_RELOCALIZER_TEST'
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
POSITION_TOLERANCE_M, ROTATION_TOLERANCE_DEG = 0.05, 1.0
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
        self._mark = uuid4().hex  # whoever is left of it can be found by it
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
                env=os.environ | {MARK: self._mark},
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

    def end_cleanly(self, *signals: signal.Signals) -> None:
        """As `stop`; it must end with 0, complain of nothing, and leave nobody behind."""
        code = self.stop(*signals)
        assert code == 0, f'ended with {code}: {self.log}'
        assert 'Traceback' not in self.log, self.log
        assert _processes_with(f'{MARK}={self._mark}') == []


def _processes_with(setting: str) -> list[int]:
    """Processes that were started with a setting in their environment."""
    found = []
    for environment in Path('/proc').glob('[0-9]*/environ'):
        try:
            settings = environment.read_bytes().split(b'\0')
        except OSError:  # somebody else's, or ended meanwhile
            continue
        if setting.encode() in settings:
            found.append(int(environment.parent.name))
    return found


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

    def __init__(
        self,
        node: Node,
        namespace: str = '',
        pose_topic: str = '/relocalized_pose',
        image_topic: str = 'image',
        base_frame: str = 'base_link',
    ) -> None:
        """Publishes nothing yet.

        Args:
            node: Its own.
            namespace: That of the relocalizer, whose `image` and the like are relative to it.
            pose_topic: What `/relocalized_pose` is remapped to.
            image_topic: What `image` is remapped to, in that namespace.
            base_frame: That the camera is mounted on.
        """
        self.node = node
        self.heard = Heard()
        self.camera_info: CameraInfo | None = None
        self.stamps = count(1000.0, 0.25)
        self._relocalizer = namespace + NODE
        self._namespace = namespace
        self._pose_topic = pose_topic
        self._image_topic = f'{namespace}/{image_topic}'
        self._base_frame = base_frame
        self._tf_static = node.create_publisher(TFMessage, f'{namespace}/tf_static', LATCHED)
        self._compressed = node.create_publisher(CompressedImage, '/front/image/compressed', 1)
        self._switch_camera_on()
        hear = node.create_subscription
        hear(RelocalizationStatus, self.topic('status'), self.heard.statuses.append, 100)
        hear(PoseWithCovarianceStamped, pose_topic, self.heard.poses.append, 100)
        hear(PoseStamped, self.topic('camera_pose'), self.heard.camera_poses.append, 100)

    def _switch_camera_on(self) -> None:
        create = self.node.create_publisher
        self._image = create(Image, self._image_topic, 1)
        self._camera_info = create(CameraInfo, f'{self._namespace}/camera_info', 1)

    def restart_camera(self) -> None:
        """The driver ends and starts again."""
        self.node.destroy_publisher(self._image)
        self.node.destroy_publisher(self._camera_info)
        self._switch_camera_on()

    def topic(self, name: str) -> str:
        """The name of a topic or service that the node calls `~/name`."""
        return f'{self._relocalizer}/{name}'

    def connect(self, node: NodeProcess, *, compressed: bool = False) -> None:
        """Waits until the node is active, and all topics have found each other."""

        def connected() -> bool:
            assert node.alive, node.log
            return self.is_connected(compressed=compressed)

        wait_for(connected, 'the node to subscribe')

    def is_connected(self, *, compressed: bool = False) -> bool:
        publishers = [self._compressed if compressed else self._image, self._camera_info]
        topics = [self._pose_topic, self.topic('status'), self.topic('camera_pose')]
        return all(p.get_subscription_count() for p in publishers) and all(
            self.node.count_publishers(topic) for topic in topics
        )

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
        header = Header(frame_id=self._base_frame)
        self._tf_static.publish(
            TFMessage(
                transforms=[
                    TransformStamped(header=header, child_frame_id=frame, transform=transform)
                ]
            )
        )

    def shot(self, pixels: NDArray[np.uint8], **changes: Any) -> Image:  # noqa: ANN401
        """An image message that is newer than all before."""
        return image_message(pixels, next(self.stamps), **changes)

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

    def assert_at(self, image: Image | CompressedImage, base_from_map: pycolmap.Rigid3d) -> None:
        """The node must have published that pose for an image."""
        fix = self.fix_of(image)
        error = pose_error(rigid3d_of(fix.pose.pose).inverse(), base_from_map)
        assert error.position < POSITION_TOLERANCE_M
        assert error.rotation_deg < ROTATION_TOLERANCE_DEG

    def refusal_of(
        self,
        image: Image | CompressedImage,
        good: Callable[[], Image | CompressedImage],
    ) -> RelocalizationStatus:
        """The status of an image that gets no fix; a good one after it has to get one."""
        status = self.ask(image)
        assert not status.accepted, status.reason
        assert status.reason
        # one connection keeps its order: once the next fix is here, a pose would have come before
        after = good()
        assert self.ask(after).accepted
        self.fix_of(after)
        assert _of_stamp(self.heard.poses, image.header.stamp) is None
        return status

    def change_state(self, transition: int) -> bool:
        self.state()  # so that the two ends have found each other: this must not be asked twice
        request = ChangeState.Request(transition=Transition(id=transition))
        answer = self.call(ChangeState, self.topic('change_state'), request, patience=LIMIT_S)
        return bool(answer.success)

    def request_state(self, transition: int) -> None:
        """As `change_state`, for a request that gets no answer."""
        self.state()
        client = self.node.create_client(ChangeState, self.topic('change_state'))
        assert client.wait_for_service(LIMIT_S)
        client.call_async(ChangeState.Request(transition=Transition(id=transition)))

    def state(self) -> str:
        response = self.call(GetState, self.topic('get_state'), GetState.Request())
        return str(response.current_state.label)

    def set_parameter(self, name: str, value: object) -> tuple[bool, str]:
        request = SetParameters.Request(
            parameters=[Parameter(name, value=value).to_parameter_msg()]
        )
        result = self.call(SetParameters, self.topic('set_parameters'), request).results[0]
        return bool(result.successful), str(result.reason)

    def call(
        self,
        kind: type,
        name: str,
        request: object,
        patience: float = PATIENCE_S,
        meanwhile: Callable[[], None] = lambda: None,
    ) -> Any:  # noqa: ANN401 - a response
        """The answer of a service to a client of its own; see `request`."""
        client = self.node.create_client(kind, name)
        answer = self.request(client, request, patience, meanwhile)
        self.node.destroy_client(client)
        return answer

    @staticmethod
    def request(
        client: Client,
        request: object,
        patience: float = PATIENCE_S,
        meanwhile: Callable[[], None] = lambda: None,
    ) -> Any:  # noqa: ANN401 - a response
        """The answer; asked again, as DDS can lose a request while both ends find each other.

        `meanwhile` is called again and again until then. The next request of this client will not
        be lost, and the one before has been taken.
        """
        assert client.wait_for_service(LIMIT_S), client.srv_name
        asked = time.monotonic()
        futures = [client.call_async(request)]

        def answered() -> Any:  # noqa: ANN401
            nonlocal asked
            if time.monotonic() > asked + patience:
                asked = time.monotonic()
                futures.append(client.call_async(request))
            meanwhile()
            return next((future for future in futures if future.done()), None)

        return wait_for(answered, client.srv_name).result()


def _of_stamp(messages: list[T], stamp: Time) -> T | None:
    return next((message for message in messages if message.header.stamp == stamp), None)


def rigid3d_of(pose: Pose) -> pycolmap.Rigid3d:
    """A pose of a message, whose quaternion must have unit length."""
    q, t = pose.orientation, pose.position
    assert abs(np.linalg.norm([q.w, q.x, q.y, q.z]) - 1.0) < 1e-9
    return rigid3d_from((q.w, q.x, q.y, q.z), (t.x, t.y, t.z))


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
def node_process(log: Path, *arguments: str, **options: Any) -> Iterator[NodeProcess]:  # noqa: ANN401
    """A node that has to end cleanly."""
    node = NodeProcess(log, *arguments, **options)
    try:
        yield node
        node.end_cleanly()
    finally:
        node.process.kill()
        node.process.wait()


@contextmanager
def running_node(
    log: Path,
    tiny_place: TinyPlace,
    **options: Any,  # noqa: ANN401
) -> Iterator[tuple[NodeProcess, Robot]]:
    """A node with the map of the tiny place that has had its first fix, and its robot.

    Args:
        log: File for what the node says.
        tiny_place: Where the robot is.
        options: Of `NodeProcess`.
    """
    with (
        node_process(log, '--map', str(tiny_place.map_path), **options) as node,
        spinning_node('robot') as own,
    ):
        robot = Robot(own, base_frame=options.get('base_frame', 'base_link'))
        robot.mount_camera()
        robot.connect(node)
        robot.camera_info = camera_info(tiny_place.camera)
        robot.wait_for_first_fix(tiny_place.queries[0][0], robot.stamps)
        yield node, robot


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
