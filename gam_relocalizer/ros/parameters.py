# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The node's parameters: one place for default, range, description and validation of each."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, ParameterException

from gam_relocalizer.errors import UsageError
from gam_relocalizer.geometry import rigid3d_from
from gam_relocalizer.localization.continuity import ContinuityOptions
from gam_relocalizer.localization.localizer import LocalizerOptions
from gam_relocalizer.localization.robot_pose import CovarianceMode, CovarianceOptions
from gam_relocalizer.localization.verdict import VerdictOptions
from gam_relocalizer.matching.registry import MATCHER_NAMES

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import pycolmap
    from rclpy.node import Node
    from rclpy.parameter import Parameter

_SPECIFICATION = 'specification'
_LOCALIZER = LocalizerOptions()
_VERDICT = VerdictOptions()
_COVARIANCE = CovarianceOptions()
_CONTINUITY = ContinuityOptions()


@dataclass(frozen=True)
class Specification:
    """What a parameter accepts.

    Attributes:
        description: One sentence for `ros2 param describe`.
        unit: Of a number; empty for one without.
        bounds: Smallest and largest value of a number.
        choices: The words a text may be; empty when it may be any.
        fixed: Read while the node configures; refused from then on until it is cleaned up.
        read_only: Read once, when the process starts.
    """

    description: str
    unit: str = ''
    bounds: tuple[float, float] | None = None
    choices: tuple[str, ...] = ()
    fixed: bool = False
    read_only: bool = False

    @property
    def constraints(self) -> str:
        """What the ranges of a descriptor cannot express, in words."""
        parts = []
        if self.unit:
            parts.append(f'unit: {self.unit}')
        if self.choices:
            parts.append(f'one of: {", ".join(self.choices)}')
        if self.fixed:
            parts.append('changes are accepted only while the node is unconfigured')
        return '; '.join(parts)

    def check(self, name: str, value: object) -> None:
        """Refuses a value.

        Raises:
            UsageError: It is out of bounds, not finite or not among the choices.
        """
        if self.bounds is not None and isinstance(value, (int, float)):
            low, high = self.bounds
            if not (math.isfinite(value) and low <= value <= high):
                msg = f'parameter `{name}` is {value}; expected a number from {low} to {high}'
                raise UsageError(msg)
        if self.choices and value not in self.choices:
            msg = f'parameter `{name}` is `{value}`; expected one of {", ".join(self.choices)}'
            raise UsageError(msg)


def _parameter(default: Any, description: str, **limits: Any) -> Any:  # noqa: ANN401 - as field()
    return field(default=default, metadata={_SPECIFICATION: Specification(description, **limits)})


