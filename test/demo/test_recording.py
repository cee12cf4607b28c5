# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pycolmap
import pytest
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability
from rosbags.rosbag2 import Reader, StoragePlugin

from gam_relocalizer.cameras import CameraCalibration, camera_from_calibration, parse_camera
from gam_relocalizer.demo import recording, trajectories
from gam_relocalizer.demo.renderer import Renderer
from gam_relocalizer.geometry import pose_error, read_poses, rigid3d_from

if TYPE_CHECKING:
    from pathlib import Path

    from gam_relocalizer.demo.world import World

DURATION = 1.1
IMAGES = 6


@pytest.fixture(scope='module')
def bag_camera() -> pycolmap.Camera:
    return pycolmap.Camera(
        camera_id=1, model='PINHOLE', width=80, height=60, params=[55.0, 56.0, 39.5, 30.75]
    )


@pytest.fixture(scope='module')
def bag(tiny: World, bag_camera: pycolmap.Camera, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp('bags') / 'drive'
    recording.record_query_bag(tiny, path, duration_s=DURATION, camera=bag_camera, workers=1)
    return path


def _messages(path: Path, topic: str) -> list[tuple[int, object]]:
    with AnyReader([path]) as reader:
        connections = [c for c in reader.connections if c.topic == topic]
        return [
            (log_ns, reader.deserialize(raw, connection.msgtype))
            for connection, log_ns, raw in reader.messages(connections=connections)
        ]


def _rigid(translation: object, rotation: object) -> pycolmap.Rigid3d:
    return rigid3d_from(
        (rotation.w, rotation.x, rotation.y, rotation.z),
        (translation.x, translation.y, translation.z),
    )


def _stamp_ns(message: object) -> int:
    stamp = message.header.stamp
    return stamp.sec * 10**9 + stamp.nanosec


def _digests(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob('*'))
        if path.is_file()
    }


def test_mapping_pass_is_images_with_their_camera_and_poses(
    tiny: World, small_camera: pycolmap.Camera, tmp_path: Path
) -> None:
    views = trajectories.mapping_views(tiny.mapping_route)[:4]
    calls: list[tuple[int, int]] = []
    out = tmp_path / 'pass'
    recording.record_mapping_pass(
        tiny,
        out,
        views=views,
        camera=small_camera,
        workers=1,
        progress=lambda done, total: calls.append((done, total)),
    )
    poses = read_poses(out / 'poses.txt')
    assert sorted(path.name for path in (out / 'images').iterdir()) == sorted(poses)
    assert len(poses) == 4
    for view, written in zip(views, poses.values(), strict=True):
        error = pose_error(written, view)
        assert error.position < 1e-9
        assert error.rotation_deg < 1e-5
    camera = parse_camera(out / 'camera.txt')
    np.testing.assert_array_equal(camera.params, small_camera.params)
    assert calls == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert list(tmp_path.iterdir()) == [out]
    truth = Renderer(tiny, recording.mapping_appearance(tiny)).render(small_camera, [views[2]], 2)
    image = cv2.cvtColor(cv2.imread(str(out / 'images' / '0002.jpg')), cv2.COLOR_BGR2RGB)
    assert np.abs(image.astype(int) - truth).mean() < 4.0


def test_images_of_the_drive_show_what_the_bag_shows(
    tiny: World, bag: Path, bag_camera: pycolmap.Camera, tmp_path: Path
) -> None:
    out = tmp_path / 'drive'
    recording.record_drive_images(
        tiny, out, period_s=0.2, duration_s=DURATION, camera=bag_camera, workers=1
    )
    drive = trajectories.drive(tiny.drive_route)
    poses = read_poses(out / 'poses.txt')
    recorded = [message for _, message in _messages(bag, recording.IMAGE_TOPIC)]
    assert len(poses) == len(recorded) == IMAGES
    for index, (name, message) in enumerate(zip(sorted(poses), recorded, strict=True)):
        error = pose_error(poses[name], drive.camera_from_map(0.2 * index))
        assert error.position < 1e-9
        assert error.rotation_deg < 1e-5
        image = cv2.cvtColor(cv2.imread(str(out / 'images' / name)), cv2.COLOR_BGR2RGB)
        same = message.data.reshape(image.shape).astype(int)
        assert np.abs(image - same).mean() < 4.0
    camera = parse_camera(out / 'camera.txt')
    np.testing.assert_array_equal(camera.params, bag_camera.params)


