# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import shutil
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pycolmap
import pytest
from moving_camera import HEIGHT, WIDTH, seen_at
from recorded_drive import (
    BASE_FROM_CAMERA,
    SECOND,
    START_NS,
    BagWriter,
    header,
    map_from_base_at,
    new,
    odometry_fields,
    pose,
    stamp_of,
    write_bag,
)

from gam_relocalizer.alignment.constraints import GpsFixes, Poses, Positions
from gam_relocalizer.capture.capture import MILLISECOND
from gam_relocalizer.capture.recording import BagOptions, capture_bag
from gam_relocalizer.capture.whereabouts import WhereaboutsTopics
from gam_relocalizer.errors import BagError, CameraError, MapBuildError
from gam_relocalizer.geometry import pose_error, rigid3d_from
from gam_relocalizer.images import read_image
from gam_relocalizer.mapping.workspace import open_workspace

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from gam_relocalizer.capture.capture import Capture
    from gam_relocalizer.mapping.workspace import Workspace

IMAGES = 40
STEP_PX = 12.0
ODOM_FROM_MAP = rigid3d_from([np.cos(0.5), 0.0, 0.0, np.sin(0.5)], [7.0, -3.0, 0.0])


@pytest.fixture
def workspace(tmp_path: Path) -> Iterator[Workspace]:
    with open_workspace(tmp_path / 'map.work') as opened:
        yield opened


def grey_at(index: int) -> np.ndarray:
    return cv2.cvtColor(seen_at(STEP_PX * index), cv2.COLOR_RGB2GRAY)


def write_image(bag: BagWriter, index: int, **changes: Any) -> None:  # noqa: ANN401
    fields = {
        'height': HEIGHT,
        'width': WIDTH,
        'step': WIDTH,
        'data': grey_at(index).ravel(),
    }
    bag.image(index, **(fields | changes))


def write_info(bag: BagWriter, index: int, focal: float = 300.0, **changes: Any) -> None:  # noqa: ANN401
    k = [focal, 0.0, WIDTH / 2 - 0.5, 0.0, focal, HEIGHT / 2 - 0.5, 0.0, 0.0, 1.0]
    region = {'x_offset': 0, 'y_offset': 0, 'height': 0, 'width': 0, 'do_rectify': False}
    fields = {
        'header': header(stamp_of(index), 'camera_optical'),
        'height': HEIGHT,
        'width': WIDTH,
        'distortion_model': 'plumb_bob',
        'd': np.array([0.1, -0.02, 0.001, 0.002, 0.0]),
        'k': np.array(k),
        'r': np.eye(3).ravel(),
        'p': np.array([250.0, 0, 150, 0, 0, 250.0, 110, 0, 0, 0, 1, 0]),
        'binning_x': 0,
        'binning_y': 0,
        'roi': new('sensor_msgs/msg/RegionOfInterest', **region),
    }
    message = 'sensor_msgs/msg/CameraInfo'
    bag.write('/camera/camera_info', message, stamp_of(index), **(fields | changes))


def write_odometry(
    bag: BagWriter,
    index: int,
    odom_from_base: pycolmap.Rigid3d | None = None,
    **changes: Any,  # noqa: ANN401
) -> None:
    moved = odom_from_base or ODOM_FROM_MAP * map_from_base_at(index)
    fields = odometry_fields(pose(moved), 'base_link') | changes
    head = header(stamp_of(index), 'odom')
    bag.write('/odom', 'nav_msgs/msg/Odometry', stamp_of(index), header=head, **fields)


def write_fix(
    bag: BagWriter, index: int, latitude: float, longitude: float, *, status: int = 0
) -> None:
    fields = {
        'status': new('sensor_msgs/msg/NavSatStatus', status=status, service=1),
        'latitude': latitude,
        'longitude': longitude,
        'altitude': 100.0 + index,
        'position_covariance': np.zeros(9),
        'position_covariance_type': 0,
    }
    head = header(stamp_of(index), 'gps')
    bag.write('/fix', 'sensor_msgs/msg/NavSatFix', stamp_of(index), header=head, **fields)


def write_mount(bag: BagWriter) -> None:
    bag.transform('base_link', 'camera_optical', BASE_FROM_CAMERA, START_NS)


def everything(bag: BagWriter) -> None:
    write_mount(bag)
    for index in range(IMAGES):
        write_odometry(bag, index)
        write_info(bag, index)
        write_image(bag, index)
        if not index % 5:
            write_fix(bag, index, 50.0 + 1e-5 * index, 8.0 + 2e-5 * index)


