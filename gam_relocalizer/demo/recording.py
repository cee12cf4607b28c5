# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Writes the demo's two recordings: a folder of mapping images, and a robot's drive as a bag."""

from __future__ import annotations

import math
import multiprocessing
import shutil
import tempfile
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pycolmap
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from gam_relocalizer.cameras import PIXEL_CENTRE, format_camera
from gam_relocalizer.demo import trajectories
from gam_relocalizer.demo.renderer import STILL_SAMPLES, Appearance, Light, Renderer
from gam_relocalizer.geometry import rigid3d_from_rotation, rotation_of, write_poses, write_text

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray
    from rosbags.interfaces import Connection

    from gam_relocalizer.demo.trajectories import Drive
    from gam_relocalizer.demo.world import World

    Progress = Callable[[int, int], None]

IMAGE_TOPIC = '/camera/image'
COMPRESSED_TOPIC = '/camera/image/compressed'
CAMERA_INFO_TOPIC = '/camera/camera_info'
ODOMETRY_TOPIC = '/odom'
GROUND_TRUTH_TOPIC = '/ground_truth'
TF_STATIC_TOPIC = '/tf_static'
MAP_FRAME, ODOM_FRAME, BASE_FRAME = 'map', 'odom', 'base_link'
CAMERA_LINK_FRAME, CAMERA_FRAME = 'camera_link', 'camera_optical_frame'

START_NS = 1_700_000_000_000_000_000
IMAGE_RATE = 5
ODOMETRY_RATE = 25
JPEG_QUALITY = 92

# The odometry's faults: wheels taken for too large, and a heading that wanders.
ODOMETRY_SCALE = 1.02
YAW_BIAS = 0.001
YAW_WALK = 0.012

_NS = 1_000_000_000
_UNLIMITED = QosTime(9223372036, 854775807)
_STORES = get_typestore(Stores.ROS2_JAZZY)
_TYPES = _STORES.types


@dataclass(frozen=True, eq=False)
class Shot:
    """One image to render.

    Attributes:
        exposure: `camera_from_map` at even steps through the exposure.
        noise_seed: Of the sensor noise.
    """

    exposure: tuple[pycolmap.Rigid3d, ...]
    noise_seed: int


def mapping_camera() -> pycolmap.Camera:
    """The camera of the mapping walk."""
    return _camera(640, 480, 430.0, (321.5, 238.25))


def robot_camera() -> pycolmap.Camera:
    """The camera of the robot's drive; not the one of the mapping walk."""
    return _camera(640, 480, 415.0, (318.2, 243.7))


def mapping_appearance(world: World) -> Appearance:
    """All lamps on, a camera that is held still."""
    lights = tuple(Light(tuple(place), (1.0, 0.96, 0.9), 1.5) for place in world.lamps)
    return Appearance(lights, exposure=1.0, noise=0.01)


def drive_appearance(world: World) -> Appearance:
    """An evening: every third lamp off, the others warm and unequal, a moving camera's blur."""
    lights = tuple(
        Light((x + 0.5, y - 0.4, z - 0.3), (1.0, 0.85, 0.66), (1.7, 1.0, 0.0)[index % 3])
        for index, (x, y, z) in enumerate(world.lamps)
    )
    return Appearance(
        lights,
        ambient=(0.2, 0.21, 0.25),
        exposure=1.2,
        white_balance=(1.03, 1.0, 1.12),
        exposure_time=0.012,
        noise=0.018,
        vignetting=0.28,
    )


def record_mapping_pass(
    world: World,
    out_dir: Path,
    *,
    views: Sequence[pycolmap.Rigid3d] | None = None,
    camera: pycolmap.Camera | None = None,
    workers: int = 2,
    progress: Progress | None = None,
) -> None:
    """Writes `images/*.jpg`, `camera.txt` and `poses.txt` (camera_from_map).

    Args:
        world: What to photograph.
        out_dir: Folder to make or to replace.
        views: `camera_from_map` of every image; the world's own mapping walk if not given.
        camera: A pinhole camera; `mapping_camera()` if not given.
        workers: Processes that render; 1 renders in this one.
        progress: Called with the images done and their total.
    """
    camera = camera or mapping_camera()
    if views is None:
        views = trajectories.mapping_views(world.mapping_route)
    shots = [Shot((view,), seed) for seed, view in enumerate(views)]
    images = _rendered(world, mapping_appearance(world), camera, shots, workers)
    _write_images(out_dir, images, views, camera, progress)