@dataclass(frozen=True)
class NodeParameters:
    """All parameters of the node; an instance is valid.

    Raises:
        UsageError: On construction, when a value is out of its range.
    """

    map: str = _parameter('', 'Directory of the map bundle.', fixed=True)
    map_frame: str = _parameter('map', 'Frame that the published poses are in.', fixed=True)
    base_frame: str = _parameter(
        'base_link',
        "Frame whose pose is published; empty: the camera's optical frame.",
        fixed=True,
    )
    base_from_camera: str = _parameter(
        '',
        "Mount of the camera, as `x y z qx qy qz qw` of the camera's optical frame in the base "
        'frame [m]; empty: looked up in /tf and /tf_static.',
    )
    period: float = _parameter(
        2.0, 'Time between two attempts, by the clock of the node.', unit='s', bounds=(0.01, 3600.0)
    )
    image_transport: str = _parameter(
        'raw',
        'Whether to subscribe to image (raw) or image/compressed (compressed).',
        choices=('raw', 'compressed'),
        fixed=True,
    )
    image_reliability: str = _parameter(
        'best_effort',
        'Reliability asked of the publisher of the images; best_effort matches every publisher, '
        'reliable loses no large image.',
        choices=('best_effort', 'reliable'),
        fixed=True,
    )
    image_is_rectified: bool = _parameter(
        default=False,
        description='Whether the images are rectified: then P of the CameraInfo is used and no '
        'distortion.',
    )
    retrieved_images: int = _parameter(
        _LOCALIZER.retrieved_images, 'Reference images retrieved per attempt.', bounds=(1, 1000)
    )
    scene_images: int = _parameter(
        _LOCALIZER.scene_images, 'Reference images whose points make up a scene.', bounds=(1, 1000)
    )
    max_scenes: int = _parameter(
        _LOCALIZER.max_scenes, 'Scenes tried before giving up.', bounds=(1, 1000)
    )
    enough_inliers: int = _parameter(
        _LOCALIZER.enough_inliers,
        'An accepted pose with so many inliers ends the search through the scenes.',
        bounds=(1, 100_000),
    )
    max_keypoints: int = _parameter(
        _LOCALIZER.max_keypoints,
        'Local features taken from an image.',
        bounds=(100, 20_000),
        fixed=True,
    )
    matcher: str = _parameter(
        _LOCALIZER.matcher,
        'What matches the features of an image with the points of the map.',
        choices=MATCHER_NAMES,
        fixed=True,
    )
    weights: str = _parameter(
        '',
        'Weights file of the matcher, such as one fine-tuned on the map; empty: the shipped one.',
        fixed=True,
    )
    global_weights: str = _parameter(
        '',
        'Weights file of the global descriptor, for a map built with `--global netvlad`.',
        fixed=True,
    )
    min_inliers: int = _parameter(
        _VERDICT.min_inliers, 'Least number of inliers of a fix.', bounds=(4, 100_000)
    )
    min_inlier_ratio: float = _parameter(
        _VERDICT.min_inlier_ratio, 'Least share of inliers among the matches.', bounds=(0.0, 1.0)
    )
    min_coverage: float = _parameter(
        _VERDICT.min_coverage,
        'Least share of the image that the inliers spread over.',
        bounds=(0.0, 1.0),
    )
    max_relative_std: float = _parameter(
        _VERDICT.max_relative_std,
        'Greatest standard deviation of the position, per median distance of the inliers.',
        bounds=(1e-6, 100.0),
    )
    max_rotation_std_deg: float = _parameter(
        _VERDICT.max_rotation_std_deg,
        'Greatest standard deviation of the orientation.',
        unit='deg',
        bounds=(1e-6, 180.0),
    )
    min_belief: float = _parameter(
        _VERDICT.min_belief,
        'Least probability that the pose is right and not of a place that looks alike.',
        bounds=(0.0, 1.0),
    )
    min_odds_against_rival: float = _parameter(
        _VERDICT.min_odds_against_rival,
        'A fix must have so many times the odds of a pose elsewhere that another scene gives.',
        bounds=(1.0, 1e6),
    )
    odometry_drift: float = _parameter(
        _CONTINUITY.drift,
        'Share of the way, and of the turns, that the odometry may be off; a fix that is further '
        'off is held back until another one confirms it.',
        bounds=(0.0, 1.0),
    )
    max_tilt_deg: float = _parameter(
        _CONTINUITY.max_tilt_deg,
        'Furthest that the base ever leans from upright: poses that lean further are wrong; 180: '
        'it may lean in any way.',
        unit='deg',
        bounds=(0.0, 180.0),
    )
    position_covariance_scale: float = _parameter(
        _COVARIANCE.position_scale**2,
        'Factor on the covariance of the position.',
        bounds=(1e-6, 1e6),
    )
    orientation_covariance_scale: float = _parameter(
        _COVARIANCE.orientation_scale**2,
        'Factor on the covariance of the orientation.',
        bounds=(1e-6, 1e6),
    )
    position_std_floor: float = _parameter(
        _COVARIANCE.position_floor,
        'Standard deviation that is added to each coordinate: errors of the map itself.',
        unit='m',
        bounds=(1e-6, 100.0),
    )
    orientation_std_floor: float = _parameter(
        _COVARIANCE.orientation_floor,
        'Standard deviation that is added about each axis: errors of the map itself.',
        unit='rad',
        bounds=(1e-6, 3.0),
    )
    covariance_mode: str = _parameter(
        'full',
        'Whether the covariance is published whole or only its diagonal (consumers that refuse '
        'negative elements).',
        choices=('full', 'diagonal'),
    )
    publish_map_odom: bool = _parameter(
        default=False,
        description='Whether to broadcast, on /tf, where the frame of the odometry lies in '
        '`map_frame`; nobody else may.',
        fixed=True,
    )
    map_odom_rate: float = _parameter(
        20.0,
        'Broadcasts of that transform per second, by the clock of the node.',
        unit='Hz',
        bounds=(0.1, 1000.0),
    )
    transform_tolerance: float = _parameter(
        0.1,
        'How far the stamp of that transform lies ahead of the clock, so that others find it valid '
        'until the next one comes.',
        unit='s',
        bounds=(0.0, 10.0),
    )
    torch_threads: int = _parameter(
        0,
        "Threads of the networks; 0: PyTorch's own choice.",
        bounds=(0, 256),
        fixed=True,
    )
    autostart: bool = _parameter(
        default=True,
        description='Whether the node configures and activates by itself when it starts.',
        read_only=True,
    )

    def __post_init__(self) -> None:
        for name, specification in SPECIFICATIONS.items():
            specification.check(name, getattr(self, name))
        if not self.map_frame:
            msg = 'parameter `map_frame` is empty; expected the name of a frame, such as `map`'
            raise UsageError(msg)
        self.mount()

    def mount(self) -> pycolmap.Rigid3d | None:
        """`base_from_camera` as a transform, or None when it is to come from TF."""
        words = self.base_from_camera.split()
        if not words:
            return None
        try:
            numbers = [float(word) for word in words]
        except ValueError:
            numbers = []
        quaternion_length = math.hypot(*numbers[3:])
        finite = all(math.isfinite(number) for number in numbers)
        if len(numbers) != 7 or not finite or abs(quaternion_length - 1.0) > 1e-2:
            msg = (
                f'parameter `base_from_camera` is `{self.base_from_camera}`; expected seven '
                f'numbers `x y z qx qy qz qw` with a unit quaternion, or nothing'
            )
            raise UsageError(msg)
        x, y, z, qx, qy, qz, qw = numbers
        return rigid3d_from((qw, qx, qy, qz), (x, y, z))

    def path(self, name: str) -> Path:
        """A parameter as the path of a file; `~` is a home folder.

        Raises:
            UsageError: Nobody knows that home folder.
        """
        text = getattr(self, name)
        try:
            return Path(text).expanduser()
        except RuntimeError as err:
            msg = f'parameter `{name}` is `{text}`: {err} Write the whole path, from / on'
            raise UsageError(msg) from err

    def localizer_options(self) -> LocalizerOptions:
        """What of them concerns the localizer.

        Raises:
            UsageError: See `path`.
        """
        return LocalizerOptions(
            retrieved_images=self.retrieved_images,
            scene_images=self.scene_images,
            max_scenes=self.max_scenes,
            enough_inliers=self.enough_inliers,
            max_keypoints=self.max_keypoints,
            matcher=self.matcher,
            weights=self.path('weights') if self.weights else None,
            global_weights=self.path('global_weights') if self.global_weights else None,
            verdict=VerdictOptions(
                min_inliers=self.min_inliers,
                min_inlier_ratio=self.min_inlier_ratio,
                min_coverage=self.min_coverage,
                max_relative_std=self.max_relative_std,
                max_rotation_std_deg=self.max_rotation_std_deg,
                min_belief=self.min_belief,
                min_odds_against_rival=self.min_odds_against_rival,
            ),
        )

    def continuity_options(self, *, metric: bool) -> ContinuityOptions:
        """What of them concerns odometry and the robot's motion.

        Args:
            metric: Whether the map is.
        """
        return ContinuityOptions(
            metric=metric, drift=self.odometry_drift, max_tilt_deg=self.max_tilt_deg
        )

    def covariance_options(self) -> CovarianceOptions:
        """What of them concerns the published covariance."""
        return CovarianceOptions(
            position_scale=math.sqrt(self.position_covariance_scale),
            orientation_scale=math.sqrt(self.orientation_covariance_scale),
            position_floor=self.position_std_floor,
            orientation_floor=self.orientation_std_floor,
            mode=CovarianceMode(self.covariance_mode),
        )


