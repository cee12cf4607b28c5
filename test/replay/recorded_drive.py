# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""A small world with known truth: a map of points on walls, a drive through it, and its bag."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from gam_relocalizer.geometry import quaternion_wxyz, rigid3d_from_rotation
from gam_relocalizer.localization.result import (
    LocalizationResult,
    PoseEstimate,
    Status,
    Support,
    Timings,
)
from gam_relocalizer.scene_map import (
    ExtractorIdentity,
    Manifest,
    MapContent,
    MapFrame,
    SceneMap,
    map_in_memory,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.localization.prior import Prior

SECOND = 10**9
START_NS = 1_700_000_000 * SECOND + 123_456_789
RATE_HZ = 10
WIDTH, HEIGHT, FOCAL = 64, 48, 60.0

# The camera looks along the base's x axis: optical z forward, x right, y down.
BASE_FROM_CAMERA = rigid3d_from_rotation(
    Rotation.from_matrix([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), [0.2, 0.05, 0.8]
)

TYPESTORE = get_typestore(Stores.ROS2_JAZZY)


def stamp_of(index: int) -> int:
    return START_NS + index * SECOND // RATE_HZ


def map_from_base_at(index: int) -> pycolmap.Rigid3d:
    """A gentle left turn on the floor."""
    angle = 0.02 * index
    return rigid3d_from_rotation(
        Rotation.from_euler('z', angle), [2.0 * np.sin(angle), 2.0 - 2.0 * np.cos(angle), 0.0]
    )


def camera_from_map_at(index: int) -> pycolmap.Rigid3d:
    return (map_from_base_at(index) * BASE_FROM_CAMERA).inverse()


def grey_image(index: int) -> NDArray[np.uint8]:
    """An image that carries its own index, so that a localizer can know where it is."""
    return np.full((HEIGHT, WIDTH), index, dtype=np.uint8)


@dataclass
class KnowingLocalizer:
    """Reads the index of an image from its pixels and answers with the truth, but for mistakes.

    It finds no pose for the images to refuse, and does not believe in those to doubt.
    """

    points: NDArray[np.float64]
    refuse: Sequence[int] = ()
    seen: list[int] = field(default_factory=list)
    cameras: list[pycolmap.Camera] = field(default_factory=list)
    priors: list[Prior | None] = field(default_factory=list)
    mistaken: dict[int, int] = field(default_factory=dict)
    doubt: Sequence[int] = ()

    def localize(
        self, image: NDArray[np.uint8], camera: pycolmap.Camera, prior: Prior | None = None
    ) -> LocalizationResult:
        index = int(np.median(image))
        self.seen.append(index)
        self.cameras.append(camera)
        self.priors.append(prior)
        timings = Timings(extraction=10.0, retrieval=1.0, matching=5.0 + index, pose=2.0)
        if index in self.refuse:
            reason = '3 inliers; needs 20 <inliers>'
            return LocalizationResult(Status.TOO_FEW_INLIERS, reason, timings=timings)
        estimate = estimate_at(self.mistaken.get(index, index), camera, self.points)
        if index in self.doubt:
            reason = 'two places look & match alike'
            return LocalizationResult(Status.AMBIGUOUS, reason, estimate, timings=timings)
        return LocalizationResult(Status.ACCEPTED, 'good', estimate, timings=timings)


def estimate_at(index: int, camera: pycolmap.Camera, points: NDArray[np.float64]) -> PoseEstimate:
    camera_from_map = camera_from_map_at(index)
    in_camera = points @ camera_from_map.rotation.matrix().T + camera_from_map.translation
    pixels = np.asarray(camera.img_from_cam(in_camera)).reshape(-1, 2)
    inside = (in_camera[:, 2] > 0.1) & (pixels > 0).all(axis=1)
    inside &= (pixels < [camera.width, camera.height]).all(axis=1)
    chosen = np.flatnonzero(inside)[: 30 + index % 7]
    return PoseEstimate(
        camera_from_map=camera_from_map,
        covariance=np.diag([1e-4, 4e-4, 1e-4, 1e-5, 1e-5, 1e-5]),
        inlier_keypoints=(pixels[chosen] + 0.3).astype(np.float32),
        inlier_features=chosen,
        inlier_points=chosen,
        inlier_ratio=0.5,
        coverage=0.6,
        reprojection_error=0.4,
        support=Support(in_view=500, unmatched=0.1),
        belief=0.99,
    )


def wall_map_at(path: Path) -> SceneMap:
    """Points on the walls of a room, seen by cameras along the drive."""
    random = np.random.default_rng(3)
    around = random.uniform(-np.pi, np.pi, 2000)
    points = np.column_stack(
        [5.0 * np.cos(around), 5.0 * np.sin(around), random.uniform(0.0, 2.5, len(around))]
    )
    references = range(0, 100, 20)
    return map_in_memory(
        path,
        MapContent(
            image_names=tuple(f'{index}.jpg' for index in references),
            camera_from_sfm=tuple(camera_from_map_at(index) for index in references),
            points=points,
            descriptors=np.zeros((len(points), 4), dtype=np.float16),
            observation_offsets=np.zeros(len(references) + 1, dtype=np.int64),
            observation_points=np.zeros(0, dtype=np.int32),
            global_descriptors=np.zeros((len(references), 4), dtype=np.float32),
            codebook=np.zeros((1, 4), dtype=np.float32),
        ),
        Manifest(
            extractor=ExtractorIdentity('none', 4, ''),
            retrieval='none',
            frame=MapFrame(metric=True),
            counts={'images': len(references), 'points': len(points), 'observations': 0},
        ),
    )


class BagWriter:
    """Writes messages by their fields."""

    def __init__(self, path: Path, storage: StoragePlugin) -> None:
        self._writer = Writer(path, version=9, storage_plugin=storage)
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> BagWriter:
        self._writer.open()
        return self

    def __exit__(self, *_error: object) -> None:
        self._writer.close()

    def topic(self, topic: str, msgtype: str) -> None:
        self._connections[topic] = self._writer.add_connection(topic, msgtype, typestore=TYPESTORE)

    def write(self, topic: str, msgtype: str, log_ns: int, **fields: Any) -> None:  # noqa: ANN401
        if topic not in self._connections:
            self.topic(topic, msgtype)
        data = TYPESTORE.serialize_cdr(new(msgtype, **fields), msgtype)
        self._writer.write(self._connections[topic], log_ns, data)

    def image(self, index: int, topic: str = '/camera/image', **changes: Any) -> None:  # noqa: ANN401
        pixels = grey_image(index)
        fields: dict[str, Any] = {
            'header': header(stamp_of(index), 'camera_optical'),
            'height': HEIGHT, 'width': WIDTH, 'encoding': 'mono8', 'is_bigendian': 0,
            'step': WIDTH, 'data': pixels.ravel(),
        }  # fmt: skip
        self.write(topic, 'sensor_msgs/msg/Image', stamp_of(index), **(fields | changes))

    def compressed_image(self, index: int, topic: str = '/camera/image/compressed') -> None:
        self.write(
            topic, 'sensor_msgs/msg/CompressedImage', stamp_of(index),
            header=header(stamp_of(index), 'camera_optical'),
            format='png', data=cv2.imencode('.png', grey_image(index))[1].ravel(),
        )  # fmt: skip

    def camera_info(
        self, index: int, topic: str = '/camera/camera_info', *, focal: float = FOCAL
    ) -> None:
        k = [focal, 0.0, WIDTH / 2 - 0.5, 0.0, focal, HEIGHT / 2 - 0.5, 0.0, 0.0, 1.0]
        roi = new(
            'sensor_msgs/msg/RegionOfInterest',
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False,
        )  # fmt: skip
        self.write(
            topic, 'sensor_msgs/msg/CameraInfo', stamp_of(index),
            header=header(stamp_of(index), 'camera_optical'),
            height=HEIGHT, width=WIDTH, distortion_model='plumb_bob', d=np.zeros(5),
            k=np.array(k), r=np.eye(3).ravel(), p=np.zeros(12), binning_x=0, binning_y=0, roi=roi,
        )  # fmt: skip

    def transform(
        self, parent: str, child: str, parent_from_child: pycolmap.Rigid3d, stamp_ns: int,
        topic: str = '/tf_static',
    ) -> None:  # fmt: skip
        transform = new(
            'geometry_msgs/msg/Transform',
            translation=vector('geometry_msgs/msg/Vector3', parent_from_child.translation),
            rotation=quaternion(parent_from_child),
        )
        stamped = new(
            'geometry_msgs/msg/TransformStamped',
            header=header(stamp_ns, parent), child_frame_id=child, transform=transform,
        )  # fmt: skip
        self.write(topic, 'tf2_msgs/msg/TFMessage', stamp_ns, transforms=[stamped])

    def odometry(self, index: int, child_frame: str = 'base_link') -> None:
        """Odometry without drift, from a frame that lies elsewhere."""
        odom_from_map = rigid3d_from_rotation(Rotation.from_euler('z', 1.0), [7.0, -3.0, 0.0])
        odom_from_base = odom_from_map * map_from_base_at(index)
        fields = odometry_fields(pose(odom_from_base), child_frame)
        head = header(stamp_of(index), 'odom')
        self.write('/odom', 'nav_msgs/msg/Odometry', stamp_of(index), header=head, **fields)

    def truth(
        self, index: int, frame: str = 'map', msgtype: str = 'geometry_msgs/msg/PoseStamped'
    ) -> None:
        true_pose = pose(map_from_base_at(index))
        fields: dict[str, Any] = {'pose': true_pose}
        if msgtype == 'geometry_msgs/msg/PoseWithCovarianceStamped':
            fields['pose'] = with_covariance('geometry_msgs/msg/PoseWithCovariance', true_pose)
        if msgtype == 'nav_msgs/msg/Odometry':
            fields = odometry_fields(true_pose, 'base_link')
        head = header(stamp_of(index), frame)
        self.write('/ground_truth', msgtype, stamp_of(index), header=head, **fields)


def new(msgtype: str, **fields: Any) -> Any:  # noqa: ANN401
    return TYPESTORE.types[msgtype](**fields)


def header(stamp_ns: int, frame: str) -> Any:  # noqa: ANN401
    seconds, nanoseconds = divmod(stamp_ns, SECOND)
    stamp = new('builtin_interfaces/msg/Time', sec=seconds, nanosec=nanoseconds)
    return new('std_msgs/msg/Header', stamp=stamp, frame_id=frame)


def vector(msgtype: str, values: NDArray[np.float64]) -> Any:  # noqa: ANN401
    x, y, z = (float(value) for value in values)
    return new(msgtype, x=x, y=y, z=z)


def quaternion(transform: pycolmap.Rigid3d) -> Any:  # noqa: ANN401
    w, x, y, z = (float(value) for value in quaternion_wxyz(transform))
    return new('geometry_msgs/msg/Quaternion', x=x, y=y, z=z, w=w)


def odometry_fields(body_pose: Any, child_frame: str) -> dict[str, Any]:  # noqa: ANN401
    zero = vector('geometry_msgs/msg/Vector3', np.zeros(3))
    twist = new('geometry_msgs/msg/Twist', linear=zero, angular=zero)
    return {
        'pose': with_covariance('geometry_msgs/msg/PoseWithCovariance', body_pose),
        'twist': with_covariance('geometry_msgs/msg/TwistWithCovariance', twist),
        'child_frame_id': child_frame,
    }


def with_covariance(msgtype: str, value: Any) -> Any:  # noqa: ANN401
    name = 'twist' if 'Twist' in msgtype else 'pose'
    return new(msgtype, **{name: value, 'covariance': np.zeros(36)})


def pose(transform: pycolmap.Rigid3d) -> Any:  # noqa: ANN401
    return new(
        'geometry_msgs/msg/Pose',
        position=vector('geometry_msgs/msg/Point', transform.translation),
        orientation=quaternion(transform),
    )


def write_bag(
    path: Path,
    fill: Callable[[BagWriter], None],
    storage: StoragePlugin = StoragePlugin.MCAP,
) -> Path:
    with BagWriter(path, storage) as bag:
        fill(bag)
    return path


def fill_drive(bag: BagWriter, images: int = 100) -> None:
    """Ten seconds with everything a replay can use; the mount comes late, as bags have it."""
    for index in range(images):
        bag.image(index)
        bag.camera_info(index)
        bag.truth(index)
        if index == 5:
            bag.transform('base_link', 'camera_optical', BASE_FROM_CAMERA, stamp_of(index))


def fill_with_odometry(bag: BagWriter) -> None:
    """The same drive, with odometry."""
    for index in range(100):
        bag.odometry(index)
    fill_drive(bag)
