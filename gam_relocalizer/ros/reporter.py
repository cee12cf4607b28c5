# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""From what an attempt gave to what the world is told."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from std_msgs.msg import Header

from gam_relocalizer.errors import TransformError
from gam_relocalizer.localization.result import LocalizationResult, Status
from gam_relocalizer.localization.robot_pose import robot_pose
from gam_relocalizer.ros.conversions import pixels_from, stamp_from
from gam_relocalizer.ros.debug_image import draw_attempt
from gam_relocalizer.ros.interface import Topic
from gam_relocalizer.ros.requests import Answer

if TYPE_CHECKING:
    from rclpy.node import Node

    from gam_relocalizer.localization.continuity import Continuity
    from gam_relocalizer.localization.robot_pose import RobotPose
    from gam_relocalizer.ros.attempt import Attempt
    from gam_relocalizer.ros.health import Health
    from gam_relocalizer.ros.mount import Mount
    from gam_relocalizer.ros.outputs import Outputs
    from gam_relocalizer.ros.parameters import NodeParameters
    from gam_relocalizer.ros.schedule import StampedImage

SAY_FIX_EACH_S = 1.0
SAY_REFUSAL_EACH_S = 5.0
SAY_ODOMETRY_EACH_S = 10.0


class Reporter:
    """Judges a result by what came before it, publishes it and puts it into the log."""

    def __init__(
        self,
        node: Node,
        parameters: NodeParameters,
        outputs: Outputs,
        mount: Mount,
        continuity: Continuity,
        health: Health,
    ) -> None:
        self._log = node.get_logger()
        self._odometry_topic = node.resolve_topic_name(Topic.ODOMETRY.topic)
        self._parameters = parameters
        self._outputs = outputs
        self._mount = mount
        self._continuity = continuity
        self._health = health

    def use(self, parameters: NodeParameters) -> None:
        """Takes other parameters from now on."""
        self._parameters = parameters

    def report(self, attempt: Attempt, result: LocalizationResult, map_id: str) -> Answer:
        """Publishes what came of an attempt; hands back what was published."""
        answer = self._publish(attempt.image, result, map_id)
        self._health.attempt_finished(answer.result)
        if self._outputs.debug_image_is_wanted and result.status is not Status.UNDECODABLE_IMAGE:
            pixels = pixels_from(attempt.image.message, attempt.image_topic)
            header = attempt.image.message.header
            self._outputs.publish_debug_image(header, draw_attempt(pixels, answer.result))
        return answer

    def refuse(self, image: StampedImage, status: Status, reason: str, map_id: str) -> Answer:
        """Publishes that an image cannot be tried."""
        result = LocalizationResult(status, reason)
        self._health.attempt_finished(result)
        return self._publish_refusal(image, result, map_id)

    def _publish(self, image: StampedImage, result: LocalizationResult, map_id: str) -> Answer:
        if not result.accepted or result.estimate is None:
            return self._publish_refusal(image, result, map_id)
        try:
            base_from_camera = self._mount.base_from_camera(image)
        except TransformError as err:
            reason = f'{err}; publish the mount of the camera in TF or set `base_from_camera`'
            homeless = replace(result, status=Status.NO_TRANSFORM, reason=reason)
            return self._publish_refusal(image, homeless, map_id)
        pose = robot_pose(result.estimate, base_from_camera, self._parameters.covariance_options())
        judged = self._judge(image, result, pose)
        if not judged.accepted:
            return self._publish_refusal(image, judged, map_id)
        header = self._header(image)
        self._outputs.publish_fix(header, pose, result.estimate.camera_from_map)
        self._outputs.publish_status(header, judged, map_id)
        self._say_fix(pose, judged)
        return Answer(judged, map_id, image.stamp_ns, pose)

    def _publish_refusal(
        self, image: StampedImage, result: LocalizationResult, map_id: str
    ) -> Answer:
        self._outputs.publish_status(self._header(image), result, map_id)
        self._log.warning(
            f'no fix, {result.status.name}: {result.reason}',
            throttle_duration_sec=SAY_REFUSAL_EACH_S,
        )
        return Answer(result, map_id, image.stamp_ns)

    def _judge(
        self, image: StampedImage, result: LocalizationResult, pose: RobotPose
    ) -> LocalizationResult:
        """Holds back what odometry speaks against, and says so when odometry cannot be used."""
        result = self._continuity.judge(image.stamp_ns, result, pose)
        missing = self._continuity.misses_odometry(image.stamp_ns)
        self._health.fix_compared(missing=missing, doubted=self._continuity.doubts_odometry)
        if missing:
            self._log.warning(
                f'the odometry on {self._odometry_topic} has nothing for the stamps of the images: '
                f'fixes are not compared with it; do their clocks agree?',
                throttle_duration_sec=SAY_ODOMETRY_EACH_S,
            )
        if self._continuity.doubts_odometry:
            self._log.warning(
                f'several fixes in a row fit neither each other nor the last one by the odometry '
                f'on {self._odometry_topic}: it is doubted, and fixes pass until two agree by it '
                f'again; is it that of this robot, in metres, and do its wheels slip?',
                throttle_duration_sec=SAY_ODOMETRY_EACH_S,
            )
        return result

    def _say_fix(self, pose: RobotPose, result: LocalizationResult) -> None:
        x, y, z = pose.map_from_base.translation
        self._log.info(
            f'fix at {x:.3f} {y:.3f} {z:.3f}: {result.reason}; {result.timings.total:.0f} ms',
            throttle_duration_sec=SAY_FIX_EACH_S,
        )

    def _header(self, image: StampedImage) -> Header:
        return Header(stamp=stamp_from(image.stamp_ns), frame_id=self._parameters.map_frame)
