#!/usr/bin/env python3
# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Builds ROS interface packages into the virtual environment of the Python that runs it.

For installations of ROS 2 from pip; where ROS 2 itself is installed, colcon builds them. The
environment must hold the `ros` and `build` extras of gam_relocalizer. With --wheel they go into a
wheel instead, for people with the same Python who have no compiler and no copy of the sources.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

WHEEL_NAME = 'gam_relocalizer_interfaces'
REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGES = (
    REPOSITORY / 'gam_relocalizer_msgs',
    REPOSITORY / 'pip_interfaces' / 'tf2_msgs',
)


def missing_on_machine() -> str | None:
    """Says what this machine lacks for any build, None when all is there."""
    compiler = os.environ.get('CXX', 'c++')
    if shutil.which(compiler) is None:
        return f'no C++ compiler `{compiler}`: install one (Debian and Ubuntu: apt install g++)'
    header = Path(sysconfig.get_path('include'), 'Python.h')
    if not header.is_file():
        version = f'{sys.version_info.major}.{sys.version_info.minor}'
        return f'no {header}: install it (Debian and Ubuntu: apt install python{version}-dev)'
    return None


def missing_in_environment() -> str | None:
    """Says what the Python environment lacks for the build, None when all is there."""
    if sys.prefix == sys.base_prefix:
        return f'{sys.executable} is not of a virtual environment: run me with that of one'
    absent = [tool for tool in ('cmake', 'ninja') if not Path(sys.prefix, 'bin', tool).is_file()]
    if absent:
        needed = f"{sys.executable} -m pip install '{REPOSITORY}[ros,build]'"
        return f'no {" and no ".join(absent)} in {sys.prefix}: {needed}'
    return None


def build(package: Path, prefix: Path) -> None:
    """Builds one package.

    Args:
        package: Folder with package.xml and CMakeLists.txt.
        prefix: Where it is installed.

    Raises:
        subprocess.CalledProcessError: cmake or the compiler failed; its output is in `stdout`.
    """
    tools = Path(sys.prefix, 'bin')
    # A sourced ROS installation must not be mixed into the environment.
    environment = {
        name: value
        for name, value in os.environ.items()
        if name not in {'AMENT_PREFIX_PATH', 'COLCON_PREFIX_PATH', 'PYTHONPATH'}
    }
    environment['PATH'] = f'{tools}{os.pathsep}{environment.get("PATH", os.defpath)}'
    environment['CMAKE_PREFIX_PATH'] = sys.prefix
    with tempfile.TemporaryDirectory(prefix=f'{package.name}-') as folder:
        for arguments in (
            [
                '-S', str(package), '-B', folder, '-G', 'Ninja', '-DCMAKE_BUILD_TYPE=Release',
                '-DBUILD_TESTING=OFF', f'-DCMAKE_INSTALL_PREFIX={prefix}',
                f'-DPython3_EXECUTABLE={sys.executable}',
            ],
            ['--build', folder, '--target', 'install'],
        ):  # fmt: skip
            subprocess.run(
                [tools / 'cmake', *arguments],
                check=True,
                env=environment,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            )


def build_all(packages: Sequence[Path], prefix: Path) -> None:
    """Builds one package after the other, saying so."""
    for number, package in enumerate(packages, start=1):
        print(f'building {package.name} ({number} of {len(packages)}) ...', flush=True)
        build(package.resolve(), prefix)


def pack(prefix: Path, folder: Path) -> None:
    """Makes one wheel of all that is below a prefix; pip lays it below that of an environment.

    Raises:
        subprocess.CalledProcessError: setuptools failed; its output is in `stdout`.
    """
    version = ET.parse(REPOSITORY / 'package.xml').findtext('version')  # noqa: S314 - our own
    files = sorted(path.relative_to(prefix) for path in prefix.rglob('*') if path.is_file())
    data = [(str(path.parent), [str(path)]) for path in files]
    metadata = {
        'name': WHEEL_NAME,
        'version': version,
        'description': 'ROS 2 interfaces of gam_relocalizer, compiled',
        'license': 'Apache-2.0',
        'python_requires': f'=={sys.version_info.major}.{sys.version_info.minor}.*',
        'packages': [],
        'data_files': data,
    }
    # Not pure: the wheel is for this machine's kind and this Python alone.
    (prefix / 'setup.py').write_text(
        'from setuptools import Distribution, setup\n'
        'Distribution.has_ext_modules = lambda self: True\n'
        f'setup(**{metadata!r})\n'
    )
    subprocess.run(
        [sys.executable, 'setup.py', '--quiet', 'bdist_wheel', '--dist-dir', folder.resolve()],
        check=True,
        cwd=prefix,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def main() -> int:
    """Builds the packages named on the command line; without any, all that the node needs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('packages', nargs='*', type=Path, metavar='PACKAGE_FOLDER')
    parser.add_argument(
        '--check', action='store_true', help='only say whether this machine can build at all'
    )
    parser.add_argument(
        '--wheel', type=Path, metavar='FOLDER', help='make a wheel in the folder instead'
    )
    arguments = parser.parse_args()
    lacking = missing_on_machine() or (None if arguments.check else missing_in_environment())
    if lacking is not None:
        print(f'error: {lacking}', file=sys.stderr)
        return 1
    if arguments.check:
        return 0
    packages = arguments.packages or PACKAGES
    try:
        if arguments.wheel is None:
            build_all(packages, Path(sys.prefix))
        else:
            with tempfile.TemporaryDirectory() as prefix:
                build_all(packages, Path(prefix))
                pack(Path(prefix), arguments.wheel)
    except subprocess.CalledProcessError as failure:
        print(f'{failure.stdout}\nerror: it was not built', file=sys.stderr)
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())
