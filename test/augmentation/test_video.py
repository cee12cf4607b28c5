# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from gam_relocalizer.augmentation.video import video_file
from gam_relocalizer.errors import VideoError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray


def picture(index: int, height: int, width: int) -> NDArray[np.uint8]:
    """A red bar that wanders to the right."""
    image = np.full((height, width, 3), 60, np.uint8)
    image[:, 4 * index : 4 * index + 16] = (230, 30, 30)
    return image


def read_back(file: Path) -> tuple[list[NDArray[np.uint8]], float]:
    video = cv2.VideoCapture(str(file))
    rate, frames = video.get(cv2.CAP_PROP_FPS), []
    while (read := video.read())[0]:
        frames.append(np.asarray(cv2.cvtColor(read[1], cv2.COLOR_BGR2RGB), np.uint8))
    video.release()
    return frames, rate


@pytest.mark.parametrize(('rate', 'size'), [(15.0, (96, 128)), (7.5, (97, 129)), (30.0, (60, 80))])
def test_frames_come_back_in_number_size_rate_and_colour(
    tmp_path: Path, rate: float, size: tuple[int, int]
) -> None:
    file = tmp_path / 'video.webm'
    with video_file(file, rate) as video:
        for index in range(15):
            video.write(picture(index, *size))
    frames, found_rate = read_back(file)
    assert len(frames) == 15
    assert found_rate == pytest.approx(rate, rel=0.01)
    for index, frame in enumerate(frames):
        assert frame.shape[:2] == tuple(side + side % 2 for side in size)
        written = picture(index, *size).astype(float)
        assert np.abs(frame[: size[0], : size[1]] - written).mean() < 12
    assert [path.name for path in tmp_path.iterdir()] == ['video.webm']


def write_one_and_then_no_picture(file: Path) -> None:
    with video_file(file, 10.0) as video:
        video.write(picture(0, 96, 128))
        video.write(np.zeros((96, 128, 5), np.uint8))


def test_video_that_fails_half_way_leaves_the_one_before(tmp_path: Path) -> None:
    file = tmp_path / 'video.webm'
    file.write_bytes(b'before')
    with pytest.raises(cv2.error):
        write_one_and_then_no_picture(file)
    assert file.read_bytes() == b'before'
    assert [path.name for path in tmp_path.iterdir()] == ['video.webm']


def test_folder_that_is_not_there_is_told(tmp_path: Path) -> None:
    with (
        pytest.raises(VideoError, match='cannot be written'),
        video_file(tmp_path / 'nowhere' / 'video.webm', 10.0) as video,
    ):
        video.write(picture(0, 96, 128))
