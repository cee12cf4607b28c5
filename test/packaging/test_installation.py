# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What an installation brings: the files of the wheel, and the interface packages."""

from __future__ import annotations

import json
import os
import re
import shutil
import stat
import subprocess
import sys
import tarfile
import zipfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import pytest
import tf2_msgs

from gam_relocalizer import __version__
from gam_relocalizer.cameras import format_camera
from gam_relocalizer.demo.recording import drive_appearance, robot_camera
from gam_relocalizer.demo.renderer import Renderer
from gam_relocalizer.demo.world import demo_world
from gam_relocalizer.geometry import pose_error, read_poses

REPOSITORY = Path(__file__).resolve().parents[2]
DATA = f'gam_relocalizer-{__version__}.data/data'

# rosidl gives this hash to the original tf2_msgs/msg/TFMessage of ROS 2 Jazzy. Nodes whose hashes
# differ take each other's topics for different types.
TF_MESSAGE_HASH = 'RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087'


# Folders that a build or a test leaves behind, and those of tools.
LEFT_OUT = shutil.ignore_patterns(
    '.git',
    '.venv',
    '.*_cache',
    '__pycache__',
    '.hypothesis',
    '.benchmarks',
    'build',
    'dist',
    'install',
    'log',
    '*.egg-info',
)


@dataclass(frozen=True)
class Distributions:
    """What `python -m build` makes: the wheel is built from the source distribution."""

    source: Path
    wheel: Path


@pytest.fixture(scope='module')
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    copied = tmp_path_factory.mktemp('tree') / 'gam_relocalizer'
    shutil.copytree(REPOSITORY, copied, ignore=LEFT_OUT)
    return copied


@pytest.fixture(scope='module')
def distributions(tree: Path, tmp_path_factory: pytest.TempPathFactory) -> Distributions:
    folder = tmp_path_factory.mktemp('dist')
    subprocess.run(
        [sys.executable, '-m', 'build', '--no-isolation', '--outdir', str(folder), str(tree)],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    (source,), (wheel,) = folder.glob('*.tar.gz'), folder.glob('*.whl')
    return Distributions(source, wheel)


@pytest.fixture(scope='module')
def wheel(distributions: Distributions) -> dict[str, zipfile.ZipInfo]:
    with zipfile.ZipFile(distributions.wheel) as archive:
        return {info.filename: info for info in archive.infolist()}


@pytest.fixture(scope='module')
def installation(distributions: Distributions, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A prefix with the package alone; what it needs comes from the environment of the tests."""
    prefix = tmp_path_factory.mktemp('prefix')
    pip = [sys.executable, '-m', 'pip', '--quiet', '--disable-pip-version-check', 'install']
    options = ['--no-deps', '--ignore-installed', '--no-warn-script-location', '--prefix', prefix]
    subprocess.run([*pip, *options, distributions.wheel], check=True)
    return prefix


def run_installed(installation: Path, *arguments: str | Path, folder: Path) -> str:
    """Output of the installed command, run in a folder where there is no source to import."""
    (packages,) = installation.glob('lib/python*/site-packages')
    command = [installation / 'bin' / 'gam_relocalizer', *arguments]
    environment = os.environ | {'PYTHONPATH': str(packages)}
    return subprocess.check_output(command, cwd=folder, env=environment, text=True)


def test_wheel_of_the_source_distribution_is_that_of_the_tree(
    tree: Path, wheel: dict[str, zipfile.ZipInfo], tmp_path: Path
) -> None:
    subprocess.run(
        [sys.executable, '-m', 'build', '--no-isolation', '--wheel', '--outdir', tmp_path, tree],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    (direct,) = tmp_path.glob('*.whl')
    with zipfile.ZipFile(direct) as archive:
        checksums = {info.filename: info.CRC for info in archive.infolist()}

    assert {name: info.CRC for name, info in wheel.items()} == checksums


@pytest.mark.parametrize(
    'name',
    ['package.xml', 'colcon.pkg', 'Makefile', 'requirements/constraints.txt', 'scripts/node',
     'resource/gam_relocalizer', 'gam_relocalizer_msgs/cmake/ros_from_pip.cmake',
     'pip_interfaces/tf2_msgs/msg/TFMessage.msg', 'test/tiny_place.py', 'maps/demo/sfm/images.bin'],
)  # fmt: skip
def test_source_distribution_is_complete(distributions: Distributions, name: str) -> None:
    with tarfile.open(distributions.source) as archive:
        assert f'gam_relocalizer-{__version__}/{name}' in archive.getnames()


def test_installed_command_knows_its_version(installation: Path, tmp_path: Path) -> None:
    assert __version__ in run_installed(installation, '--version', folder=tmp_path)


def test_installed_command_reads_the_map_that_came_with_it(
    installation: Path, tmp_path: Path
) -> None:
    scene_map = installation / 'share/gam_relocalizer/maps/demo'

    assert 'xfeat' in run_installed(installation, 'map', 'info', scene_map, folder=tmp_path)


def test_installed_command_localizes(installation: Path, tmp_path: Path) -> None:
    scene_map, world, camera = (
        installation / 'share/gam_relocalizer/maps/demo',
        demo_world(),
        robot_camera(),
    )
    truth = read_poses(scene_map / 'images.txt')['0000.jpg']
    image = Renderer(world, drive_appearance(world)).render(camera, [truth], 0)
    cv2.imwrite(str(tmp_path / 'view.png'), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))

    run_installed(
        installation, 'localize', '--map', scene_map, '--camera', format_camera(camera),
        '--out', 'poses.txt', 'view.png', folder=tmp_path,
    )  # fmt: skip

    error = pose_error(read_poses(tmp_path / 'poses.txt')['view.png'], truth)
    assert error.position < 0.1
    assert error.rotation_deg < 1.0


def test_interfaces_become_a_wheel_for_this_python(tmp_path: Path) -> None:
    sys.path.insert(0, str(REPOSITORY / 'scripts'))
    try:
        from build_interfaces import pack
    finally:
        sys.path.pop(0)
    (prefix := tmp_path / 'prefix' / 'share' / 'some_msgs').mkdir(parents=True)
    (prefix / 'package.xml').write_text('<package/>')

    pack(tmp_path / 'prefix', tmp_path / 'dist')

    (built,) = (tmp_path / 'dist').glob('*.whl')
    assert f'cp{sys.version_info.major}{sys.version_info.minor}' in built.name
    assert 'none-any' not in built.name
    with zipfile.ZipFile(built) as archive:
        (file,) = (name for name in archive.namelist() if name.endswith('package.xml'))
    assert file.endswith('.data/data/share/some_msgs/package.xml')


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


def test_whole_python_package_is_installed(tree: Path, wheel: dict[str, zipfile.ZipInfo]) -> None:
    files = {
        str(path.relative_to(tree))
        for pattern in ('*.py', 'py.typed', 'weights/*')
        for path in (tree / 'gam_relocalizer').rglob(pattern)
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