def test_worker_processes_render_the_same_bytes(
    tiny: World, small_camera: pycolmap.Camera, tmp_path: Path
) -> None:
    views = trajectories.mapping_views(tiny.mapping_route)[:6]
    for name, workers in (('alone', 1), ('pair', 2)):
        recording.record_mapping_pass(
            tiny, tmp_path / name, views=views, camera=small_camera, workers=workers
        )
    assert _digests(tmp_path / 'alone') == _digests(tmp_path / 'pair')


def test_failure_leaves_nothing_and_keeps_the_recording_of_before(
    tiny: World, small_camera: pycolmap.Camera, tmp_path: Path
) -> None:
    views = trajectories.mapping_views(tiny.mapping_route)[:2]
    out = tmp_path / 'pass'
    recording.record_mapping_pass(tiny, out, views=views, camera=small_camera, workers=1)
    before = _digests(tmp_path)

    def stop(*_: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        recording.record_mapping_pass(
            tiny, out, views=views[:1], camera=small_camera, workers=1, progress=stop
        )
    assert _digests(tmp_path) == before
    recording.record_mapping_pass(tiny, out, views=views[:1], camera=small_camera, workers=1)
    assert len(read_poses(out / 'poses.txt')) == 1
    assert list(tmp_path.iterdir()) == [out]


def test_bag_has_the_topics_of_a_robot(bag: Path) -> None:
    with Reader(bag) as reader:
        found = {c.topic: (c.msgtype, c.msgcount) for c in reader.connections}
    assert found == {
        '/camera/image': ('sensor_msgs/msg/Image', IMAGES),
        '/camera/camera_info': ('sensor_msgs/msg/CameraInfo', IMAGES),
        '/odom': ('nav_msgs/msg/Odometry', 28),
        '/ground_truth': ('geometry_msgs/msg/PoseStamped', IMAGES),
        '/tf_static': ('tf2_msgs/msg/TFMessage', 1),
    }


def test_static_transforms_are_latched_and_compose_to_the_mount(bag: Path) -> None:
    with Reader(bag) as reader:
        (static,) = (c for c in reader.connections if c.topic == '/tf_static')
        assert static.ext.offered_qos_profiles[0].durability == QosDurability.TRANSIENT_LOCAL
    ((_, message),) = _messages(bag, '/tf_static')
    links = {(t.header.frame_id, t.child_frame_id): t.transform for t in message.transforms}
    body = links['base_link', 'camera_link']
    optical = links['camera_link', 'camera_optical_frame']
    base_from_camera = _rigid(body.translation, body.rotation) * _rigid(
        optical.translation, optical.rotation
    )
    np.testing.assert_allclose(
        base_from_camera.matrix(), trajectories.BASE_FROM_CAMERA.matrix(), atol=1e-12
    )


def test_truth_lies_on_the_drive_at_every_image_stamp(bag: Path, tiny: World) -> None:
    drive = trajectories.drive(tiny.drive_route)
    images = [_stamp_ns(message) for _, message in _messages(bag, '/camera/image')]
    truth = _messages(bag, '/ground_truth')
    assert [_stamp_ns(message) for _, message in truth] == images
    for (_, message), stamp_ns in zip(truth, images, strict=True):
        assert message.header.frame_id == 'map'
        expected = drive.map_from_base((stamp_ns - recording.START_NS) / 1e9)
        written = _rigid(message.pose.position, message.pose.orientation)
        assert pose_error(written.inverse(), expected.inverse()).position < 1e-9


def test_images_show_the_room_from_the_true_camera(
    bag: Path, tiny: World, bag_camera: pycolmap.Camera
) -> None:
    renderer = Renderer(tiny, recording.drive_appearance(tiny))
    truth = _messages(bag, '/ground_truth')
    for index in (0, 5):
        _, image = _messages(bag, '/camera/image')[index]
        assert (image.height, image.width, image.encoding) == (60, 80, 'rgb8')
        assert image.header.frame_id == 'camera_optical_frame'
        pose = truth[index][1].pose
        map_from_base = _rigid(pose.position, pose.orientation)
        camera_from_map = (map_from_base * trajectories.BASE_FROM_CAMERA).inverse()
        expected = renderer.render(bag_camera, [camera_from_map], noise_seed=index)
        assert np.abs(image.data.reshape(60, 80, 3).astype(int) - expected).mean() < 3.0


def test_camera_info_is_the_camera(bag: Path, bag_camera: pycolmap.Camera) -> None:
    _, info = _messages(bag, '/camera/camera_info')[0]
    calibration = CameraCalibration(
        info.width, info.height, info.distortion_model, tuple(info.d), tuple(info.k), tuple(info.p)
    )
    for image_is_rectified in (False, True):
        camera = camera_from_calibration(calibration, image_is_rectified=image_is_rectified)
        np.testing.assert_allclose(camera.params, bag_camera.params)


def test_log_times_are_the_stamps_in_order(bag: Path) -> None:
    with AnyReader([bag]) as reader:
        logged = [log_ns for _, log_ns, _ in reader.messages()]
        assert logged == sorted(logged)
        assert logged[0] == recording.START_NS
    for topic in ('/camera/image', '/odom', '/ground_truth', '/camera/camera_info'):
        assert all(log_ns == _stamp_ns(message) for log_ns, message in _messages(bag, topic))


def test_odometry_starts_at_the_identity_and_drifts(rooms: World) -> None:
    drive = trajectories.drive(rooms.drive_route)
    readings = list(recording._odometry(drive, drive.duration))
    np.testing.assert_allclose(readings[0].odom_from_base.matrix(), np.eye(4)[:3], atol=1e-12)
    start = drive.map_from_base(0.0)
    drift = [
        pose_error(
            reading.odom_from_base.inverse(),
            (start.inverse() * drive.map_from_base(reading.t)).inverse(),
        ).position
        for reading in readings
    ]
    assert drift[25] < 0.02
    assert 0.1 < drift[-1] < 3.0


@pytest.mark.parametrize('storage', [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_storages_hold_the_same_and_repeat_byte_for_byte(
    tiny: World,
    bag: Path,
    bag_camera: pycolmap.Camera,
    tmp_path: Path,
    storage: StoragePlugin,
) -> None:
    for place in ('one', 'two'):
        recording.record_query_bag(
            tiny,
            tmp_path / place / 'drive',
            storage=storage,
            duration_s=DURATION,
            camera=bag_camera,
            workers=1,
        )
    assert _digests(tmp_path / 'one') == _digests(tmp_path / 'two')
    for topic in ('/camera/image', '/odom'):
        for (_, one), (_, other) in zip(
            _messages(tmp_path / 'one' / 'drive', topic), _messages(bag, topic), strict=True
        ):
            assert repr(one) == repr(other)


def test_compressed_images_are_jpeg(
    tiny: World, bag: Path, bag_camera: pycolmap.Camera, tmp_path: Path
) -> None:
    path = tmp_path / 'drive'
    recording.record_query_bag(
        tiny, path, compressed=True, duration_s=0.0, camera=bag_camera, workers=1
    )
    ((_, message),) = _messages(path, '/camera/image/compressed')
    image = cv2.cvtColor(cv2.imdecode(message.data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
    _, raw = _messages(bag, '/camera/image')[0]
    assert np.abs(image.astype(int) - raw.data.reshape(60, 80, 3)).mean() < 8.0
    with Reader(path) as reader:
        assert '/camera/image' not in {c.topic for c in reader.connections}