def record_drive_images(
    world: World,
    out_dir: Path,
    *,
    period_s: float,
    duration_s: float | None = None,
    camera: pycolmap.Camera | None = None,
    workers: int = 2,
    progress: Progress | None = None,
) -> None:
    """Writes images of the robot's drive as `record_mapping_pass` writes those of the walk.

    Args:
        world: Where to drive.
        out_dir: Folder to make or to replace.
        period_s: From one image to the next [s].
        duration_s: Only this much of the drive [s]; all of it if not given.
        camera: A pinhole camera; `robot_camera()` if not given.
        workers: Processes that render; 1 renders in this one.
        progress: Called with the images done and their total.
    """
    camera = camera or robot_camera()
    appearance = drive_appearance(world)
    drive = trajectories.drive(world.drive_route)
    duration = drive.duration if duration_s is None else min(duration_s, drive.duration)
    times = [index * period_s for index in range(int(duration / period_s) + 1)]
    shots = [
        Shot(_exposure(drive, t, appearance.exposure_time, camera), seed)
        for seed, t in enumerate(times)
    ]
    images = _rendered(world, appearance, camera, shots, workers)
    _write_images(out_dir, images, [drive.camera_from_map(t) for t in times], camera, progress)


def record_query_bag(
    world: World,
    out_path: Path,
    *,
    storage: StoragePlugin = StoragePlugin.MCAP,
    compressed: bool = False,
    duration_s: float | None = None,
    camera: pycolmap.Camera | None = None,
    workers: int = 2,
    progress: Progress | None = None,
) -> None:
    """Writes the robot's drive as a rosbag2 folder.

    Args:
        world: Where to drive.
        out_path: Bag folder to make or to replace.
        storage: Storage plugin of the bag.
        compressed: Images as JPEG (sensor_msgs/CompressedImage) instead of raw.
        duration_s: Only this much of the drive [s]; all of it if not given.
        camera: A pinhole camera; `robot_camera()` if not given.
        workers: Processes that render; 1 renders in this one.
        progress: Called with the images done and their total.
    """
    camera = camera or robot_camera()
    appearance = drive_appearance(world)
    drive = trajectories.drive(world.drive_route)
    duration = drive.duration if duration_s is None else min(duration_s, drive.duration)
    times = np.arange(int(duration * IMAGE_RATE) + 1) / IMAGE_RATE
    shots = [
        Shot(_exposure(drive, float(t), appearance.exposure_time, camera), seed)
        for seed, t in enumerate(times)
    ]
    with _renamed_when_complete(out_path) as folder:
        images = _rendered(world, appearance, camera, shots, workers)
        writer = Writer(folder, version=9, storage_plugin=storage)
        with writer:
            bag = _BagTopics(writer, compressed=compressed)
            bag.write_static_transforms()
            odometry = _odometry(drive, duration)
            for done, (t, image) in enumerate(zip(times, images, strict=True), start=1):
                bag.write_odometry(odometry, until=float(t))
                bag.write_camera_info(camera, float(t))
                bag.write_image(image, float(t))
                bag.write_truth(drive.map_from_base(float(t)), float(t))
                if progress:
                    progress(done, len(shots))
            bag.write_odometry(odometry, until=math.inf)


@dataclass(frozen=True, eq=False)
class OdometryReading:
    """What the wheels say: a pose that drifts, and velocities.

    Attributes:
        t: Since the start [s].
        odom_from_base: The base in the odometry frame, the identity at the start.
        forward: Speed [m/s].
        turn_rate: About z [rad/s].
    """

    t: float
    odom_from_base: pycolmap.Rigid3d
    forward: float
    turn_rate: float


