# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
import yaml
from rclpy.parameter import Parameter

from gam_relocalizer.errors import UsageError
from gam_relocalizer.localization.continuity import ContinuityOptions
from gam_relocalizer.localization.localizer import LocalizerOptions
from gam_relocalizer.localization.robot_pose import CovarianceMode, CovarianceOptions
from gam_relocalizer.localization.verdict import VerdictOptions
from gam_relocalizer.ros.node import RelocalizerNode
from gam_relocalizer.ros.parameters import SPECIFICATIONS, NodeParameters

if TYPE_CHECKING:
    from collections.abc import Iterator

REPOSITORY = Path(__file__).parents[2]
NUMBERS = [name for name, entry in SPECIFICATIONS.items() if entry.bounds]


def result_of(node: RelocalizerNode, name: str, value: object) -> tuple[bool, str]:
    result = node.set_parameters([Parameter(name, value=value)])[0]
    return result.successful, result.reason


@pytest.fixture
def node(ros: None) -> Iterator[RelocalizerNode]:  # noqa: ARG001 - ROS must be up
    node = RelocalizerNode()
    yield node
    node.destroy_node()


def test_defaults_are_those_of_the_localizer() -> None:
    assert NodeParameters().localizer_options() == LocalizerOptions()
    assert NodeParameters().covariance_options() == CovarianceOptions()
    assert NodeParameters().continuity_options(metric=True) == ContinuityOptions()


def test_thresholds_and_covariance_reach_the_core() -> None:
    thresholds = {
        'min_inliers': 33,
        'min_inlier_ratio': 0.11,
        'min_coverage': 0.22,
        'max_relative_std': 0.33,
        'max_rotation_std_deg': 4.4,
        'min_belief': 0.55,
        'min_odds_against_rival': 6.6,
    }
    parameters = NodeParameters(
        **thresholds, scene_images=7, position_covariance_scale=4.0, covariance_mode='diagonal'
    )
    assert parameters.localizer_options().verdict == VerdictOptions(**thresholds)
    assert parameters.localizer_options().scene_images == 7
    # a factor on the covariance is the square of one on the standard deviation
    assert parameters.covariance_options().position_scale == 2.0
    assert parameters.covariance_options().mode is CovarianceMode.DIAGONAL


def test_what_is_known_about_the_robot_reaches_the_core() -> None:
    parameters = NodeParameters(odometry_drift=0.2, max_tilt_deg=15.0)
    expected = ContinuityOptions(metric=False, drift=0.2, max_tilt_deg=15.0)
    assert parameters.continuity_options(metric=False) == expected


def test_the_matcher_and_its_weights_reach_the_core() -> None:
    options = NodeParameters(matcher='bmnet', weights='~/tuned/bmnet.npz').localizer_options()
    assert options.matcher == 'bmnet'
    assert options.weights == Path.home() / 'tuned' / 'bmnet.npz'
    assert NodeParameters(weights='').localizer_options().weights is None


def test_the_weights_of_the_global_descriptor_reach_the_core() -> None:
    options = NodeParameters(global_weights='~/netvlad.mat').localizer_options()
    assert options.global_weights == Path.home() / 'netvlad.mat'
    assert NodeParameters(global_weights='').localizer_options().global_weights is None


@pytest.mark.parametrize('name', ['map', 'weights', 'global_weights'])
def test_an_unknown_home_folder_is_refused(name: str) -> None:
    with pytest.raises(UsageError, match=name):
        NodeParameters(**{name: '~nobody-of-this-name/file'}).path(name)


def test_the_file_of_parameters_agrees_with_the_declarations() -> None:
    file = REPOSITORY / 'config' / 'params.yaml'
    content = yaml.safe_load(file.read_text(encoding='utf-8'))
    parameters = content['/**']['ros__parameters']
    assert parameters == asdict(NodeParameters())
    for entry in fields(NodeParameters):
        assert type(parameters[entry.name]) is type(entry.default), entry.name


