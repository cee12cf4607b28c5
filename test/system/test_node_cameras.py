# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""One place through many cameras, seen by a running node; OpenCV says what each of them sees."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pycolmap
import pytest
from live_robot import CAMERA_FRAME, running_node, wait_for
from sensor_msgs.msg import CameraInfo, RegionOfInterest
from std_msgs.msg import Header

from gam_relocalizer.demo.recording import mapping_appearance
from gam_relocalizer.demo.renderer import Renderer
from gam_relocalizer.demo.world import tiny_world
from gam_relocalizer.localization.result import Status

if TYPE_CHECKING:
    from collections.abc import Iterator

    from live_robot import Robot
    from numpy.typing import NDArray
    from sensor_msgs.msg import Image
    from tiny_place import TinyPlace

    from gam_relocalizer_msgs.msg import RelocalizationStatus

WIDTH, HEIGHT = 640, 480
FX, FY, CX, CY = 400.0, 404.0, 312.0, 246.0
K = np.array([[FX, 0.0, CX], [0.0, FY, CY], [0.0, 0.0, 1.0]])
P = np.array([[350.0, 0.0, 331.0, 0.0], [0.0, 352.0, 228.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
BARREL = (-0.2, 0.04, 0.001, -0.0012, -0.003)
RATIONAL = (0.9, 0.3, 0.001, -0.001, 0.02, 1.1, 0.4, 0.04)
FISHEYE = (-0.03, 0.01, -0.004, 0.001)

ROUNDS = 100
GRID = 4  # every so many pixels; what lies between is less than a tenth of a pixel off

# sees more than all of them
WIDE = pycolmap.Camera.create_from_model_name(1, 'PINHOLE', 400.0, 1600, 1200)
WIDE_K = np.array([[400.0, 0.0, 799.5], [0.0, 400.0, 599.5], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class View:
    """What a camera sees of a place, made from the view of a wide pinhole camera there."""

    wide: NDArray[np.uint8]
    camera_from_map: pycolmap.Rigid3d

    def through(
        self,
        d: tuple[float, ...] = (),
        *,
        matrix: NDArray[np.float64] = K,
        is_fisheye: bool = False,
    ) -> NDArray[np.uint8]:
        """The image of a camera of the full size; pixel centres at integers, as in ROS."""
        columns, rows = np.float32(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)))
        some = np.meshgrid(np.arange(0, WIDTH + 1, GRID), np.arange(0, HEIGHT + 1, GRID))
        pixels = np.column_stack([one.ravel() for one in some]).astype(np.float64)
        project = cv2.fisheye.projectPoints if is_fisheye else cv2.projectPoints
        focal = matrix[[0, 1], [0, 1]]
        places = (pixels - matrix[:2, 2]) / focal
        for _ in range(ROUNDS):
            rays = cv2.convertPointsToHomogeneous(places)
            projected = project(rays, np.zeros(3), np.zeros(3), matrix, np.array(d))[0]
            offset = pixels - projected.reshape(-1, 2)
            places += offset / focal
            if np.abs(offset).max() < 0.01:
                break
        else:
            pytest.fail('some pixels of this camera see nothing')
        seen = places * WIDE_K[[0, 1], [0, 1]] + WIDE_K[:2, 2]
        some_sources = seen.reshape(*some[0].shape, 2).astype(np.float32)
        sources = cv2.remap(some_sources, columns / GRID, rows / GRID, cv2.INTER_LINEAR)
        return np.asarray(cv2.remap(self.wide, sources, None, cv2.INTER_LINEAR), dtype=np.uint8)


def calibration(
    distortion_model: str = 'plumb_bob',
    d: tuple[float, ...] = (0.0,) * 5,
    *,
    binning: int = 0,
    roi: tuple[int, int, int, int] = (0, 0, 0, 0),
) -> CameraInfo:
    x, y, width, height = roi
    return CameraInfo(
        header=Header(frame_id=CAMERA_FRAME),
        width=WIDTH,
        height=HEIGHT,
        distortion_model=distortion_model,
        d=[float(value) for value in d],
        k=[float(value) for value in K.ravel()],
        p=[float(value) for value in P.ravel()],
        binning_x=binning,
        binning_y=binning,
        roi=RegionOfInterest(x_offset=x, y_offset=y, width=width, height=height),
    )


def binned(pixels: NDArray[np.uint8], count: int) -> NDArray[np.uint8]:
    """The mean of each block of so many pixels."""
    height, width = pixels.shape[0] // count, pixels.shape[1] // count
    blocks = pixels[: height * count, : width * count].reshape(height, count, width, count, 3)
    return np.asarray(blocks.mean(axis=(1, 3)).round(), dtype=np.uint8)


def cut(pixels: NDArray[np.uint8], roi: tuple[int, int, int, int]) -> NDArray[np.uint8]:
    x, y, width, height = roi
    return np.ascontiguousarray(pixels[y : y + height, x : x + width])


@pytest.fixture(scope='module')
def view(tiny_place: TinyPlace) -> View:
    world = tiny_world()
    camera_from_map = tiny_place.queries[3][1]
    wide = Renderer(world, mapping_appearance(world)).render(WIDE, [camera_from_map])
    return View(wide, camera_from_map)


@pytest.fixture(scope='module')
def plain(view: View) -> NDArray[np.uint8]:
    return view.through()


@pytest.fixture(scope='module')
def robot(tiny_place: TinyPlace, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    log = tmp_path_factory.mktemp('node') / 'node.log'
    with running_node(log, tiny_place, base_frame="''") as (_, robot):
        yield robot


NO_CAMERA = CameraInfo(width=1, height=1)


def calibrate(robot: Robot, info: CameraInfo, pixels: NDArray[np.uint8]) -> None:
    """Until the node has heard of it, which comes by a topic of its own.

    The one before has to be forgotten first, as it may give a pose as well.
    """
    for calibration, is_heard in ((NO_CAMERA, True), (info, False)):
        robot.camera_info = calibration
        wait_for(
            lambda expected=is_heard: ('not calibrated' in refusal(robot, pixels)) == expected,
            'the calibration to take effect',
        )


def refusal(robot: Robot, pixels: NDArray[np.uint8]) -> str:
    return robot.ask(robot.shot(pixels)).reason


def assert_pose(robot: Robot, info: CameraInfo, pixels: NDArray[np.uint8], view: View) -> None:
    calibrate(robot, info, pixels)
    image = robot.shot(pixels)
    status = robot.ask(image)
    assert status.accepted, status.reason
    robot.assert_at(image, view.camera_from_map)


ROI = (70, 40, 540, 420)
PLAIN = calibration()


@pytest.mark.parametrize(
    ('model', 'd'),
    [
        ('plumb_bob', BARREL),
        ('plumb_bob', BARREL[:4]),
        ('plumb_bob', ()),
        ('rational_polynomial', RATIONAL),
        ('equidistant', FISHEYE),
        ('equidistant', (0.0,) * 4),
        ('fisheye', FISHEYE),
        ('', ()),
    ],
)
def test_the_pose_does_not_depend_on_the_lens(
    robot: Robot, view: View, model: str, d: tuple[float, ...]
) -> None:
    pixels = view.through(d, is_fisheye=model in {'equidistant', 'fisheye'})
    assert_pose(robot, calibration(model, d), pixels, view)


def test_merged_pixels_are_larger(robot: Robot, view: View) -> None:
    pixels = binned(view.through(BARREL), 2)
    assert_pose(robot, calibration('plumb_bob', BARREL, binning=2), pixels, view)


def test_a_region_of_interest_has_its_centre_elsewhere(robot: Robot, view: View) -> None:
    pixels = cut(view.through(BARREL), ROI)
    assert_pose(robot, calibration('plumb_bob', BARREL, roi=ROI), pixels, view)


def test_a_region_of_merged_pixels(robot: Robot, view: View) -> None:
    pixels = binned(cut(view.through(), ROI), 2)
    assert_pose(robot, calibration(roi=ROI, binning=2), pixels, view)


def test_a_rectified_image_has_the_other_matrix(robot: Robot, view: View) -> None:
    # K and D belong to the raw image and would be wrong
    pixels = view.through(matrix=P[:, :3])
    assert robot.set_parameter('image_is_rectified', value=True) == (True, '')
    try:
        assert_pose(robot, calibration('plumb_bob', BARREL), pixels, view)
    finally:
        assert robot.set_parameter('image_is_rectified', value=False) == (True, '')


def changed(info: CameraInfo, **changes: object) -> CameraInfo:
    """A copy with other fields."""
    same = {name: getattr(info, name) for name in info.get_fields_and_field_types()}
    return CameraInfo(**(same | changes))


@pytest.mark.parametrize(
    ('info', 'word'),
    [
        (changed(PLAIN, k=[0.0] * 9), 'not calibrated'),
        (changed(PLAIN, k=[-FX, *PLAIN.k[1:]]), 'focal length'),
        (changed(PLAIN, k=[float('nan'), *PLAIN.k[1:]]), 'CameraInfo'),
        (calibration('plumb_bob', (0.1, float('inf'), 0.0, 0.0)), 'not finite'),
        (calibration('plumb_bob', (0.1, 0.2, 0.3)), '3 coefficients'),
        (calibration('thin_prism', (0.1,) * 12), 'thin_prism'),
        (changed(PLAIN, width=0), '0 x 480'),
        (changed(PLAIN, width=800), '800 x 480'),
        (changed(PLAIN, width=2**32 - 1), '4294967295'),
        (calibration(binning=2), '320 x 240'),
        (calibration(roi=(10, 10, 300, 200)), '300 x 200'),
    ],
)
def test_a_calibration_that_does_not_fit_is_a_reason(
    robot: Robot, plain: NDArray[np.uint8], info: CameraInfo, word: str
) -> None:
    robot.camera_info = info
    tried: list[Image] = []

    def refusal() -> RelocalizationStatus | None:
        tried.append(robot.shot(plain))
        status = robot.ask(tried[-1])
        return status if word in status.reason else None

    status = wait_for(refusal, 'the calibration to take effect')
    assert status.status == Status.NO_CALIBRATION.value
    robot.camera_info = PLAIN
    wait_for(lambda: robot.ask(robot.shot(plain)).accepted, 'a fix')
    assert tried[-1].header.stamp not in [pose.header.stamp for pose in robot.heard.poses]


def test_a_wrong_focal_length_gives_no_pose(robot: Robot, plain: NDArray[np.uint8]) -> None:
    k = list(PLAIN.k)
    k[0], k[4] = 1.3 * FX, 1.3 * FY
    calibrate(robot, changed(PLAIN, k=k), plain)
    image = robot.shot(plain)

    def good() -> Image:
        calibrate(robot, PLAIN, plain)
        return robot.shot(plain)

    assert robot.refusal_of(image, good).status != Status.NO_CALIBRATION.value