def _odometry(drive: Drive, duration: float) -> Iterator[OdometryReading]:
    """Dead reckoning with a scale error and a random walk of the heading."""
    rng = np.random.default_rng(0)
    step = 1.0 / ODOMETRY_RATE
    odom_from_base = pycolmap.Rigid3d()
    for index in range(int(duration * ODOMETRY_RATE) + 1):
        t = index * step
        if index:
            before, now = drive.map_from_base(t - step), drive.map_from_base(t)
            moved = before.inverse() * now
            slip = YAW_BIAS * step + YAW_WALK * math.sqrt(step) * rng.standard_normal()
            yaw = rotation_of(moved).as_euler('ZYX')[0] + slip
            odom_from_base = odom_from_base * rigid3d_from_rotation(
                Rotation.from_euler('z', yaw), ODOMETRY_SCALE * np.asarray(moved.translation)
            )
        forward, turn_rate = drive.velocity(t)
        yield OdometryReading(t, odom_from_base, ODOMETRY_SCALE * forward, turn_rate)


class _BagTopics:
    """The topics of the bag: makes the messages and writes them at their stamps."""

    def __init__(self, writer: Writer, *, compressed: bool) -> None:
        self._writer = writer
        self._compressed = compressed
        self._pending: OdometryReading | None = None
        sensor = _qos(QosReliability.BEST_EFFORT, QosDurability.VOLATILE, 5)
        reliable = _qos(QosReliability.RELIABLE, QosDurability.VOLATILE, 10)
        latched = _qos(QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, 1)
        if compressed:
            self._image = self._add(COMPRESSED_TOPIC, 'sensor_msgs/msg/CompressedImage', sensor)
        else:
            self._image = self._add(IMAGE_TOPIC, 'sensor_msgs/msg/Image', sensor)
        self._info = self._add(CAMERA_INFO_TOPIC, 'sensor_msgs/msg/CameraInfo', sensor)
        self._odom = self._add(ODOMETRY_TOPIC, 'nav_msgs/msg/Odometry', reliable)
        self._truth = self._add(GROUND_TRUTH_TOPIC, 'geometry_msgs/msg/PoseStamped', reliable)
        self._static = self._add(TF_STATIC_TOPIC, 'tf2_msgs/msg/TFMessage', latched)

    def write_static_transforms(self) -> None:
        """The camera's mount, once, at the start."""
        links = (
            (BASE_FRAME, CAMERA_LINK_FRAME, trajectories.BASE_FROM_CAMERA_LINK),
            (CAMERA_LINK_FRAME, CAMERA_FRAME, trajectories.CAMERA_LINK_FROM_OPTICAL),
        )
        stamped = [
            _new(
                'geometry_msgs/msg/TransformStamped',
                header=_header(0.0, parent),
                child_frame_id=child,
                transform=_new(
                    'geometry_msgs/msg/Transform',
                    translation=_new('geometry_msgs/msg/Vector3', **_xyz(transform)),
                    rotation=_quaternion(transform),
                ),
            )
            for parent, child, transform in links
        ]
        self._write(self._static, 0.0, _new('tf2_msgs/msg/TFMessage', transforms=stamped))

    def write_image(self, image: NDArray[np.uint8], t: float) -> None:
        """One RGB image [H,W,3]."""
        header = _header(t, CAMERA_FRAME)
        if self._compressed:
            data = np.frombuffer(_jpeg(image), np.uint8)
            message = _new(
                'sensor_msgs/msg/CompressedImage', header=header, format='rgb8; jpeg', data=data
            )
        else:
            message = _new(
                'sensor_msgs/msg/Image',
                header=header,
                height=image.shape[0],
                width=image.shape[1],
                encoding='rgb8',
                is_bigendian=0,
                step=image.shape[1] * 3,
                data=image.reshape(-1),
            )
        self._write(self._image, t, message)

    def write_camera_info(self, camera: pycolmap.Camera, t: float) -> None:
        """The calibration of a camera without distortion."""
        matrix = np.array(camera.calibration_matrix())
        matrix[:2, 2] -= PIXEL_CENTRE
        projection = np.hstack([matrix, np.zeros((3, 1))])
        region = _new(
            'sensor_msgs/msg/RegionOfInterest',
            x_offset=0,
            y_offset=0,
            height=0,
            width=0,
            do_rectify=False,
        )
        message = _new(
            'sensor_msgs/msg/CameraInfo',
            header=_header(t, CAMERA_FRAME),
            height=camera.height,
            width=camera.width,
            distortion_model='plumb_bob',
            d=np.zeros(5),
            k=matrix.reshape(-1),
            r=np.eye(3).reshape(-1),
            p=projection.reshape(-1),
            binning_x=0,
            binning_y=0,
            roi=region,
        )
        self._write(self._info, t, message)

    def write_truth(self, map_from_base: pycolmap.Rigid3d, t: float) -> None:
        """The true pose of the base in the map."""
        header = _header(t, MAP_FRAME)
        message = _new('geometry_msgs/msg/PoseStamped', header=header, pose=_pose(map_from_base))
        self._write(self._truth, t, message)

    def write_odometry(self, readings: Iterator[OdometryReading], *, until: float) -> None:
        """The readings up to a time, in order; a later one waits for the next call."""
        while (reading := self._pending or next(readings, None)) is not None:
            self._pending = reading
            if reading.t > until:
                return
            self._write(self._odom, reading.t, _odometry_message(reading))
            self._pending = None

    def _add(self, topic: str, kind: str, qos: Qos) -> Connection:
        return self._writer.add_connection(
            topic, kind, typestore=_STORES, offered_qos_profiles=[qos]
        )

    def _write(self, connection: Connection, t: float, message: object) -> None:
        data = _STORES.serialize_cdr(message, connection.msgtype)
        self._writer.write(connection, _stamp_ns(t), data)


