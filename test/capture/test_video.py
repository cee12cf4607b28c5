# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import struct
import wave
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pycolmap
import pytest
from moving_camera import HEIGHT, WIDTH, seen_at

from gam_relocalizer.capture.capture import STEP
from gam_relocalizer.capture.video import capture_video
from gam_relocalizer.errors import CameraError, MapBuildError, VideoError
from gam_relocalizer.images import read_image
from gam_relocalizer.mapping.workspace import open_workspace

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from gam_relocalizer.capture.capture import Capture
    from gam_relocalizer.mapping.workspace import Workspace

RATE, STEP_PX, FRAMES = 20, 8.0, 60
# Clockwise by 90 degrees, as a phone notes it in the header of a track (16.16 and 2.30 numbers).
QUARTER_TURN = struct.pack('>9i', 0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30)


def write_video(path: Path, images: Iterator[np.ndarray], codec: str) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), RATE, (WIDTH, HEIGHT))
    for image in images:
        writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    writer.release()
    return path


def slide() -> Iterator[np.ndarray]:
    return (seen_at(STEP_PX * index) for index in range(FRAMES))


@pytest.fixture(scope='module')
def videos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('videos')
    write_video(folder / 'walk.avi', slide(), 'MJPG')
    write_video(folder / 'walk.mp4', slide(), 'mp4v')
    turned = bytearray((folder / 'walk.mp4').read_bytes())
    # the matrix of a version 0 track header lies 44 bytes behind its name
    matrix = turned.index(b'tkhd') + 44
    turned[matrix : matrix + len(QUARTER_TURN)] = QUARTER_TURN
    (folder / 'turned.mp4').write_bytes(turned)
    (folder / 'cut.avi').write_bytes((folder / 'walk.avi').read_bytes()[:400_000])
    write_video(folder / 'black.avi', (0 * image for image in slide()), 'MJPG')
    return folder


@pytest.fixture
def workspace(tmp_path: Path) -> Iterator[Workspace]:
    with open_workspace(tmp_path / 'map.work') as opened:
        yield opened


def seconds_of(capture: Capture) -> np.ndarray:
    return np.array([float(name.removesuffix('.jpg')) for name in capture.images.names])


@pytest.mark.parametrize('name', ['walk.avi', 'walk.mp4'])
def test_keyframes_show_what_the_camera_saw_at_the_time_in_their_name(
    name: str, videos: Path, workspace: Workspace
) -> None:
    capture = capture_video(videos / name, workspace)

    seconds = seconds_of(capture)
    assert (capture.counts.read, capture.counts.chosen) == (FRAMES, len(seconds))
    assert len(seconds) > 5
    assert list(capture.images.names) == sorted(capture.images.names)
    for image_name, second in zip(capture.images.names, seconds, strict=True):
        shown = read_image(capture.images.folder / image_name)
        expected = seen_at(STEP_PX * RATE * second)
        assert np.abs(shown.astype(float) - expected).mean() < 8.0
    assert capture.images.cameras == {}
    assert capture.warnings == ()


def test_a_rotation_that_a_phone_notes_is_applied(videos: Path, workspace: Workspace) -> None:
    capture = capture_video(videos / 'turned.mp4', workspace)

    first = read_image(capture.images.folder / capture.images.names[0])
    upright = cv2.rotate(seen_at(0.0), cv2.ROTATE_90_CLOCKWISE)
    assert first.shape == upright.shape
    assert np.abs(first.astype(float) - upright).mean() < 8.0


def test_the_camera_is_that_of_the_upright_frames(videos: Path, workspace: Workspace) -> None:
    wide = pycolmap.Camera(model='PINHOLE', width=WIDTH, height=HEIGHT, params=[300, 300, 160, 120])
    high = pycolmap.Camera(model='PINHOLE', width=HEIGHT, height=WIDTH, params=[300, 300, 120, 160])

    capture = capture_video(videos / 'turned.mp4', workspace, high)

    assert set(capture.images.cameras) == set(capture.images.names)
    with pytest.raises(CameraError):
        capture_video(videos / 'turned.mp4', workspace, wide)


