# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Starts the relocalizer and a filter of robot_localization that takes its poses.

ros2 launch gam_relocalizer robot_localization.launch.py map:=/path/to/map odom:=/odom

The filter owns map -> odom; odom -> base_link comes from the robot. The other arguments of
relocalizer.launch.py are arguments of this file as well.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    share = FindPackageShare('gam_relocalizer')
    arguments = [
        DeclareLaunchArgument('map', description='Folder of the map bundle.'),
        DeclareLaunchArgument(
            'filter_file',
            default_value=PathJoinSubstitution([share, 'config', 'ekf.yaml']),
            description='Parameters of the filter; odom and use_sim_time win over it.',
        ),
    ]
    relocalizer = IncludeLaunchDescription(
        PathJoinSubstitution([share, 'launch', 'relocalizer.launch.py']),
        launch_arguments={
            'map': LaunchConfiguration('map'),
            'publish_map_odom': 'false',
        }.items(),
    )
    map_filter = Node(
        package='robot_localization',
        executable='ekf_node',
        name='ekf_filter_node_map',
        namespace=LaunchConfiguration('namespace'),
        parameters=[
            LaunchConfiguration('filter_file'),
            {
                'odom0': ParameterValue(LaunchConfiguration('odom'), value_type=str),
                'use_sim_time': ParameterValue(
                    LaunchConfiguration('use_sim_time'), value_type=bool
                ),
            },
        ],
        output='screen',
    )
    return LaunchDescription([*arguments, relocalizer, map_filter])