def _camera(
    width: int, height: int, focal: float, principal: tuple[float, float]
) -> pycolmap.Camera:
    return pycolmap.Camera(
        camera_id=1, model='PINHOLE', width=width, height=height, params=[focal, focal, *principal]
    )


def _exposure(
    drive: Drive, t: float, exposure_time: float, camera: pycolmap.Camera
) -> tuple[pycolmap.Rigid3d, ...]:
    """Poses through the exposure around `t`: more of them where the image moves further."""
    first = drive.camera_from_map(t - exposure_time / 2)
    moved = drive.camera_from_map(t + exposure_time / 2) * first.inverse()
    # Things on the side of the robot are rarely nearer than 1.5 m.
    reach = rotation_of(moved).magnitude() + np.linalg.norm(moved.translation) / 1.5
    count = STILL_SAMPLES * (1 if reach * camera.mean_focal_length() < STILL_SAMPLES else 2)
    moments = ((np.arange(count) + 0.5) / count - 0.5) * exposure_time
    return tuple(drive.camera_from_map(t + float(moment)) for moment in moments)


def _write_images(
    out_dir: Path,
    images: Iterator[NDArray[np.uint8]],
    views: Sequence[pycolmap.Rigid3d],
    camera: pycolmap.Camera,
    progress: Progress | None,
) -> None:
    """A folder of images with their camera and poses (camera_from_map)."""
    names = [f'{index:04d}.jpg' for index in range(len(views))]
    with _renamed_when_complete(out_dir) as folder:
        (folder / 'images').mkdir(parents=True)
        for done, (name, image) in enumerate(zip(names, images, strict=True), start=1):
            (folder / 'images' / name).write_bytes(_jpeg(image))
            if progress:
                progress(done, len(views))
        write_text(folder / 'camera.txt', f'{format_camera(camera)}\n')
        write_poses(folder / 'poses.txt', dict(zip(names, views, strict=True)))


