# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Plays a bag to the relocalizer: ros2 launch gam_relocalizer replay.launch.py map:=... bag:=....

The other arguments of relocalizer.launch.py are arguments of this file as well.
"""

import shlex

from launch import Action, LaunchContext, LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    ExecuteProcess,
    IncludeLaunchDescription,
    RegisterEventHandler,
)
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.events.process import ProcessExited
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

# Seconds between the publishers of the player and its first message: what the slowest subscription
# needs to find them.
DISCOVERY = '4.0'


def generate_launch_description() -> LaunchDescription:
    arguments = [
        DeclareLaunchArgument('map', description='Folder of the map bundle.'),
        DeclareLaunchArgument('bag', description='Bag to play: a folder or a file.'),
        DeclareLaunchArgument(
            'rate', default_value='1.0', description='Speed of the replay, 1.0 as recorded.'
        ),
        DeclareLaunchArgument(
            'topics',
            default_value='',
            description='Topics to play, with spaces between; empty: all of the bag.',
        ),
    ]
    relocalizer = IncludeLaunchDescription(
        PathJoinSubstitution(
            [FindPackageShare('gam_relocalizer'), 'launch', 'relocalizer.launch.py']
        ),
        launch_arguments={'map': LaunchConfiguration('map'), 'use_sim_time': 'true'}.items(),
    )
    # The node latches the points of its map when it becomes active: they come to whoever asks
    # later, too, which the event of that transition does not.
    node_is_active = ExecuteProcess(
        cmd=['ros2', 'topic', 'echo', '--once', '--field', 'header',
             '--qos-reliability', 'reliable', '--qos-durability', 'transient_local',
             PathJoinSubstitution(
                 ['/', LaunchConfiguration('namespace'), 'gam_relocalizer', 'map_points']
             ),
             'sensor_msgs/msg/PointCloud2'],
        output='log',
    )  # fmt: skip
    play = RegisterEventHandler(OnProcessExit(target_action=node_is_active, on_exit=play_bag))
    return LaunchDescription([*arguments, relocalizer, play, node_is_active])


def play_bag(waited: ProcessExited, context: LaunchContext) -> list[Action]:
    """Starts the player; everything ends with the bag."""
    if waited.returncode != 0:
        return [EmitEvent(event=Shutdown(reason='cannot tell when the node is active'))]
    command = ['ros2', 'bag', 'play', LaunchConfiguration('bag'),
               '--rate', LaunchConfiguration('rate'),
               '--delay', DISCOVERY,
               '--clock',
               '--disable-keyboard-controls']  # fmt: skip
    topics = shlex.split(LaunchConfiguration('topics').perform(context))
    if topics:
        command += ['--topics', *topics]
    player = ExecuteProcess(cmd=command, output='screen')
    end = EmitEvent(event=Shutdown(reason='the bag is at its end'))
    return [RegisterEventHandler(OnProcessExit(target_action=player, on_exit=[end])), player]
