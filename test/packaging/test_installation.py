# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What an installation brings: the files of the wheel, and the interface packages."""

from __future__ import annotations

import json
import re
import shutil
import stat
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import tf2_msgs

from gam_relocalizer import __version__

REPOSITORY = Path(__file__).resolve().parents[2]
DATA = f'gam_relocalizer-{__version__}.data/data'

# rosidl gives this hash to the original tf2_msgs/msg/TFMessage of ROS 2 Jazzy. Nodes whose hashes
# differ take each other's topics for different types.
TF_MESSAGE_HASH = 'RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087'


@pytest.fixture(scope='module')
def wheel(tmp_path_factory: pytest.TempPathFactory) -> dict[str, zipfile.ZipInfo]:
    source = tmp_path_factory.mktemp('source')
    for name in ('setup.py', 'setup.cfg', 'pyproject.toml', 'package.xml', 'LICENSE', 'README.md'):
        shutil.copy(REPOSITORY / name, source)
    for name in ('gam_relocalizer', 'resource', 'scripts', 'launch', 'config', 'maps'):
        shutil.copytree(REPOSITORY / name, source / name)
    output = tmp_path_factory.mktemp('wheel')
    subprocess.run(
        [sys.executable, '-m', 'pip', 'wheel', '--quiet', '--no-deps', '--no-build-isolation',
         '--wheel-dir', str(output), str(source)],
        check=True,
    )  # fmt: skip
    (built,) = output.glob('*.whl')
    with zipfile.ZipFile(built) as archive:
        return {info.filename: info for info in archive.infolist()}


def test_node_is_where_ros2_run_looks_and_executable(wheel: dict[str, zipfile.ZipInfo]) -> None:
    node = wheel[f'{DATA}/lib/gam_relocalizer/node']

    assert (node.external_attr >> 16) & stat.S_IXUSR


def test_package_is_in_the_ament_index(wheel: dict[str, zipfile.ZipInfo]) -> None:
    index = f'{DATA}/share/ament_index/resource_index/packages/gam_relocalizer'

    assert index in wheel
    assert f'{DATA}/share/gam_relocalizer/package.xml' in wheel


@pytest.mark.parametrize('folder', ['launch', 'config', 'maps/demo'])
def test_share_holds_the_whole_folder(wheel: dict[str, zipfile.ZipInfo], folder: str) -> None:
    files = [path for path in (REPOSITORY / folder).rglob('*') if path.is_file()]

    assert files
    for path in files:
        assert f'{DATA}/share/gam_relocalizer/{path.relative_to(REPOSITORY)}' in wheel


@pytest.mark.parametrize('name', ['relocalizer', 'replay', 'robot_localization'])
def test_launch_file_finds_what_it_names(wheel: dict[str, zipfile.ZipInfo], name: str) -> None:
    text = (REPOSITORY / 'launch' / f'{name}.launch.py').read_text()

    named = re.findall(r"'(config|launch)', '([\w.]+)'", text)

    assert named
    for folder, file in named:
        assert f'{DATA}/share/gam_relocalizer/{folder}/{file}' in wheel


def test_whole_python_package_is_installed(wheel: dict[str, zipfile.ZipInfo]) -> None:
    package = REPOSITORY / 'gam_relocalizer'
    files = {
        str(path.relative_to(REPOSITORY))
        for pattern in ('*.py', 'py.typed', 'weights/*')
        for path in package.rglob(pattern)
    }

    assert any('weights' in name for name in files)
    assert files <= wheel.keys()


def test_tf_message_has_the_type_hash_of_the_original() -> None:
    prefix = Path(tf2_msgs.__file__).parents[4]
    described = json.loads((prefix / 'share/tf2_msgs/msg/TFMessage.json').read_text())

    (hash_string,) = (
        entry['hash_string']
        for entry in described['type_hashes']
        if entry['type_name'] == 'tf2_msgs/msg/TFMessage'
    )

    assert hash_string == TF_MESSAGE_HASH
