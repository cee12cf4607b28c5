# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Layouts of RViz and Foxglove, which cannot run here, against what the node publishes."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from gam_relocalizer.ros.parameters import NodeParameters
from gam_relocalizer_msgs.msg import RelocalizationStatus

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from gam_relocalizer.ros.interface import Topic

# rviz_default_plugins/plugins_description.xml (ros2/rviz, branch jazzy,
# 591594ee5ae37122fd27c48ca349f7c71c2ccf19): displays with a topic, and what they show.
DISPLAYS = {
    'rviz_default_plugins/Image': 'sensor_msgs/Image',
    'rviz_default_plugins/Path': 'nav_msgs/Path',
    'rviz_default_plugins/PointCloud2': 'sensor_msgs/PointCloud2',
    'rviz_default_plugins/PoseWithCovariance': 'geometry_msgs/PoseWithCovarianceStamped',
}
DISPLAYS_WITHOUT_TOPIC = {'rviz_default_plugins/Grid', 'rviz_default_plugins/TF'}
# rviz_common/src/rviz_common/properties/qos_profile_property.cpp
TOPIC_KEYS = {'Value', 'Depth', 'History Policy', 'Reliability Policy', 'Durability Policy'}
RELIABILITY = {
    'Reliable': ReliabilityPolicy.RELIABLE,
    'Best Effort': ReliabilityPolicy.BEST_EFFORT,
}
DURABILITIES = {
    'Transient Local': {DurabilityPolicy.TRANSIENT_LOCAL},
    'Volatile': {DurabilityPolicy.VOLATILE, DurabilityPolicy.SYSTEM_DEFAULT},
}

# packages/suite-base/src/panels/index.ts (lichtblick-suite/lichtblick, the open successor of
# Foxglove Studio, 66adecb99ca4363b1028c750919c9046609f5c85).
PANELS = {'3D', 'Image', 'Plot', 'DiagnosticSummary', 'RawMessages'}
# What packages/suite-base/src/panels/ThreeDeeRender shows.
SHOWN_IN_3D = {
    'geometry_msgs/PoseStamped',
    'geometry_msgs/PoseWithCovarianceStamped',
    'nav_msgs/Path',
    'sensor_msgs/PointCloud2',
}


def displays_with_topic(rviz: dict[str, Any]) -> list[dict[str, Any]]:
    return [entry for entry in rviz['Visualization Manager']['Displays'] if 'Topic' in entry]


def test_rviz_knows_every_display(rviz: dict[str, Any]) -> None:
    for display in rviz['Visualization Manager']['Displays']:
        known = DISPLAYS if 'Topic' in display else DISPLAYS_WITHOUT_TOPIC
        assert display['Class'] in known
    shown = {display['Class'] for display in displays_with_topic(rviz)}
    assert shown == DISPLAYS.keys()


def test_rviz_shows_topics_of_the_node_by_displays_of_their_types(
    rviz: dict[str, Any], topics: dict[str, Topic]
) -> None:
    for display in displays_with_topic(rviz):
        topic = topics[display['Topic']['Value']]
        assert not topic.is_input
        assert topic.type == DISPLAYS[display['Class']]


def test_rviz_hears_all_that_the_node_offers(
    rviz: dict[str, Any], topics: dict[str, Topic]
) -> None:
    for display in displays_with_topic(rviz):
        wanted = display['Topic']
        offered = topics[wanted['Value']]
        assert wanted.keys() == TOPIC_KEYS
        # more than is offered: nothing comes; less: a late RViz shows no map
        assert RELIABILITY[wanted['Reliability Policy']] == offered.qos.reliability, display['Name']
        assert offered.qos.durability in DURABILITIES[wanted['Durability Policy']], display['Name']


def test_rviz_draws_in_the_frame_of_the_map(rviz: dict[str, Any]) -> None:
    options = rviz['Visualization Manager']['Global Options']
    assert options['Fixed Frame'] == NodeParameters().map_frame


def test_the_pose_estimate_of_rviz_reaches_the_node(
    rviz: dict[str, Any], topics: dict[str, Topic]
) -> None:
    (tool,) = (
        tool
        for tool in rviz['Visualization Manager']['Tools']
        if tool['Class'] == 'rviz_default_plugins/SetInitialPose'
    )
    assert topics[tool['Topic']].is_input
    assert topics[tool['Topic']].type == 'geometry_msgs/PoseWithCovarianceStamped'


@pytest.fixture(scope='module')
def foxglove(config_folder: Path) -> dict[str, Any]:
    def without_doubles(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        assert len(dict(pairs)) == len(pairs)
        return dict(pairs)

    text = (config_folder / 'foxglove.json').read_text(encoding='utf-8')
    return json.loads(text, object_pairs_hook=without_doubles)


def panels_in(layout: dict[str, Any] | str) -> Iterator[str]:
    if isinstance(layout, str):
        yield layout
    else:
        assert layout['direction'] in ('row', 'column')
        for side in ('first', 'second'):
            yield from panels_in(layout[side])


def panels(foxglove: dict[str, Any], kind: str) -> list[dict[str, Any]]:
    configurations = foxglove['configById'].items()
    return [entry for name, entry in configurations if name.startswith(f'{kind}!')]


def test_foxglove_lays_out_each_panel_once(foxglove: dict[str, Any]) -> None:
    assert sorted(panels_in(foxglove['layout'])) == sorted(foxglove['configById'])
    assert {name.split('!')[0] for name in foxglove['configById']} == PANELS


def test_foxglove_draws_topics_of_the_node_in_the_frame_of_the_map(
    foxglove: dict[str, Any], topics: dict[str, Topic]
) -> None:
    (scene,) = panels(foxglove, '3D')
    assert scene['followTf'] == NodeParameters().map_frame
    assert {topics[name].type for name in scene['topics']} == SHOWN_IN_3D
    assert topics[scene['publish']['poseEstimateTopic']].is_input
    (picture,) = panels(foxglove, 'Image')
    assert topics[picture['imageMode']['imageTopic']].type == 'sensor_msgs/Image'


def test_foxglove_plots_fields_of_the_status(
    foxglove: dict[str, Any], topics: dict[str, Topic]
) -> None:
    numbers = RelocalizationStatus.get_fields_and_field_types()
    paths = [path['value'] for plot in panels(foxglove, 'Plot') for path in plot['paths']]
    assert any(path.endswith('.confidence') for path in paths)
    for path in paths:
        topic, field = path.split('.')
        assert topics[topic].type == 'gam_relocalizer_msgs/RelocalizationStatus'
        assert numbers[field] in ('boolean', 'float', 'uint32')


def test_foxglove_shows_the_status_and_the_diagnostics(
    foxglove: dict[str, Any], topics: dict[str, Topic]
) -> None:
    (raw,) = panels(foxglove, 'RawMessages')
    assert topics[raw['topicPath']].type == 'gam_relocalizer_msgs/RelocalizationStatus'
    (summary,) = panels(foxglove, 'DiagnosticSummary')
    assert topics[summary['topicToRender']].type == 'diagnostic_msgs/DiagnosticArray'