def test_a_cut_video_is_used_as_far_as_it_goes(videos: Path, workspace: Workspace) -> None:
    capture = capture_video(videos / 'cut.avi', workspace)

    assert 5 < capture.counts.read < FRAMES - 5
    assert capture.counts.chosen > 1
    assert len(capture.warnings) == 1


def sound(path: Path) -> None:
    with wave.open(str(path), 'wb') as stream:
        stream.setnchannels(1)
        stream.setsampwidth(2)
        stream.setframerate(8000)
        stream.writeframes(bytes(16000))


def noise(path: Path) -> None:
    path.write_bytes(np.random.default_rng(0).bytes(5000))


@pytest.mark.parametrize(
    'make',
    [
        lambda _path: None,
        lambda path: path.mkdir(),
        lambda path: path.write_bytes(b''),
        noise,
        sound,
    ],
    ids=['missing', 'folder', 'empty', 'noise', 'sound'],
)
def test_what_is_no_video_is_named(
    make: Callable[[Path], None], tmp_path: Path, workspace: Workspace
) -> None:
    path = tmp_path / 'walk.mp4'
    make(path)
    with pytest.raises(VideoError, match=r'walk\.mp4'):
        capture_video(path, workspace)


def test_a_video_without_its_index_is_named(
    videos: Path, tmp_path: Path, workspace: Workspace
) -> None:
    whole = (videos / 'walk.mp4').read_bytes()
    (tmp_path / 'cut.mp4').write_bytes(whole[: len(whole) // 2])
    with pytest.raises(VideoError, match=r'cut\.mp4'):
        capture_video(tmp_path / 'cut.mp4', workspace)


def test_a_black_video_makes_no_map_and_leaves_nothing(videos: Path, tmp_path: Path) -> None:
    with (
        pytest.raises(MapBuildError, match=r'black\.avi'),
        open_workspace(tmp_path / 'map.work') as workspace,
    ):
        capture_video(videos / 'black.avi', workspace)
    assert not (tmp_path / 'map.work').exists()


def test_a_video_is_read_once(videos: Path, workspace: Workspace) -> None:
    steps: list[tuple[int, int]] = []

    first = capture_video(
        videos / 'walk.avi', workspace, progress=lambda _s, done, total: steps.append((done, total))
    )
    assert steps[-1] == (FRAMES, FRAMES)

    def never(_step: str, _done: int, _total: int) -> None:
        pytest.fail('the video was read again')

    assert capture_video(videos / 'walk.avi', workspace, progress=never) == first


def test_a_changed_video_is_read_again(videos: Path, tmp_path: Path, workspace: Workspace) -> None:
    path = tmp_path / 'walk.avi'
    path.write_bytes((videos / 'walk.avi').read_bytes())
    first = capture_video(path, workspace)
    path.write_bytes((videos / 'cut.avi').read_bytes())

    assert capture_video(path, workspace).counts.read < first.counts.read


def test_a_damaged_keyframe_is_made_anew(videos: Path, workspace: Workspace) -> None:
    first = capture_video(videos / 'walk.avi', workspace)
    damaged = first.images.folder / first.images.names[1]
    whole = damaged.read_bytes()
    damaged.write_bytes(whole[:100])

    capture_video(videos / 'walk.avi', workspace)

    assert damaged.read_bytes() == whole


def test_nothing_is_written_beside_the_video(videos: Path, workspace: Workspace) -> None:
    before = sorted((entry.name, entry.stat().st_mtime_ns) for entry in os.scandir(videos))
    capture = capture_video(videos / 'walk.avi', workspace)
    assert capture.images.folder.parent == workspace.path / STEP
    assert sorted((one.name, one.stat().st_mtime_ns) for one in os.scandir(videos)) == before
