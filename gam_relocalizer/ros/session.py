# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What the node does while it is active: from an image that arrives to what is published."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pycolmap
from rclpy.clock import JumpThreshold
from rclpy.duration import Duration
from std_msgs.msg import Header

from gam_relocalizer.errors import TransformError
from gam_relocalizer.localization.continuity import Continuity
from gam_relocalizer.localization.result import LocalizationResult, Status
from gam_relocalizer.localization.robot_pose import robot_pose
from gam_relocalizer.replay.messages import calibration_of
from gam_relocalizer.ros.attempt import Attempt
from gam_relocalizer.ros.conversions import nanoseconds_from, pixels_from, stamp_from
from gam_relocalizer.ros.debug_image import draw_attempt
from gam_relocalizer.ros.inputs import Inputs
from gam_relocalizer.ros.prior_listener import PriorListener
from gam_relocalizer.ros.schedule import Schedule, StampedImage
from gam_relocalizer.ros.transform_listener import TransformListener

if TYPE_CHECKING:
    from rclpy.clock import TimeJump
    from rclpy.lifecycle import LifecycleNode
    from sensor_msgs.msg import CameraInfo, CompressedImage, Image

    from gam_relocalizer.cameras import CameraCalibration
    from gam_relocalizer.localization.continuity import ContinuityOptions
    from gam_relocalizer.localization.prior import Prior
    from gam_relocalizer.localization.robot_pose import RobotPose
    from gam_relocalizer.ros.outputs import Outputs
    from gam_relocalizer.ros.parameters import NodeParameters
    from gam_relocalizer.ros.worker import Worker

SAY_FIX_EACH_S = 1.0
SAY_REFUSAL_EACH_S = 5.0
SAY_SILENCE_EACH_S = 10.0
SAY_ODOMETRY_EACH_S = 10.0
ANY_JUMP_BACK = JumpThreshold(
    min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False
)


