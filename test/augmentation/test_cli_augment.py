# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The command on a rendered drive: arrows lie where the truth puts them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from gam_relocalizer.augmentation.arrows import Arrow, read_arrows, write_arrows
from gam_relocalizer.augmentation.projection import in_image, project
from gam_relocalizer.cli.augment import augment
from gam_relocalizer.demo import trajectories
from gam_relocalizer.demo.recording import IMAGE_RATE
from gam_relocalizer.demo.world import tiny_world
from gam_relocalizer.errors import UsageError

if TYPE_CHECKING:
    from pathlib import Path

    from click.testing import Result
    from numpy.typing import NDArray
    from tiny_place import TinyPlace

MAGENTA = '#ff00ff'
EVERY = 2


def run(*arguments: object) -> Result:
    app = typer.Typer()
    app.command()(augment)
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@dataclass(frozen=True)
class Augmented:
    """The output of the command, and the arrow that was drawn."""

    out: Path
    arrow: Arrow

    @property
    def jitter(self) -> dict[str, Any]:
        content: dict[str, Any] = json.loads((self.out / 'jitter.json').read_text())
        return content


def frames_of(file: Path) -> list[NDArray[np.uint8]]:
    video, frames = cv2.VideoCapture(str(file)), []
    while (read := video.read())[0]:
        frames.append(np.asarray(cv2.cvtColor(read[1], cv2.COLOR_BGR2RGB), np.uint8))
    return frames


@pytest.fixture(scope='module')
def augmented(tiny_place: TinyPlace, tmp_path_factory: pytest.TempPathFactory) -> Augmented:
    folder = tmp_path_factory.mktemp('augmented')
    drive = trajectories.drive(tiny_world().drive_route)
    # two metres in front of where the camera is half way, across the image
    map_from_camera = drive.camera_from_map(2.0).inverse()
    tail, tip = (map_from_camera * np.array([x, 0.1, 2.0]) for x in (-0.4, 0.4))
    direction = tuple(float(value) for value in tip - tail)
    arrow = Arrow(tuple(float(value) for value in tail), direction, 0.8, MAGENTA)
    write_arrows(folder / 'mine.yaml', [arrow])
    result = run(
        tiny_place.bag, '--map', tiny_place.map_path, '--out', folder / 'out',
        '--arrows', folder / 'mine.yaml', '--every', EVERY, '--odom-topic', '/odom',
        '--truth-topic', '/ground_truth',
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    return Augmented(folder / 'out', arrow)


def test_output_is_complete_and_the_arrows_can_be_passed_in_again(augmented: Augmented) -> None:
    assert {file.name for file in augmented.out.iterdir()} == {
        'frame_by_frame.webm', 'odometry.webm', 'side_by_side.webm', 'contact_sheet.png',
        'jitter.json', 'arrows.yaml', 'augmented.html',
    }  # fmt: skip
    assert read_arrows(augmented.out / 'arrows.yaml') == (augmented.arrow,)


def test_drawn_pixels_lie_where_the_truth_puts_the_arrow(
    augmented: Augmented, tiny_place: TinyPlace
) -> None:
    camera, drive = tiny_place.camera, trajectories.drive(tiny_world().drive_route)
    axis = augmented.arrow.tail + np.linspace(0.05, 0.95, 40)[:, None] * (
        augmented.arrow.tip - augmented.arrow.tail
    )
    compared = 0
    for index, frame in enumerate(frames_of(augmented.out / 'frame_by_frame.webm')):
        red, green, blue = (frame[..., channel].astype(int) for channel in range(3))
        magenta = (np.minimum(red, blue) - green) > 70
        camera_from_map = drive.camera_from_map(index * EVERY / IMAGE_RATE)
        pixels = project(camera, np.asarray(camera_from_map * axis))
        if not magenta.any() or not in_image(camera, pixels).all():
            continue
        compared += 1
        columns, rows = np.floor(pixels).astype(int).T
        assert magenta[rows, columns].mean() > 0.9
        drawn = np.argwhere(magenta)[:, ::-1] + 0.5
        # as the axis is through the middle of what is drawn, along it and across
        assert np.linalg.norm(drawn.mean(axis=0) - pixels.mean(axis=0)) < 0.1 * np.ptp(pixels[:, 0])
    assert compared >= 3


def test_jitter_tells_of_both_ways(augmented: Augmented) -> None:
    ways = augmented.jitter['ways']
    assert set(ways) == {'frame_by_frame', 'odometry'}
    for way in ways.values():
        assert way['frames'] == 11
        assert way['frames_with_pose'] >= 7
        assert 0.0 < way['shake']['median'] < 10.0
        assert 0.0 < way['offset']['median'] < 15.0


def test_videos_have_all_frames_at_the_rate_of_those_taken(augmented: Augmented) -> None:
    for name, width in (('frame_by_frame', 640), ('odometry', 640), ('side_by_side', 1280)):
        file = augmented.out / f'{name}.webm'
        frames = frames_of(file)
        assert [frame.shape for frame in frames] == [(480, width, 3)] * 11
        rate = cv2.VideoCapture(str(file)).get(cv2.CAP_PROP_FPS)
        assert rate == pytest.approx(IMAGE_RATE / EVERY, rel=0.01)


def test_page_links_the_videos_beside_it(augmented: Augmented) -> None:
    page = (augmented.out / 'augmented.html').read_text(encoding='utf-8')
    for name in augmented.jitter['videos']:
        assert f'href="{name}"' in page
    assert '<script' not in page


def test_what_cannot_be_used_is_refused(tiny_place: TinyPlace, tmp_path: Path) -> None:
    video = tmp_path / 'walk.mp4'
    video.write_bytes(b'no video')
    common = ('--map', tiny_place.map_path, '--out', tmp_path / 'out')
    for arguments, named in (
        ((video, *common), '--camera'),
        ((video, *common, '--camera', 'PINHOLE 4 4 4 4 2 2', '--odom-topic', '/o'), 'topics'),
        ((tiny_place.bag, *common, '--arrows', tmp_path / 'none.yaml'), 'none.yaml'),
    ):
        result = run(*arguments)
        assert isinstance(result.exception, UsageError)
        assert named in str(result.exception)