@pytest.fixture(scope='module')
def full_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_bag(tmp_path_factory.mktemp('bags') / 'full', everything)


def capture_of(
    tmp_path: Path,
    workspace: Workspace,
    fill: Callable[[BagWriter, int], None],
    options: BagOptions | None = None,
) -> Capture:
    """Of a bag with the images of the slide and, for each index, whatever else."""

    def images_and_more(bag: BagWriter) -> None:
        for index in range(IMAGES):
            fill(bag, index)

    return capture_bag(write_bag(tmp_path / 'bag', images_and_more), workspace, options)


def indices_of(names: tuple[str, ...]) -> list[int]:
    """Of the images that became keyframes; stamps are cut to milliseconds."""
    cut = [stamp_of(index) // MILLISECOND for index in range(IMAGES)]
    return [cut.index(int(name.removesuffix('.jpg').replace('.', ''))) for name in names]


def test_keyframes_carry_the_stamps_of_their_headers(full_bag: Path, workspace: Workspace) -> None:
    capture = capture_bag(full_bag, workspace)

    names = capture.images.names
    assert capture.counts.read == IMAGES
    assert 5 < len(names) < IMAGES
    assert list(names) == sorted(names)
    for name, index in zip(names, indices_of(names), strict=True):
        shown = read_image(capture.images.folder / name)
        assert np.abs(shown[..., 0].astype(float) - grey_at(index)).mean() < 3.0
    assert capture.warnings == ()


def test_odometry_and_mount_give_poses_of_the_camera(full_bag: Path, workspace: Workspace) -> None:
    capture = capture_bag(full_bag, workspace)

    constraint = capture.references[0].constraint
    assert isinstance(constraint, Poses)
    assert set(constraint.camera_from_world) == set(capture.images.names)
    for name, index in zip(capture.images.names, indices_of(capture.images.names), strict=True):
        truth = (ODOM_FROM_MAP * map_from_base_at(index) * BASE_FROM_CAMERA).inverse()
        error = pose_error(constraint.camera_from_world[name], truth)
        assert error.position < 1e-6
        assert error.rotation_deg < 1e-4


def test_places_that_nobody_wants_to_know_are_not_looked_for(
    tmp_path: Path, workspace: Workspace
) -> None:
    def fill(bag: BagWriter) -> None:
        for index in range(5):
            write_image(bag, index)
            for topic in ('/odom', '/wheel_odom'):
                head, odom_from_base = (
                    header(stamp_of(index), 'odom'),
                    pose(map_from_base_at(index)),
                )
                fields = odometry_fields(odom_from_base, 'base_link')
                bag.write(topic, 'nav_msgs/msg/Odometry', stamp_of(index), header=head, **fields)

    bag = write_bag(tmp_path / 'drive', fill)

    with pytest.raises(BagError, match='--odom-topic'):
        capture_bag(bag, workspace)
    capture = capture_bag(bag, workspace, BagOptions(whereabouts=None))
    assert capture.references == ()
    assert capture.images.source == 'drive'


def test_gps_comes_after_odometry_and_is_interpolated(full_bag: Path, workspace: Workspace) -> None:
    capture = capture_bag(full_bag, workspace)

    constraint = capture.references[1].constraint
    assert isinstance(constraint, GpsFixes)
    for name, index in zip(capture.images.names, indices_of(capture.images.names), strict=True):
        if index < 35:
            expected = (50.0 + 1e-5 * index, 8.0 + 2e-5 * index, 100.0 + index)
            assert constraint.fixes[name] == pytest.approx(expected, abs=1e-9)
        else:
            assert index == 35 or name not in constraint.fixes


def test_camera_info_gives_the_camera_with_its_distortion(
    full_bag: Path, workspace: Workspace
) -> None:
    capture = capture_bag(full_bag, workspace)

    assert set(capture.images.cameras) == set(capture.images.names)
    for camera in capture.images.cameras.values():
        assert camera.model_name == 'OPENCV'
        assert list(camera.params) == pytest.approx(
            [300.0, 300.0, WIDTH / 2, HEIGHT / 2, 0.1, -0.02, 0.001, 0.002]
        )


def test_rectified_images_have_the_camera_of_p(full_bag: Path, workspace: Workspace) -> None:
    capture = capture_bag(full_bag, workspace, BagOptions(image_is_rectified=True))
    for camera in capture.images.cameras.values():
        assert camera.model_name == 'PINHOLE'
        assert list(camera.params) == [250.0, 250.0, 150.5, 110.5]


def test_a_given_camera_overrides_camera_info(full_bag: Path, workspace: Workspace) -> None:
    camera = pycolmap.Camera(
        model='PINHOLE', width=WIDTH, height=HEIGHT, params=[280, 280, 160, 120]
    )
    capture = capture_bag(full_bag, workspace, BagOptions(camera=camera))
    assert {tuple(one.params) for one in capture.images.cameras.values()} == {(280, 280, 160, 120)}


def test_a_camera_that_changes_is_another_camera(tmp_path: Path, workspace: Workspace) -> None:
    def zoom(bag: BagWriter, index: int) -> None:
        write_info(bag, index, 300.0 if index < 20 else 400.0)
        write_image(bag, index)

    capture = capture_of(tmp_path, workspace, zoom)

    for name, index in zip(capture.images.names, indices_of(capture.images.names), strict=True):
        expected = 300.0 if index < 20 else 400.0
        assert capture.images.cameras[name].params[0] == expected


@pytest.mark.parametrize(
    'changes', [None, {'k': np.zeros(9)}, {'width': 640, 'height': 480}],
    ids=['none', 'uncalibrated', 'another size'],
)  # fmt: skip
def test_a_camera_that_is_not_known_is_left_open_with_a_warning(
    changes: dict[str, Any] | None, tmp_path: Path, workspace: Workspace
) -> None:
    def fill(bag: BagWriter, index: int) -> None:
        if changes is not None:
            write_info(bag, index, **changes)
        write_image(bag, index)

    capture = capture_of(tmp_path, workspace, fill)

    assert capture.images.cameras == {}
    assert len(capture.warnings) == 1


def test_a_calibration_of_an_unknown_kind_is_named(tmp_path: Path, workspace: Workspace) -> None:
    def fill(bag: BagWriter, index: int) -> None:
        write_info(bag, index, distortion_model='magic')
        write_image(bag, index)

    with pytest.raises(CameraError, match='magic'):
        capture_of(tmp_path, workspace, fill)


def test_without_the_mount_odometry_gives_places_of_the_robot(
    tmp_path: Path, workspace: Workspace
) -> None:
    def fill(bag: BagWriter, index: int) -> None:
        write_odometry(bag, index)
        write_image(bag, index)

    capture = capture_of(tmp_path, workspace, fill)

    constraint = capture.references[0].constraint
    assert isinstance(constraint, Positions)
    assert constraint.level
    for name, index in zip(capture.images.names, indices_of(capture.images.names), strict=True):
        truth = (ODOM_FROM_MAP * map_from_base_at(index)).translation
        assert constraint.positions[name] == pytest.approx(tuple(truth))
    assert any('mount' in warning for warning in capture.warnings)


@pytest.mark.parametrize(
    'topics',
    [WhereaboutsTopics(camera_frame='camera'), WhereaboutsTopics(camera_frame='/camera')],
)
def test_the_frame_of_the_camera_can_be_given(
    topics: WhereaboutsTopics, tmp_path: Path, workspace: Workspace
) -> None:
    def fill(bag: BagWriter, index: int) -> None:
        if not index:
            bag.transform('base_link', 'camera', BASE_FROM_CAMERA, START_NS)
        write_odometry(bag, index)
        write_image(bag, index)

    capture = capture_of(tmp_path, workspace, fill, BagOptions(whereabouts=topics))
    assert isinstance(capture.references[0].constraint, Poses)


def test_poses_of_the_camera_itself_need_no_mount(tmp_path: Path, workspace: Workspace) -> None:
    def fill(bag: BagWriter, index: int) -> None:
        bag.truth(index, msgtype='geometry_msgs/msg/PoseWithCovarianceStamped')
        write_image(bag, index)

    topics = WhereaboutsTopics(odometry='/ground_truth', base_frame='')
    capture = capture_of(tmp_path, workspace, fill, BagOptions(whereabouts=topics))

    constraint = capture.references[0].constraint
    assert isinstance(constraint, Poses)
    for name, index in zip(capture.images.names, indices_of(capture.images.names), strict=True):
        error = pose_error(constraint.camera_from_world[name], map_from_base_at(index).inverse())
        assert error.position < 1e-6


def test_poses_that_nobody_asked_for_are_not_odometry(tmp_path: Path, workspace: Workspace) -> None:
    def fill(bag: BagWriter, index: int) -> None:
        bag.truth(index)
        write_image(bag, index)

    assert capture_of(tmp_path, workspace, fill).references == ()


def test_odometry_that_restarts_counts_in_its_longest_part(
    tmp_path: Path, workspace: Workspace
) -> None:
    def fill(bag: BagWriter, index: int) -> None:
        if not index:
            write_mount(bag)
        far = rigid3d_from([1, 0, 0, 0], [50.0, 0.0, 0.0])
        moved = ODOM_FROM_MAP * map_from_base_at(index)
        write_odometry(bag, index, far * moved if index < 12 else moved)
        write_image(bag, index)

    capture = capture_of(tmp_path, workspace, fill)

    constraint = capture.references[0].constraint
    known = [index for index in indices_of(capture.images.names) if index >= 12]
    assert isinstance(constraint, Poses)
    assert indices_of(tuple(constraint.camera_from_world)) == known
    assert len(capture.warnings) == 2  # no CameraInfo, and this


def test_a_pose_that_is_none_is_left_out(tmp_path: Path, workspace: Workspace) -> None:
    def fill(bag: BagWriter, index: int) -> None:
        if not index:
            write_mount(bag)
        odom_from_base = ODOM_FROM_MAP * map_from_base_at(index)
        broken = pose(odom_from_base)
        if index == 20:
            broken.position.x = float('nan')
        write_odometry(bag, index, pose=odometry_fields(broken, '')['pose'])
        write_info(bag, index)
        write_image(bag, index)

    capture = capture_of(tmp_path, workspace, fill)

    constraint = capture.references[0].constraint
    assert isinstance(constraint, Poses)
    assert set(constraint.camera_from_world) == set(capture.images.names)
    assert len(capture.warnings) == 1


def test_transforms_from_the_map_come_last(tmp_path: Path, workspace: Workspace) -> None:
    def fill(bag: BagWriter, index: int) -> None:
        if not index:
            write_mount(bag)
        bag.transform('map', 'base_link', map_from_base_at(index), stamp_of(index), '/tf')
        write_info(bag, index)
        write_image(bag, index)

    capture = capture_of(tmp_path, workspace, fill)

    (reference,) = capture.references
    assert isinstance(reference.constraint, Poses)
    for name, index in zip(capture.images.names, indices_of(capture.images.names), strict=True):
        truth = (map_from_base_at(index) * BASE_FROM_CAMERA).inverse()
        error = pose_error(reference.constraint.camera_from_world[name], truth)
        assert error.position < 1e-6
    assert capture.warnings == ()


@pytest.mark.parametrize(('status', 'altitude'), [(-1, 1.0), (0, float('nan'))])
def test_fixes_that_are_none_are_no_use(
    status: int, altitude: float, tmp_path: Path, workspace: Workspace
) -> None:
    def fill(bag: BagWriter, index: int) -> None:
        write_fix(bag, index, 50.0 * altitude, 8.0, status=status)
        write_info(bag, index)
        write_image(bag, index)

    capture = capture_of(tmp_path, workspace, fill)
    assert capture.references == ()
    assert len(capture.warnings) == 1


def test_longitude_goes_on_past_the_date_line(tmp_path: Path, workspace: Workspace) -> None:
    def fill(bag: BagWriter, index: int) -> None:
        longitude = 179.9999 + 1e-5 * index
        if not index % 5:
            write_fix(bag, index, 10.0, longitude - 360.0 * (longitude > 180.0))
        write_info(bag, index)
        write_image(bag, index)

    constraint = capture_of(tmp_path, workspace, fill).references[0].constraint

    assert isinstance(constraint, GpsFixes)
    for _, longitude, _ in constraint.fixes.values():
        assert abs((longitude - 180.0) % 360.0) < 1e-3 or abs(longitude - 180.0) < 1e-3


def test_images_that_cannot_be_decoded_are_counted(tmp_path: Path, workspace: Workspace) -> None:
    def fill(bag: BagWriter, index: int) -> None:
        broken = {'encoding': 'magic'} if index in {3, 7} else {}
        write_info(bag, index)
        write_image(bag, index, **broken)

    capture = capture_of(tmp_path, workspace, fill)
    assert capture.counts.read == IMAGES - 2
    assert len(capture.warnings) == 1
    assert '2 of 40' in capture.warnings[0]


def test_stamps_that_jump_back_are_left_out_and_named(tmp_path: Path, workspace: Workspace) -> None:
    def fill(bag: BagWriter, index: int) -> None:
        back = {'header': header(stamp_of(index) - 60 * SECOND, 'camera_optical')}
        write_info(bag, index)
        write_image(bag, index, **(back if index >= 30 else {}))

    capture = capture_of(tmp_path, workspace, fill)
    assert capture.counts.late == 10
    assert max(indices_of(capture.images.names)) < 30
    assert len(capture.warnings) == 1


def test_images_without_stamps_count_as_recorded(tmp_path: Path, workspace: Workspace) -> None:
    def fill(bag: BagWriter, index: int) -> None:
        write_info(bag, index)
        write_image(bag, index, header=header(0, 'camera_optical'))

    capture = capture_of(tmp_path, workspace, fill)
    assert capture.counts.late == 0
    assert len(indices_of(capture.images.names)) > 5


def test_images_of_two_sizes_are_both_used(tmp_path: Path, workspace: Workspace) -> None:
    def fill(bag: BagWriter, index: int) -> None:
        write_info(bag, index)
        small = cv2.resize(grey_at(index), (WIDTH // 2, HEIGHT // 2))
        size = {'height': HEIGHT // 2, 'width': WIDTH // 2, 'step': WIDTH // 2}
        write_image(bag, index, **(size | {'data': small.ravel()} if index >= 20 else {}))

    capture = capture_of(tmp_path, workspace, fill)

    large = {n for n in capture.images.names if indices_of((n,))[0] < 20}
    assert set(capture.images.cameras) == large
    assert large != set(capture.images.names)
    assert len(capture.warnings) == 1


def test_a_bag_without_images_is_named(tmp_path: Path, workspace: Workspace) -> None:
    with pytest.raises(BagError, match='no topic of type'):
        capture_of(tmp_path, workspace, write_odometry)


def test_an_image_topic_without_messages_is_named(tmp_path: Path, workspace: Workspace) -> None:
    def fill(bag: BagWriter) -> None:
        bag.topic('/camera/image', 'sensor_msgs/msg/Image')
        write_info(bag, 0)

    with pytest.raises(MapBuildError, match='/camera/image'):
        capture_bag(write_bag(tmp_path / 'bag', fill), workspace)


@pytest.mark.parametrize(
    'options',
    [
        BagOptions(image_topic='/nowhere'),
        BagOptions(camera_info_topic='/nowhere'),
        BagOptions(image_topic='/odom'),
        BagOptions(whereabouts=WhereaboutsTopics(odometry='/nowhere')),
        BagOptions(whereabouts=WhereaboutsTopics(odometry='/fix')),
        BagOptions(whereabouts=WhereaboutsTopics(gps='/odom')),
    ],
)
def test_topics_that_cannot_serve_are_named(
    options: BagOptions, full_bag: Path, workspace: Workspace
) -> None:
    with pytest.raises(BagError):
        capture_bag(full_bag, workspace, options)


def test_several_odometries_have_to_be_chosen_from(tmp_path: Path, workspace: Workspace) -> None:
    def fill(bag: BagWriter, index: int) -> None:
        write_odometry(bag, index)
        bag.truth(index, msgtype='nav_msgs/msg/Odometry')
        write_image(bag, index)

    with pytest.raises(BagError, match='--odom-topic'):
        capture_of(tmp_path, workspace, fill)


def test_a_truncated_bag_is_named_and_leaves_nothing(full_bag: Path, tmp_path: Path) -> None:
    shutil.copytree(full_bag, tmp_path / 'cut')
    (file,) = (tmp_path / 'cut').glob('*.mcap')
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])

    with pytest.raises(BagError), open_workspace(tmp_path / 'new.work') as workspace:
        capture_bag(tmp_path / 'cut', workspace)
    assert not (tmp_path / 'new.work').exists()


def test_a_bag_is_only_read(full_bag: Path, workspace: Workspace) -> None:
    before = {file.name: file.read_bytes() for file in full_bag.iterdir()}
    capture_bag(full_bag, workspace)
    assert {file.name: file.read_bytes() for file in full_bag.iterdir()} == before


def test_the_images_of_a_bag_are_read_once(full_bag: Path, workspace: Workspace) -> None:
    first = capture_bag(full_bag, workspace)

    def never(_step: str, _done: int, _total: int) -> None:
        pytest.fail('the images were read again')

    again = capture_bag(full_bag, workspace, progress=never)
    assert again.images.names == first.images.names
    assert again.counts == first.counts
    assert len(again.references) == len(first.references)
