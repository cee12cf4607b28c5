# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import tempfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from miniature_datasets import write_aachen, write_robotcar

from gam_relocalizer.cameras import CAMERA_MODELS, format_camera
from gam_relocalizer.datasets import query_list
from gam_relocalizer.datasets.query_list import read_query_list
from gam_relocalizer.errors import CameraError, DatasetError

LINE = 'query/1.jpg SIMPLE_RADIAL 640 480 500 320 240 0.1'


def test_a_list_of_aachen_has_a_camera_for_each_image(tmp_path: Path) -> None:
    listed = write_aachen(tmp_path)

    images = read_query_list(listed.file, listed.folder)

    assert images.names == tuple(listed.poses)
    assert images.folder == listed.folder
    assert images.camera_from_world is None
    *by_day, by_night = (format_camera(images.cameras[name]) for name in images.names)
    assert set(by_day) == {'SIMPLE_RADIAL 384 288 340 192 144 0'}
    assert by_night == 'SIMPLE_RADIAL 288 216 255 144 108 0'


def test_a_list_of_robotcar_may_end_without_a_newline(tmp_path: Path) -> None:
    listed = write_robotcar(tmp_path)

    images = read_query_list(listed.file, listed.folder)

    assert images.names == tuple(listed.poses)
    assert all((images.folder / name).is_file() for name in images.names)


@pytest.mark.parametrize(
    ('line', 'error'),
    [
        ('query/2.jpg', DatasetError),
        ('query/2.jpg PINHOLE 640 480', DatasetError),
        ('query/2.jpg PINHOLE 640 480 500', CameraError),
        ('query/2.jpg PINHOLE 640 480 500 500 320 nan', CameraError),
        ('query/2.jpg PINHOLE 640 480 inf 500 320 240', CameraError),
        ('query/2.jpg PINHOLE 640 480 -500 500 320 240', CameraError),
        ('query/2.jpg PINHOLE 640 480 500 500 320 x', CameraError),
        ('query/2.jpg PINHOLE 640.5 480 500 500 320 240', CameraError),
        ('query/2.jpg PINHOLE 640 99999999 500 500 320 240', CameraError),
        ('query/2.jpg PINHOLE 0 480 500 500 320 240', CameraError),
        ('query/2.jpg MAGIC 640 480 500 500 320 240', CameraError),
        ('../2.jpg PINHOLE 640 480 500 500 320 240', DatasetError),
        ('query/../../2.jpg PINHOLE 640 480 500 500 320 240', DatasetError),
        ('/etc/2.jpg PINHOLE 640 480 500 500 320 240', DatasetError),
        ('query/1.jpg PINHOLE 640 480 500 500 320 240', DatasetError),
        ('query//1.jpg PINHOLE 640 480 500 500 320 240', DatasetError),
        (f'query/2.jpg PINHOLE 640 480 {"1 " * 2**16}', DatasetError),
    ],
)
def test_errors_name_the_file_and_line(line: str, error: type[Exception], tmp_path: Path) -> None:
    file = tmp_path / 'queries.txt'
    file.write_text(f'# a comment\n{LINE}\n{line}\n')

    with pytest.raises(error, match=r'queries\.txt:3'):
        read_query_list(file, tmp_path)


@pytest.mark.parametrize('content', [b'', b'# nothing\n\n', b'\xff\xfe\x00\xd8'])
def test_a_list_without_images_is_an_error(content: bytes, tmp_path: Path) -> None:
    (tmp_path / 'queries.txt').write_bytes(content)

    with pytest.raises(DatasetError, match=r'queries\.txt'):
        read_query_list(tmp_path / 'queries.txt', tmp_path)


def test_a_list_that_is_missing_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DatasetError):
        read_query_list(tmp_path / 'queries.txt', tmp_path)


def test_a_list_without_end_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(query_list, 'MAX_QUERIES', 2)
    file = tmp_path / 'queries.txt'
    file.write_text(''.join(f'{index}.jpg PINHOLE 6 4 5 5 3 2\n' for index in range(3)))

    with pytest.raises(DatasetError, match=r'queries\.txt:3'):
        read_query_list(file, tmp_path)


NUMBERS = st.sampled_from(
    ['640', '480', '0', '-1', '1e9', '1e400', 'nan', 'inf', '0.1', '1_0', '٣', '', 'x', '9' * 5000]
)
NAMES = st.one_of(
    st.text(max_size=12), st.sampled_from(['a.jpg', 'b/c.jpg', '../a', '/a', '.', 'a\0b', '~', '#'])
)
LINES = st.builds(
    lambda name, model, numbers: ' '.join([name, model, *numbers]),
    NAMES,
    st.one_of(st.sampled_from([*CAMERA_MODELS, 'INVALID', 'pinhole']), st.text(max_size=9)),
    st.lists(NUMBERS, max_size=12),
)


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.one_of(st.lists(LINES, max_size=6).map('\n'.join), st.text(max_size=200)))
def test_whatever_a_list_holds_it_is_read_or_refused(text: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / 'queries.txt'
        file.write_text(text, encoding='utf-8', errors='surrogatepass')
        try:
            images = read_query_list(file, Path(folder))
        except (DatasetError, CameraError):
            return
        assert len(set(images.names)) == len(images.names) > 0
        for name in images.names:
            assert '..' not in Path(name).parts
            assert not Path(name).is_absolute()
            camera = images.cameras[name]
            assert camera.width > 0
            assert all(abs(value) < float('inf') for value in camera.params)
