# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The parameters of a running node: described, validated, and in force at once."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from live_robot import BASE_FROM_CAMERA, QUICK, running_node, wait_for
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import DescribeParameters

from gam_relocalizer.ros.parameters import SPECIFICATIONS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from live_robot import Robot
    from tiny_place import TinyPlace

LONG_S = 3600.0


@pytest.fixture(scope='module')
def robot(tiny_place: TinyPlace, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    log = tmp_path_factory.mktemp('node') / 'node.log'
    with running_node(log, tiny_place) as (_, robot):
        yield robot


def test_every_parameter_tells_what_it_is_for_and_what_it_takes(robot: Robot) -> None:
    names = list(SPECIFICATIONS)
    answer = robot.call(
        DescribeParameters,
        robot.topic('describe_parameters'),
        DescribeParameters.Request(names=names),
    )
    assert [descriptor.name for descriptor in answer.descriptors] == names
    for descriptor in answer.descriptors:
        specification = SPECIFICATIONS[descriptor.name]
        assert len(descriptor.description) > 20
        assert descriptor.read_only == specification.read_only
        ranges = [*descriptor.integer_range, *descriptor.floating_point_range]
        if descriptor.type in {ParameterType.PARAMETER_INTEGER, ParameterType.PARAMETER_DOUBLE}:
            bounds = [(one.from_value, one.to_value) for one in ranges]
            assert bounds == [specification.bounds]
        if specification.choices:
            assert all(word in descriptor.additional_constraints for word in specification.choices)
        if specification.fixed:
            assert 'unconfigured' in descriptor.additional_constraints


@pytest.mark.parametrize(
    ('name', 'value'),
    [
        ('period', 0.0),
        ('period', -1.0),
        ('period', float('nan')),
        ('period', 2),
        ('period', 'soon'),
        ('min_inliers', 3),
        ('min_inliers', 25.0),
        ('min_belief', 1.5),
        ('covariance_mode', 'round'),
        ('base_from_camera', '1 2 3'),
        ('base_from_camera', '0 0 0 0 0 0 0'),
        ('position_covariance_scale', 0.0),
        ('autostart', False),
        ('map', '/elsewhere'),
        ('map_frame', 'odom'),
        ('image_transport', 'compressed'),
        ('no_such_parameter', 1),
    ],
)
def test_a_value_that_cannot_be_is_refused_with_a_reason(
    robot: Robot, name: str, value: object
) -> None:
    successful, reason = robot.set_parameter(name, value)
    assert not successful
    assert reason


def test_the_period_changes_while_the_node_runs(robot: Robot, tiny_place: TinyPlace) -> None:
    pixels, camera_from_map = tiny_place.queries[1]
    assert robot.set_parameter('period', LONG_S) == (True, '')
    try:
        # at most one of them is tried: the period before may just have been over
        images = [robot.shot(pixels) for _ in range(3)]
        for image in images:
            robot.show(image)
            robot.state()  # so that the node has had time to hear it
    finally:
        assert robot.set_parameter('period', QUICK['period']) == (True, '')
    wait_for(lambda: robot.verdict_on(images[-1]), 'an attempt as soon as the period is short')
    robot.assert_at(images[-1], BASE_FROM_CAMERA * camera_from_map)
    assert sum(robot.verdict_on(image) is not None for image in images) <= 2
