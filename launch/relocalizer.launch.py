# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Starts the relocalizer: ros2 launch gam_relocalizer relocalizer.launch.py map:=/path/to/map."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    share = FindPackageShare('gam_relocalizer')
    arguments = [
        DeclareLaunchArgument('map', description='Folder of the map bundle.'),
        DeclareLaunchArgument(
            'params_file',
            default_value=PathJoinSubstitution([share, 'config', 'params.yaml']),
            description='Parameters of the node; the arguments below win over it.',
        ),
        DeclareLaunchArgument(
            'image', default_value='image', description='Topic of the images of the camera.'
        ),
        DeclareLaunchArgument(
            'camera_info',
            default_value='camera_info',
            description='Topic of the calibration of the camera.',
        ),
        DeclareLaunchArgument(
            'image_transport',
            default_value='raw',
            choices=['raw', 'compressed'],
            description='Whether to take the images raw or from <image>/compressed.',
        ),
        DeclareLaunchArgument(
            'odom',
            default_value='odom',
            description='Topic of the odometry; nothing is amiss where nobody publishes it.',
        ),
        DeclareLaunchArgument(
            'publish_map_odom',
            default_value='false',
            choices=['true', 'false'],
            description='Whether the node itself broadcasts map -> odom, which has one owner.',
        ),
        DeclareLaunchArgument(
            'use_sim_time',
            default_value='false',
            choices=['true', 'false'],
            description='Whether time comes from /clock, as with a simulator or a bag.',
        ),
        DeclareLaunchArgument('namespace', default_value='', description='Namespace of the node.'),
        DeclareLaunchArgument(
            'rviz',
            default_value='false',
            choices=['true', 'false'],
            description='Whether to open RViz with config/relocalizer.rviz.',
        ),
    ]
    image = LaunchConfiguration('image')
    use_sim_time = ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool)
    node = Node(
        package='gam_relocalizer',
        executable='node',
        name='gam_relocalizer',
        namespace=LaunchConfiguration('namespace'),
        parameters=[
            LaunchConfiguration('params_file'),
            {
                'map': ParameterValue(LaunchConfiguration('map'), value_type=str),
                'image_transport': LaunchConfiguration('image_transport'),
                'publish_map_odom': ParameterValue(
                    LaunchConfiguration('publish_map_odom'), value_type=bool
                ),
                'use_sim_time': use_sim_time,
            },
        ],
        remappings=[
            ('image', image),
            ('image/compressed', [image, '/compressed']),
            ('camera_info', LaunchConfiguration('camera_info')),
            ('odom', LaunchConfiguration('odom')),
        ],
        output='screen',
    )
    rviz = Node(
        package='rviz2',
        executable='rviz2',
        arguments=['-d', PathJoinSubstitution([share, 'config', 'relocalizer.rviz'])],
        parameters=[{'use_sim_time': use_sim_time}],
        condition=IfCondition(LaunchConfiguration('rviz')),
        output='screen',
    )
    return LaunchDescription([*arguments, node, rviz])