def _rendered(
    world: World,
    appearance: Appearance,
    camera: pycolmap.Camera,
    shots: Sequence[Shot],
    workers: int,
) -> Iterator[NDArray[np.uint8]]:
    """The images of the shots, in order."""
    if workers == 1:
        renderer = Renderer(world, appearance)
        for shot in shots:
            yield renderer.render(camera, shot.exposure, shot.noise_seed)
        return
    # Fresh interpreters: a fork would copy the locks of threads that a caller may run.
    with ProcessPoolExecutor(
        workers,
        mp_context=multiprocessing.get_context('spawn'),
        initializer=_start_worker,
        initargs=(world, appearance, camera),
    ) as pool:
        yield from pool.map(_render_in_worker, shots, chunksize=4)


_worker: dict[str, Any] = {}


def _start_worker(world: World, appearance: Appearance, camera: pycolmap.Camera) -> None:
    cv2.setNumThreads(1)
    _worker.update(renderer=Renderer(world, appearance), camera=camera)


def _render_in_worker(shot: Shot) -> NDArray[np.uint8]:
    image: NDArray[np.uint8] = _worker['renderer'].render(
        _worker['camera'], shot.exposure, shot.noise_seed
    )
    return image


def _jpeg(image: NDArray[np.uint8]) -> bytes:
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode('.jpg', bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return bytes(data)


@contextmanager
def _renamed_when_complete(target: Path) -> Iterator[Path]:
    """A folder to fill, of the target's name; it takes the target's place when all went well."""
    target.parent.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp(prefix=f'.{target.name}.', dir=target.parent))
    try:
        yield scratch / target.name
        if target.exists():
            target.rename(scratch / 'replaced')
        (scratch / target.name).rename(target)
    finally:
        shutil.rmtree(scratch)


def _qos(reliability: QosReliability, durability: QosDurability, depth: int) -> Qos:
    return Qos(
        QosHistory.KEEP_LAST,
        depth,
        reliability,
        durability,
        _UNLIMITED,
        _UNLIMITED,
        QosLiveliness.AUTOMATIC,
        _UNLIMITED,
        avoid_ros_namespace_conventions=False,
    )


def _stamp_ns(t: float) -> int:
    return START_NS + round(t * _NS)


def _new(kind: str, **fields: Any) -> Any:  # noqa: ANN401  (message types are made at run time)
    return _TYPES[kind](**fields)


def _header(t: float, frame: str) -> object:
    sec, nanosec = divmod(_stamp_ns(t), _NS)
    stamp = _new('builtin_interfaces/msg/Time', sec=sec, nanosec=nanosec)
    return _new('std_msgs/msg/Header', stamp=stamp, frame_id=frame)


def _xyz(transform: pycolmap.Rigid3d) -> dict[str, float]:
    x, y, z = transform.translation
    return {'x': float(x), 'y': float(y), 'z': float(z)}


def _quaternion(transform: pycolmap.Rigid3d) -> object:
    x, y, z, w = rotation_of(transform).as_quat(canonical=True)
    return _new('geometry_msgs/msg/Quaternion', x=float(x), y=float(y), z=float(z), w=float(w))


def _pose(transform: pycolmap.Rigid3d) -> object:
    point = _new('geometry_msgs/msg/Point', **_xyz(transform))
    return _new('geometry_msgs/msg/Pose', position=point, orientation=_quaternion(transform))


def _odometry_message(reading: OdometryReading) -> object:
    vector = 'geometry_msgs/msg/Vector3'
    twist = _new(
        'geometry_msgs/msg/Twist',
        linear=_new(vector, x=reading.forward, y=0.0, z=0.0),
        angular=_new(vector, x=0.0, y=0.0, z=reading.turn_rate),
    )
    covariance = np.diag([1e-3, 1e-3, 1e-6, 1e-6, 1e-6, 3e-3]).reshape(-1)
    return _new(
        'nav_msgs/msg/Odometry',
        header=_header(reading.t, ODOM_FRAME),
        child_frame_id=BASE_FRAME,
        pose=_new(
            'geometry_msgs/msg/PoseWithCovariance',
            pose=_pose(reading.odom_from_base),
            covariance=covariance,
        ),
        twist=_new(
            'geometry_msgs/msg/TwistWithCovariance', twist=twist, covariance=covariance.copy()
        ),
    )