SPECIFICATIONS: Mapping[str, Specification] = {
    entry.name: entry.metadata[_SPECIFICATION] for entry in fields(NodeParameters)
}


def declare_parameters(node: Node) -> NodeParameters:
    """Declares every parameter with its descriptor and reads the values given at the start.

    Raises:
        UsageError: A value of the wrong type or out of its range.
    """
    values = {}
    for entry in fields(NodeParameters):
        try:
            parameter = node.declare_parameter(
                entry.name, entry.default, _descriptor(entry.name, entry.default)
            )
        except InvalidParameterTypeException as err:
            hint = '; write a decimal point, as in 2.0' if isinstance(entry.default, float) else ''
            msg = f'parameter `{entry.name}`: {err}{hint}'
            raise UsageError(msg) from err
        except ParameterException as err:
            msg = f'parameter `{entry.name}`: {err}'
            raise UsageError(msg) from err
        values[entry.name] = parameter.value
    return NodeParameters(**values)


def known_among(parameters: Sequence[Parameter]) -> dict[str, Any]:
    """Names and values of the parameters that are of this node (not `use_sim_time` and others)."""
    return {entry.name: entry.value for entry in parameters if entry.name in SPECIFICATIONS}


def fixed_changes(current: NodeParameters, parameters: Sequence[Parameter]) -> list[str]:
    """Names of the parameters that would change and cannot while the node is configured."""
    return [
        name
        for name, value in known_among(parameters).items()
        if SPECIFICATIONS[name].fixed and value != getattr(current, name)
    ]


def _descriptor(name: str, default: object) -> ParameterDescriptor:
    specification = SPECIFICATIONS[name]
    descriptor = ParameterDescriptor(
        name=name,
        description=specification.description,
        additional_constraints=specification.constraints,
        read_only=specification.read_only,
    )
    if specification.bounds is not None:
        low, high = specification.bounds
        if isinstance(default, float):
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=float(low), to_value=float(high), step=0.0)
            ]
        else:
            descriptor.integer_range = [
                IntegerRange(from_value=int(low), to_value=int(high), step=1)
            ]
    return descriptor
