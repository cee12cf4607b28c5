# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Configurations of filters that cannot run here, against what their sources declare."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter

from gam_relocalizer.ros.parameters import NodeParameters

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from gam_relocalizer.ros.interface import Topic

BOOL, DOUBLE, TEXT = Parameter.Type.BOOL, Parameter.Type.DOUBLE, Parameter.Type.STRING
BOOLS, DOUBLES = Parameter.Type.BOOL_ARRAY, Parameter.Type.DOUBLE_ARRAY
TEXTS = Parameter.Type.STRING_ARRAY

# What src/ros_filter.cpp declares (cra-ros-pkg/robot_localization, branch ros2,
# 1cb953379378d13b3e0935ed73d0c7407bd80543), of all it declares. A misspelt parameter is ignored
# without a word.
ROBOT_LOCALIZATION = {
    'frequency': DOUBLE,
    'print_diagnostics': BOOL,
    'map_frame': TEXT,
    'odom_frame': TEXT,
    'base_link_frame': TEXT,
    'world_frame': TEXT,
    'publish_tf': BOOL,
    'two_d_mode': BOOL,
    'smooth_lagged_data': BOOL,
    'history_length': DOUBLE,
    'odom0': TEXT,
    'odom0_config': BOOLS,
    'pose0': TEXT,
    'pose0_config': BOOLS,
    'pose0_differential': BOOL,
    'pose0_relative': BOOL,
    'pose0_rejection_threshold': DOUBLE,
    'initial_estimate_covariance': DOUBLES,
}
STATE_SIZE = 15

# What the models and publishers of fuse_models and the smoother of fuse_optimizers declare
# (locusrobotics/fuse, branch jazzy, e3c086bb6734194b4cbea9ada3549c1ff95060be:
# fuse_models/include/fuse_models/parameters/*.hpp, fuse_models/src/unicycle_2d.cpp,
# fuse_optimizers/include/fuse_optimizers/fixed_lag_smoother_params.hpp).
FUSE = {
    'fixed_lag_smoother': {'optimization_frequency': DOUBLE, 'lag_duration': DOUBLE},
    'fuse_models::Unicycle2D': {'process_noise_diagonal': DOUBLES, 'buffer_length': DOUBLE},
    'fuse_models::Unicycle2DIgnition': {
        'publish_on_startup': BOOL,
        'initial_state': DOUBLES,
        'initial_sigma': DOUBLES,
    },
    'fuse_models::Odometry2D': {
        'topic': TEXT,
        'twist_target_frame': TEXT,
        'linear_velocity_dimensions': TEXTS,
        'angular_velocity_dimensions': TEXTS,
        'throttle_period': DOUBLE,
    },
    'fuse_models::Pose2D': {
        'topic': TEXT,
        'differential': BOOL,
        'position_dimensions': TEXTS,
        'orientation_dimensions': TEXTS,
    },
    'fuse_models::Odometry2DPublisher': {
        'topic': TEXT,
        'map_frame_id': TEXT,
        'odom_frame_id': TEXT,
        'base_link_frame_id': TEXT,
        'base_link_output_frame_id': TEXT,
        'world_frame_id': TEXT,
        'publish_tf': BOOL,
        'publish_frequency': DOUBLE,
    },
}
# What an entry of these lists may say of itself (fuse_optimizers/src/optimizer.cpp).
FUSE_LISTS = {
    'motion_models': {'type': TEXT},
    'sensor_models': {'type': TEXT, 'motion_models': TEXTS, 'ignition': BOOL},
    'publishers': {'type': TEXT},
}
UNICYCLE_STATE_SIZE = 8

OF_EVERY_NODE = {'use_sim_time', 'start_type_description_service'}


@pytest.fixture(scope='module', autouse=True)
def ros() -> Iterator[None]:
    rclpy.init(args=[])
    yield
    rclpy.try_shutdown()


def types_in_ros(file: Path, name: str, namespace: str = '') -> dict[str, Parameter.Type]:
    """What a node of that name gets out of the file: YAML is read differently by ROS."""
    node = Node(
        name,
        namespace=namespace,
        cli_args=['--ros-args', '--params-file', str(file)],
        use_global_arguments=False,
        start_parameter_services=False,
        automatically_declare_parameters_from_overrides=True,
    )
    try:
        found = {entry.name: entry.type_ for entry in node.get_parameters_by_prefix('').values()}
    finally:
        node.destroy_node()
    return {name: kind for name, kind in found.items() if name not in OF_EVERY_NODE}


