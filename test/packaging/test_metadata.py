# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What package.xml, setup.py, the requirements and the interface packages say of each other."""

from __future__ import annotations

import re
from distutils.core import run_setup  # setuptools provides it
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from catkin_pkg.package import parse_package
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import gam_relocalizer

if TYPE_CHECKING:
    from collections.abc import Iterator

    from setuptools.dist import Distribution

REPOSITORY = Path(__file__).resolve().parents[2]
INTERFACE_PACKAGES = ('gam_relocalizer_msgs', 'pip_interfaces/tf2_msgs')


@pytest.fixture
def distribution(monkeypatch: pytest.MonkeyPatch) -> Distribution:
    monkeypatch.chdir(REPOSITORY)
    return run_setup('setup.py', stop_after='init')


def requirements(folder_file: str) -> dict[str, Requirement]:
    lines = (REPOSITORY / 'requirements' / folder_file).read_text().splitlines()
    parsed = [Requirement(line) for line in lines if line and not line.startswith('#')]
    return {canonicalize_name(requirement.name): requirement for requirement in parsed}


def declared(distribution: Distribution) -> list[Requirement]:
    lists = [distribution.install_requires, *distribution.extras_require.values()]
    return [Requirement(text) for texts in lists for text in texts]


@pytest.mark.parametrize('folder', ['.', *INTERFACE_PACKAGES])
def test_manifest_is_valid(folder: str) -> None:
    warnings: list[str] = []

    parse_package(str(REPOSITORY / folder), warnings=warnings)

    assert warnings == []


def test_versions_agree(distribution: Distribution) -> None:
    manifests = [parse_package(str(REPOSITORY / folder)) for folder in ('.', *INTERFACE_PACKAGES)]

    versions = {manifest.version for manifest in manifests}

    assert versions | {distribution.get_version()} == {gam_relocalizer.__version__}


@pytest.mark.parametrize('folder', INTERFACE_PACKAGES)
def test_every_interface_is_built(folder: str) -> None:
    package = REPOSITORY / folder
    files = {
        str(path.relative_to(package))
        for kind in ('msg', 'srv')
        for path in package.glob(f'{kind}/*.{kind}')
    }

    listed = re.findall(r'"((?:msg|srv)/\w+\.\w+)"', (package / 'CMakeLists.txt').read_text())

    assert set(listed) == files


@pytest.mark.parametrize('folder', INTERFACE_PACKAGES)
def test_interface_manifest_names_the_packages_of_its_fields(folder: str) -> None:
    package = REPOSITORY / folder
    texts = [path.read_text() for path in package.glob('[ms]*/*.[ms]*')]
    used = {name for text in texts for name in re.findall(r'^(\w+)/\w+', text, re.MULTILINE)}

    depended = {dependency.name for dependency in parse_package(str(package)).build_depends}

    assert used
    assert used <= depended


def imported_packages() -> Iterator[str]:
    for path in (REPOSITORY / 'gam_relocalizer').rglob('*.py'):
        found = re.findall(r'^ *(?:from|import) (\w+)', path.read_text(), re.MULTILINE)
        yield from found


def test_manifest_names_every_ros_package_that_is_imported() -> None:
    ros = {name for name in imported_packages() if name.endswith(('_msgs', '_interfaces', 'rclpy'))}
    manifest = parse_package(str(REPOSITORY))

    named = {dependency.name for dependency in manifest.exec_depends}

    assert 'sensor_msgs' in ros
    assert ros <= named


def test_what_is_declared_is_pinned_within_its_range(distribution: Distribution) -> None:
    pins = requirements('constraints.txt')

    for requirement in declared(distribution):
        pinned = pins[canonicalize_name(requirement.name)]
        (version,) = (specifier.version for specifier in pinned.specifier)
        assert requirement.specifier.contains(version), f'{requirement} but {pinned}'


def test_workspace_requirements_are_those_of_setup(distribution: Distribution) -> None:
    of_setup = {Requirement(text).name: text for text in distribution.install_requires}
    of_workspace = requirements('runtime.txt')

    # numpy alone is narrower there: it must fit the system's ROS.
    of_workspace.pop('numpy')

    assert {name: str(wanted) for name, wanted in of_workspace.items()} == {
        name: str(Requirement(of_setup[name])) for name in of_workspace
    }
