# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Launch files, read but not run: no package of `launch` comes with pip."""

from __future__ import annotations

import ast
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from rclpy.qos import DurabilityPolicy

from gam_relocalizer.ros.parameters import SPECIFICATIONS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from gam_relocalizer.ros.interface import Topic

REPOSITORY = Path(__file__).parents[2]
FOLDER = REPOSITORY / 'launch'
FILES = sorted(FOLDER.glob('*.launch.py'))

# `ros2 bag play` (ros2/rosbag2, branch jazzy, 64717ee802a29b15acdcecd36f3f8ef286ad18b8,
# ros2bag/ros2bag/verb/play.py) and `ros2 topic echo` (ros2/ros2cli, branch jazzy,
# de6cd27284937044d8dff47a617581c28865210c, ros2topic/ros2topic).
OPTIONS = {
    'bag play': {'--rate', '--delay', '--clock', '--disable-keyboard-controls', '--topics'},
    'topic echo': {'--once', '--field', '--qos-reliability', '--qos-durability'},
}


class LaunchFile:
    """What the text of a launch file says."""

    def __init__(self, path: Path) -> None:
        self.tree = ast.parse(path.read_text(encoding='utf-8'))

    def calls(self, name: str) -> list[ast.Call]:
        return [
            node
            for node in ast.walk(self.tree)
            if isinstance(node, ast.Call)
            and isinstance(node.func, ast.Name)
            and node.func.id == name
        ]

    @cached_property
    def arguments(self) -> dict[str, bool]:
        """Whether each argument that the file itself declares has a default."""
        return {
            text(call.args[0]): 'default_value' in keywords(call)
            for call in self.calls('DeclareLaunchArgument')
        }

    @cached_property
    def shared_files(self) -> set[Path]:
        """Files of this package that are named."""
        joined = (texts(call.args[0]) for call in self.calls('PathJoinSubstitution'))
        return {
            Path(*parts[-2:]) for parts in joined if len(parts) > 1 and parts[-2] in SHARED_FOLDERS
        }

    @cached_property
    def included(self) -> dict[str, ast.Call]:
        """The launch files that are included, and how."""
        return {
            texts(call.args[0].args[0])[-1]: call for call in self.calls('IncludeLaunchDescription')
        }


SHARED_FOLDERS = ('config', 'launch')


def text(node: ast.AST) -> Any:  # noqa: ANN401 - of any constant
    assert isinstance(node, ast.Constant)
    return node.value


def texts(node: ast.AST) -> list[str]:
    """The constant texts of a list."""
    assert isinstance(node, ast.List)
    return [entry.value for entry in node.elts if isinstance(entry, ast.Constant)]


def keywords(call: ast.Call) -> dict[str | None, ast.expr]:
    return {keyword.arg: keyword.value for keyword in call.keywords}


def items(dictionary: ast.Dict) -> dict[str, ast.expr]:
    return {text(key): value for key, value in zip(dictionary.keys, dictionary.values, strict=True)}


def given(call: ast.Call) -> dict[str, ast.expr]:
    """The arguments that an included launch file is given."""
    return items(keywords(call)['launch_arguments'].func.value)


def with_included(file: LaunchFile) -> Iterator[LaunchFile]:
    yield file
    for name in file.included:
        yield from with_included(LaunchFile(FOLDER / name))


@pytest.fixture(params=FILES, ids=lambda path: path.name)
def file(request: pytest.FixtureRequest) -> LaunchFile:
    return LaunchFile(request.param)


def test_the_files_that_are_named_exist(file: LaunchFile) -> None:
    assert file.shared_files
    for path in file.shared_files:
        assert (REPOSITORY / path).is_file()


def test_every_argument_that_is_used_is_declared(file: LaunchFile) -> None:
    declared = {name for part in with_included(file) for name in part.arguments}
    used = {text(call.args[0]) for call in file.calls('LaunchConfiguration')}

    assert used
    assert used <= declared


def test_every_argument_is_described(file: LaunchFile) -> None:
    for call in file.calls('DeclareLaunchArgument'):
        assert text(keywords(call)['description']).endswith('.')


def test_included_files_get_arguments_they_have_and_all_they_need() -> None:
    inclusions = [
        (LaunchFile(FOLDER / name).arguments, given(call))
        for path in FILES
        for name, call in LaunchFile(path).included.items()
    ]

    assert inclusions
    for arguments, values in inclusions:
        # launch wants those without a default here, also where the including file has them
        assert {name for name, has_default in arguments.items() if not has_default} <= set(values)
        assert set(values) <= set(arguments)


def relocalizer_node() -> dict[str | None, ast.expr]:
    nodes = map(keywords, LaunchFile(FOLDER / 'relocalizer.launch.py').calls('Node'))
    (node,) = (node for node in nodes if text(node['package']) == 'gam_relocalizer')
    return node


def test_parameters_of_the_node_are_its_parameters() -> None:
    (overrides,) = (
        entry for entry in relocalizer_node()['parameters'].elts if isinstance(entry, ast.Dict)
    )

    assert set(items(overrides)) <= {*SPECIFICATIONS, 'use_sim_time'}


def test_remapped_names_are_inputs_of_the_node(topics: dict[str, Topic]) -> None:
    remapped = [text(pair.elts[0]) for pair in relocalizer_node()['remappings'].elts]

    assert remapped
    for name in remapped:
        assert topics[f'/{name}'].is_input


def test_the_filter_is_the_one_that_its_file_configures(config_folder: Path) -> None:
    (node,) = map(keywords, LaunchFile(FOLDER / 'robot_localization.launch.py').calls('Node'))

    assert f'/**/{text(node["name"])}:\n' in (config_folder / 'ekf.yaml').read_text()


def test_beside_a_filter_the_node_does_not_broadcast_map_to_odom() -> None:
    file = LaunchFile(FOLDER / 'robot_localization.launch.py')

    assert text(given(file.included['relocalizer.launch.py'])['publish_map_odom']) == 'false'


def test_a_replay_runs_by_the_clock_of_the_bag() -> None:
    file = LaunchFile(FOLDER / 'replay.launch.py')

    assert text(given(file.included['relocalizer.launch.py'])['use_sim_time']) == 'true'


def commands() -> list[list[str]]:
    """Constant words of the `ros2` commands in the replay."""
    lists = [
        texts(node)
        for node in ast.walk(LaunchFile(FOLDER / 'replay.launch.py').tree)
        if isinstance(node, ast.List)
    ]
    return [words for words in lists if words[:1] in (['ros2'], ['--topics'])]


def test_commands_of_the_replay_have_options_that_exist() -> None:
    used: dict[str, set[str]] = {'bag play': set(), 'topic echo': set()}
    for words in commands():
        command = ' '.join(words[1:3]) if words[0] == 'ros2' else 'bag play'
        used[command] |= {word for word in words if word.startswith('--')}

    assert used == OPTIONS


def test_the_replay_waits_for_a_topic_that_is_latched(topics: dict[str, Topic]) -> None:
    (words,) = (words for words in commands() if words[1:3] == ['topic', 'echo'])
    package, _, message = words[-1].split('/')
    topic = topics['/gam_relocalizer/map_points']

    assert f'{package}/{message}' == topic.type
    assert topic.qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert words[words.index('--qos-durability') + 1] == 'transient_local'