class Session:
    """One stretch of activity: subscriptions, timer, and the attempts in between."""

    def __init__(
        self,
        node: LifecycleNode,
        parameters: NodeParameters,
        worker: Worker,
        outputs: Outputs,
    ) -> None:
        self._log = node.get_logger()
        self._node = node
        self._parameters = parameters
        self._worker = worker
        self._outputs = outputs
        self._schedule = Schedule()
        self._calibration: CameraCalibration | None = None
        self._heard_an_image = False
        self._waited_for_calibration = False
        self._transforms: TransformListener | None = None
        self._listen_to_transforms()
        self._continuity = Continuity(self._continuity_options())
        self._prior_listener = PriorListener(node, parameters, self._continuity)
        self._inputs = Inputs(node, parameters, self._on_image, self._on_camera_info)
        self._timer = node.create_timer(parameters.period, self._on_tick)
        self._jump_handle = node.get_clock().create_jump_callback(
            ANY_JUMP_BACK, post_callback=self._on_jump_back
        )

    def close(self) -> None:
        """Ends the subscriptions; an attempt under way comes to nothing."""
        self._worker.abandon()
        self._jump_handle.unregister()
        self._node.destroy_timer(self._timer)
        self._inputs.destroy()
        self._prior_listener.destroy()
        if self._transforms is not None:
            self._transforms.destroy()

    def use(self, parameters: NodeParameters) -> None:
        """Takes other parameters from now on."""
        if parameters.period != self._parameters.period:
            self._timer.timer_period_ns = round(parameters.period * 1e9)
            self._timer.reset()
        self._parameters = parameters
        self._continuity.options = self._continuity_options()
        self._listen_to_transforms()

    def on_worker_done(self) -> None:
        """Publishes the result of the worker and starts the next attempt if one is due."""
        finished = self._worker.fetch()
        if finished is not None:
            self._report(*finished)
        self._proceed()

    def _continuity_options(self) -> ContinuityOptions:
        metric = self._worker.scene_map.manifest.frame.metric
        return self._parameters.continuity_options(metric=metric)

    def _listen_to_transforms(self) -> None:
        """Subscribes to the transforms if they are what tells the mount of the camera."""
        if self._parameters.mount() is not None or self._transforms is not None:
            return
        if self._parameters.base_frame:
            self._transforms = TransformListener(self._node)
        else:
            self._log.info(
                'the parameter `base_frame` is empty: the published pose is that of the camera '
                '(its optical frame), not of the robot',
                once=True,
            )

    # What arrives

    def _on_image(self, message: Image | CompressedImage) -> None:
        self._heard_an_image = True
        image = StampedImage(message, nanoseconds_from(message.header.stamp))
        if self._schedule.went_back(image.stamp_ns):
            self._restart('the stamps of the images jumped back')
        self._schedule.offer(image)
        self._proceed()

    def _on_camera_info(self, message: CameraInfo) -> None:
        self._calibration = calibration_of(message)
        self._proceed()

    def _on_tick(self) -> None:
        self._schedule.tick()
        if not self._heard_an_image:
            self._say_silence()
        if self._schedule.ready and self._calibration is None and self._gave_calibration_time():
            topic = self._inputs.camera_info_topic
            reason = (
                f'no CameraInfo has come on {topic}; have the driver publish it, or remap '
                f'camera_info'
            )
            self._refuse(self._schedule.take(), Status.NO_CALIBRATION, reason)
        self._proceed()

    def _gave_calibration_time(self) -> bool:
        """False once: the CameraInfo may come a moment after its image, and after this tick."""
        waited, self._waited_for_calibration = self._waited_for_calibration, True
        return waited

    def _on_jump_back(self, _jump: TimeJump) -> None:
        self._restart('the clock jumped back')

    def _restart(self, why: str) -> None:
        """Forgets what belongs to the time before a jump, so that a looping bag starts anew."""
        self._log.warning(f'{why}: starting anew')
        self._worker.abandon()
        self._schedule.restart()
        self._continuity.clear()
        self._outputs.forget_path()
        if self._transforms is not None:
            self._transforms.tree.clear_history()

    def _say_silence(self) -> None:
        topic = self._inputs.image_topic
        publishers = self._node.count_publishers(topic)
        self._log.warning(
            f'no image has come on {topic} yet ({publishers} publishers); remap it with '
            f'`-r image:=/your/topic`',
            throttle_duration_sec=SAY_SILENCE_EACH_S,
        )

    # Attempts

    def _proceed(self) -> None:
        """Starts an attempt if one is due and possible."""
        if self._worker.busy or self._calibration is None or not self._schedule.ready:
            return
        image = self._schedule.take()
        if not self._schedule.accepts(image.stamp_ns):
            reason = (
                f'the stamp of the image, {image.stamp_ns / 1e9:.6f} s, is not after that of the '
                f'last one tried; does the driver stamp its images?'
            )
            self._refuse(image, Status.STALE_IMAGE, reason)
            return
        self._worker.begin(
            Attempt(
                image=image,
                image_topic=self._inputs.image_topic,
                calibration=self._calibration,
                image_is_rectified=self._parameters.image_is_rectified,
                prior=self._prior(image),
            )
        )

    def _prior(self, image: StampedImage) -> Prior:
        try:
            base_from_camera = self._base_from_camera(image)
        except TransformError:  # it may come while the attempt is under way
            base_from_camera = None
        return self._continuity.prior(image.stamp_ns, base_from_camera)

    def _report(self, attempt: Attempt, result: LocalizationResult) -> None:
        result = self._publish(attempt.image, result)
        if self._outputs.debug_image_is_wanted and result.status is not Status.UNDECODABLE_IMAGE:
            pixels = pixels_from(attempt.image.message, attempt.image_topic)
            header = attempt.image.message.header
            self._outputs.publish_debug_image(header, draw_attempt(pixels, result))

    def _publish(self, image: StampedImage, result: LocalizationResult) -> LocalizationResult:
        """Publishes a result, and hands it back as it was published."""
        if not result.accepted or result.estimate is None:
            return self._publish_refusal(image, result)
        try:
            base_from_camera = self._base_from_camera(image)
        except TransformError as err:
            reason = f'{err}; publish the mount of the camera in TF or set `base_from_camera`'
            return self._publish_refusal(
                image, replace(result, status=Status.NO_TRANSFORM, reason=reason)
            )
        pose = robot_pose(result.estimate, base_from_camera, self._parameters.covariance_options())
        judged = self._judge(image, result, pose)
        if not judged.accepted:
            return self._publish_refusal(image, judged)
        header = self._header(image)
        self._outputs.publish_fix(header, pose, result.estimate.camera_from_map)
        self._outputs.publish_status(header, judged, self._worker.map_id)
        self._say_fix(pose, judged)
        return judged

    def _judge(
        self, image: StampedImage, result: LocalizationResult, pose: RobotPose
    ) -> LocalizationResult:
        """Holds back what odometry speaks against, and says so when odometry cannot be used."""
        result = self._continuity.judge(image.stamp_ns, result, pose)
        topic = self._prior_listener.odometry_topic
        if self._continuity.misses_odometry(image.stamp_ns):
            self._log.warning(
                f'the odometry on {topic} has nothing for the stamps of the images: fixes are not '
                f'compared with it; do their clocks agree?',
                throttle_duration_sec=SAY_ODOMETRY_EACH_S,
            )
        if self._continuity.doubts_odometry:
            self._log.warning(
                f'several fixes in a row fit neither each other nor the last one by the odometry '
                f'on {topic}: it is doubted, and fixes pass until two agree by it again; is it '
                f'that of this robot, in metres, and do its wheels slip?',
                throttle_duration_sec=SAY_ODOMETRY_EACH_S,
            )
        return result

    def _base_from_camera(self, image: StampedImage) -> pycolmap.Rigid3d:
        mount = self._parameters.mount()
        if mount is not None:
            return mount
        if self._transforms is None:
            return pycolmap.Rigid3d()
        camera_frame = image.message.header.frame_id
        if not camera_frame:
            msg = f'the images on {self._inputs.image_topic} have no frame_id'
            raise TransformError(msg)
        return self._transforms.tree.lookup(
            self._parameters.base_frame, camera_frame, image.stamp_ns
        )

    def _refuse(self, image: StampedImage, status: Status, reason: str) -> None:
        self._publish_refusal(image, LocalizationResult(status, reason))

    def _publish_refusal(
        self, image: StampedImage, result: LocalizationResult
    ) -> LocalizationResult:
        self._outputs.publish_status(self._header(image), result, self._worker.map_id)
        self._log.warning(
            f'no fix, {result.status.name}: {result.reason}',
            throttle_duration_sec=SAY_REFUSAL_EACH_S,
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