@pytest.mark.parametrize('name', NUMBERS)
def test_numbers_beyond_their_bounds_are_refused(name: str) -> None:
    low, high = SPECIFICATIONS[name].bounds
    kind = type(getattr(NodeParameters(), name))
    for value in (low, high):
        assert getattr(replace(NodeParameters(), **{name: kind(value)}), name) == value
    for value in (low - 1, high + 1):
        with pytest.raises(UsageError, match=name):
            replace(NodeParameters(), **{name: kind(value)})


@pytest.mark.parametrize('value', [math.nan, math.inf, -math.inf])
def test_numbers_that_are_not_finite_are_refused(value: float) -> None:
    with pytest.raises(UsageError, match='period'):
        NodeParameters(period=value)


@pytest.mark.parametrize(
    'name', ['image_transport', 'image_reliability', 'matcher', 'covariance_mode', 'map_frame']
)
def test_texts_outside_their_choices_are_refused(name: str) -> None:
    with pytest.raises(UsageError, match=name):
        replace(NodeParameters(), **{name: ''})


def test_a_mount_is_read_in_the_order_of_static_transform_publisher() -> None:
    base_from_camera = NodeParameters(base_from_camera='1 2 3 0 0 0.6 0.8').mount()
    assert base_from_camera is not None
    np.testing.assert_allclose(base_from_camera.translation, [1, 2, 3])
    # a turn about z: x goes to (w^2 - z^2, 2 w z)
    turned = base_from_camera * np.array([1.0, 0.0, 0.0]) - base_from_camera.translation
    np.testing.assert_allclose(turned, [0.28, 0.96, 0.0], atol=1e-12)


def test_without_a_mount_tf_is_asked() -> None:
    assert NodeParameters(base_from_camera='').mount() is None


@pytest.mark.parametrize(
    'text', ['1 2 3', '0 0 0 0 0 0 0', '1 2 3 0 0 0 nan', 'a b c d e f g', '1 2 3 0 0 0 1 0']
)
def test_impossible_mounts_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match='base_from_camera'):
        NodeParameters(base_from_camera=text)


def test_every_parameter_is_described(node: RelocalizerNode) -> None:
    for name, specification in SPECIFICATIONS.items():
        descriptor = node.describe_parameter(name)
        assert descriptor.description
        ranges = [*descriptor.floating_point_range, *descriptor.integer_range]
        assert bool(ranges) == (specification.bounds is not None)
        assert descriptor.read_only == specification.read_only


def test_values_are_checked_when_set(node: RelocalizerNode) -> None:
    assert result_of(node, 'period', 0.5) == (True, '')
    for name, value, word in [
        ('period', 0.0, 'period'),
        ('period', math.nan, 'period'),
        ('period', 1, 'DOUBLE'),
        ('min_inliers', 3, 'min_inliers'),
        ('covariance_mode', 'half', 'full, diagonal'),
        ('matcher', 'best', 'nn-cross'),
        ('base_from_camera', '1 2', 'seven'),
        ('autostart', False, 'read-only'),
    ]:
        successful, reason = result_of(node, name, value)
        assert not successful
        assert word in reason
    assert node.get_parameter('period').value == 0.5


@pytest.mark.parametrize(
    ('name', 'value'), [('map', '/some/map'), ('matcher', 'nn-cross'), ('weights', '/some/file')]
)
def test_what_is_loaded_may_be_named_while_the_node_is_unconfigured(
    node: RelocalizerNode, name: str, value: str
) -> None:
    assert result_of(node, name, value) == (True, '')


@pytest.mark.usefixtures('ros')
def test_bad_values_at_the_start_are_usage_errors() -> None:
    for name, value, word in [
        ('period', 1, 'decimal point'),
        ('max_scenes', 0, 'max_scenes'),
        ('matcher', 'best', 'nn-cross'),
    ]:
        with pytest.raises(UsageError, match=word):
            RelocalizerNode([Parameter(name, value=value)])