@pytest.mark.parametrize('namespace', ['', 'robot1'])
def test_robot_localization_declares_what_its_file_sets(
    config_folder: Path, namespace: str
) -> None:
    types = types_in_ros(config_folder / 'ekf.yaml', 'ekf_filter_node_map', namespace)

    assert types == ROBOT_LOCALIZATION


def test_lists_over_the_state_have_its_length(ekf: dict[str, Any]) -> None:
    for name in ('odom0_config', 'pose0_config', 'initial_estimate_covariance'):
        assert len(ekf[name]) == STATE_SIZE, name


def test_the_pose_is_taken_whole_and_of_the_odometry_only_velocities(ekf: dict[str, Any]) -> None:
    assert np.flatnonzero(ekf['pose0_config']).tolist() == [0, 1, 2, 3, 4, 5]
    assert np.flatnonzero(ekf['odom0_config']).tolist() == [6, 7, 8, 9, 10, 11]


def test_frames_and_topic_of_the_filter_are_those_of_the_node(
    ekf: dict[str, Any], topics: dict[str, Topic]
) -> None:
    parameters = NodeParameters()
    assert ekf['world_frame'] == ekf['map_frame'] == parameters.map_frame
    assert ekf['base_link_frame'] == parameters.base_frame
    assert topics[ekf['pose0']].type == 'geometry_msgs/PoseWithCovarianceStamped'
    assert ekf['publish_tf'] is not parameters.publish_map_odom


def test_the_filter_goes_back_several_periods(ekf: dict[str, Any]) -> None:
    assert ekf['smooth_lagged_data']
    assert ekf['history_length'] >= 3 * NodeParameters().period


def distance(offset: np.ndarray, pose_variances: list[float]) -> float:
    """Mahalanobis distance of a fix as good as one can be: only the floors of its covariance."""
    parameters = NodeParameters()
    floors = [parameters.position_std_floor] * 3 + [parameters.orientation_std_floor] * 3
    return math.sqrt(float(np.sum(offset**2 / (pose_variances + np.square(floors)))))


def test_the_first_fix_passes_wherever_it_is(ekf: dict[str, Any]) -> None:
    unknown = ekf['initial_estimate_covariance'][:6]
    far_and_turned = np.array([2000.0, 2000.0, 100.0, math.pi, 0.5, math.pi])

    assert distance(far_and_turned, unknown) < ekf['pose0_rejection_threshold']
    # without them robot_localization starts with 1e-9, and would stay where it is
    one_metre_away = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert distance(one_metre_away, [1e-9] * 6) > ekf['pose0_rejection_threshold']


def test_fuse_declares_what_its_file_sets(config_folder: Path, fuse: dict[str, Any]) -> None:
    expected = dict(FUSE['fixed_lag_smoother'])
    for group, own in FUSE_LISTS.items():
        for name, entry in fuse[group].items():
            expected |= {f'{group}.{name}.{key}': own[key] for key in entry}
            expected |= {f'{name}.{key}': kind for key, kind in FUSE[entry['type']].items()}

    assert types_in_ros(config_folder / 'fuse.yaml', 'fixed_lag_smoother_node') == expected


def test_motion_models_that_sensors_name_exist(fuse: dict[str, Any]) -> None:
    for sensor in fuse['sensor_models'].values():
        assert set(sensor['motion_models']) <= fuse['motion_models'].keys()


def test_lists_over_the_state_of_the_unicycle_have_its_length(fuse: dict[str, Any]) -> None:
    lists = [
        fuse['drive']['process_noise_diagonal'],
        fuse['start']['initial_state'],
        fuse['start']['initial_sigma'],
    ]
    assert [len(entry) for entry in lists] == [UNICYCLE_STATE_SIZE] * 3


def test_frames_and_topic_of_the_smoother_are_those_of_the_node(
    fuse: dict[str, Any], topics: dict[str, Topic]
) -> None:
    parameters = NodeParameters()
    publisher = fuse['map_odom']
    assert publisher['world_frame_id'] == publisher['map_frame_id'] == parameters.map_frame
    assert publisher['base_link_frame_id'] == parameters.base_frame
    assert publisher['base_link_output_frame_id'] == parameters.base_frame
    assert fuse['odometry']['twist_target_frame'] == parameters.base_frame
    assert topics[fuse['relocalizer']['topic']].type == 'geometry_msgs/PoseWithCovarianceStamped'


def test_the_smoother_remembers_motion_for_longer_than_its_window(fuse: dict[str, Any]) -> None:
    assert fuse['drive']['buffer_length'] > fuse['lag_duration'] > NodeParameters().period
