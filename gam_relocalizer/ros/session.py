# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What the node does while it is active: which image is tried when, and who hears of it."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import pycolmap
from rclpy.clock import Clock, JumpThreshold
from rclpy.clock_type import ClockType
from rclpy.duration import Duration

from gam_relocalizer.errors import TransformError
from gam_relocalizer.localization.continuity import Continuity
from gam_relocalizer.localization.prior import Prior
from gam_relocalizer.localization.result import LocalizationResult, Status
from gam_relocalizer.localization.robot_pose import robot_pose
from gam_relocalizer.replay.messages import calibration_of
from gam_relocalizer.ros.attempt import Attempt
from gam_relocalizer.ros.conversions import nanoseconds_from
from gam_relocalizer.ros.inputs import Inputs
from gam_relocalizer.ros.map_odom_broadcaster import MapOdomBroadcaster
from gam_relocalizer.ros.mount import Mount
from gam_relocalizer.ros.prior_listener import PriorListener
from gam_relocalizer.ros.reporter import Reporter
from gam_relocalizer.ros.requests import Answer, BroughtImages, CameraRequests
from gam_relocalizer.ros.schedule import Schedule, StampedImage
from gam_relocalizer.ros.transform_listener import TransformListener

if TYPE_CHECKING:
    from rclpy.clock import TimeJump
    from rclpy.lifecycle import LifecycleNode
    from rclpy.task import Future
    from sensor_msgs.msg import CameraInfo, CompressedImage, Image

    from gam_relocalizer.cameras import CameraCalibration
    from gam_relocalizer.localization.continuity import ContinuityOptions
    from gam_relocalizer.ros.health import Health
    from gam_relocalizer.ros.outputs import Outputs
    from gam_relocalizer.ros.parameters import NodeParameters
    from gam_relocalizer.ros.worker import Worker

SAY_SILENCE_EACH_S = 10.0
# What a VIO says of an image comes after it; nobody's attempts are held up for longer.
PATIENCE_NS = 300_000_000
PATIENCE_STEP_S = 0.02
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
        health: Health,
    ) -> None:
        self._log = node.get_logger()
        self._node = node
        self._parameters = parameters
        self._worker = worker
        self._outputs = outputs
        self._health = health
        self._schedule = Schedule()
        self._enabled = True
        self._calibration: CameraCalibration | None = None
        self._heard_an_image = False
        self._waited_for_calibration = False
        # what an attempt that began in an earlier one gives is of no interest any more
        self._epoch = 0
        self._camera_had_its_turn = False
        # an image that is due, and waits for odometry and transforms of its time
        self._candidate: StampedImage | None = None
        self._patience_ends_ns = 0
        self._steady_clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._patience_timer = node.create_timer(
            PATIENCE_STEP_S, self._on_patience, clock=self._steady_clock
        )
        self._camera_requests = CameraRequests(node, self._why_late)
        self._brought_images = BroughtImages()
        self._continuity = Continuity(self._continuity_options())
        self._transforms = TransformListener(node)
        self._mount = Mount(node, parameters, self._transforms)
        self._reporter = Reporter(node, parameters, outputs, self._mount, self._continuity, health)
        self._prior_listener = PriorListener(node, parameters, self._continuity, health)
        self._broadcaster = MapOdomBroadcaster(
            node, parameters, self._continuity, self._prior_listener, self._transforms, health
        )
        self._inputs = Inputs(node, parameters, self._on_image, self._on_camera_info)
        health.activated(
            self._inputs.image_topic, parameters.period, broadcasts=parameters.publish_map_odom
        )
        self._timer = node.create_timer(parameters.period, self._on_tick)
        self._jump_handle = node.get_clock().create_jump_callback(
            ANY_JUMP_BACK, post_callback=self._on_jump_back
        )

    def close(self) -> None:
        """Ends the subscriptions; an attempt under way comes to nothing."""
        self._epoch += 1
        over = Answer(LocalizationResult(Status.NOT_ACTIVE, 'the node was deactivated meanwhile'))
        self._camera_requests.answer_all(over)
        self._brought_images.answer_all(over)
        self._jump_handle.unregister()
        self._node.destroy_timer(self._timer)
        self._node.destroy_timer(self._patience_timer)
        self._inputs.destroy()
        self._broadcaster.destroy()
        self._prior_listener.destroy()
        self._transforms.destroy()

    def use(self, parameters: NodeParameters) -> None:
        """Takes other parameters from now on."""
        if parameters.period != self._parameters.period:
            self._timer.timer_period_ns = round(parameters.period * 1e9)
            self._timer.reset()
        self._parameters = parameters
        self._health.period_s = parameters.period
        self._continuity.options = self._continuity_options()
        self._mount.use(parameters)
        self._broadcaster.use(parameters)
        self._reporter.use(parameters)

    def map_was_replaced(self) -> None:
        """Forgets what belongs to the map before; an attempt under way on it comes to nothing."""
        self._forget('the map was replaced meanwhile; ask again')
        self._continuity.options = self._continuity_options()

    def set_enabled(self, *, enabled: bool) -> None:
        """Goes on with, or stops, attempts that nobody asks for."""
        self._enabled = enabled
        if enabled:
            self._schedule.tick()
            self.proceed()
        else:
            self._schedule.rest()

    def relocalize(self, timeout_s: float) -> Future:
        """Tries the next image that comes.

        Args:
            timeout_s: How long to wait for the attempt to begin.

        Returns:
            The future of an `Answer`, with the pose of the base.
        """
        return self._camera_requests.add(timeout_s)

    def localize_image(self, image: Image, camera_info: CameraInfo) -> Future:
        """Tries an image of whatever camera, and publishes nothing.

        Returns:
            The future of an `Answer`, with the pose of that camera.
        """
        attempt = Attempt(
            image=StampedImage(image, nanoseconds_from(image.header.stamp)),
            image_topic='the request',
            calibration=calibration_of(camera_info),
            image_is_rectified=False,
            prior=Prior(),
        )
        future = self._brought_images.add(attempt)
        self.proceed()
        return future

    def proceed(self) -> None:
        """Starts an attempt if one is wanted and possible: camera and callers take turns."""
        if self._worker.busy:
            return
        if self._brought_images.ready and (self._camera_had_its_turn or not self._camera_is_ready):
            self._begin_brought()
        elif self._camera_is_ready:
            self._begin_camera()

    def _continuity_options(self) -> ContinuityOptions:
        metric = self._worker.scene_map.manifest.frame.metric
        return self._parameters.continuity_options(metric=metric)

    # What arrives

    def _on_image(self, message: Image | CompressedImage) -> None:
        self._heard_an_image = True
        image = StampedImage(message, nanoseconds_from(message.header.stamp))
        self._health.image_came(self._node.get_clock().now().nanoseconds - image.stamp_ns)
        if self._schedule.went_back(image.stamp_ns):
            self._restart('the stamps of the images jumped back')
        self._schedule.offer(image)
        if self._camera_requests.image_came():
            self._schedule.tick()
        self.proceed()

    def _on_camera_info(self, message: CameraInfo) -> None:
        self._calibration = calibration_of(message)
        self.proceed()

    def _on_tick(self) -> None:
        if not self._enabled:
            return
        self._health.period_over(busy=self._worker.busy)
        self._schedule.tick()
        if not self._heard_an_image:
            self._say_silence()
        if self._schedule.ready and self._calibration is None and self._gave_calibration_time():
            self._refuse(self._schedule.take(), Status.NO_CALIBRATION, self._no_calibration())
        self.proceed()

    def _gave_calibration_time(self) -> bool:
        """False once: the CameraInfo may come a moment after its image, and after this tick."""
        waited, self._waited_for_calibration = self._waited_for_calibration, True
        return waited

    def _on_jump_back(self, _jump: TimeJump) -> None:
        self._restart('the clock jumped back')

    def _restart(self, why: str) -> None:
        """Forgets what belongs to the time before a jump, so that a looping bag starts anew."""
        self._log.warning(f'{why}: starting anew')
        self._health.time_jumped()
        self._forget(f'{why} meanwhile; ask again')
        self._schedule.restart(due=self._enabled)
        self._transforms.tree.clear_history()

    def _forget(self, why: str) -> None:
        self._epoch += 1
        self._candidate = None
        self._camera_requests.answer(Answer(LocalizationResult(Status.NO_IMAGE, why)))
        self._continuity.clear()
        self._outputs.forget_path()

    def _say_silence(self) -> None:
        self._log.warning(
            f'{self._no_image()}; remap it with `-r image:=/your/topic`',
            throttle_duration_sec=SAY_SILENCE_EACH_S,
        )

    def _no_image(self) -> str:
        topic = self._inputs.image_topic
        return f'no image has come on {topic} yet ({self._node.count_publishers(topic)} publishers)'

    def _no_calibration(self) -> str:
        topic = self._inputs.camera_info_topic
        return (
            f'no CameraInfo has come on {topic}; have the driver publish it, or remap camera_info'
        )

    def _why_late(self, has_image: bool) -> LocalizationResult:  # noqa: FBT001 - of a callback
        if not has_image:
            return LocalizationResult(
                Status.NO_IMAGE,
                f'no image came on {self._inputs.image_topic} before the time was over',
            )
        if self._calibration is None:
            return LocalizationResult(Status.NO_CALIBRATION, self._no_calibration())
        return LocalizationResult(Status.BUSY, 'other attempts took until the time was over')

    # Attempts

    @property
    def _camera_is_ready(self) -> bool:
        if self._candidate is not None:
            return not self._is_early(self._candidate)
        return self._calibration is not None and self._schedule.ready

    def _begin_camera(self) -> None:
        """Tries the image that is due, or waits with it for what is known of its time."""
        if self._candidate is None:
            self._candidate = self._take()
        if self._candidate is None:
            self.proceed()
        elif not self._is_early(self._candidate):
            self._try(self._candidate)

    def _take(self) -> StampedImage | None:
        """The image that is due; None when it cannot be tried."""
        image = self._schedule.take()
        self._camera_requests.begin()
        if self._schedule.accepts(image.stamp_ns):
            self._patience_ends_ns = self._steady_clock.now().nanoseconds + PATIENCE_NS
            self._patience_timer.reset()
            return image
        reason = (
            f'the stamp of the image, {image.stamp_ns / 1e9:.6f} s, is not after that of the '
            f'last one tried; does the driver stamp its images?'
        )
        self._refuse(image, Status.STALE_IMAGE, reason)
        return None

    def _is_early(self, image: StampedImage) -> bool:
        """Whether odometry and transforms for the time of an image may still be on their way."""
        if self._steady_clock.now().nanoseconds >= self._patience_ends_ns:
            return False
        return self._continuity.awaits_odometry(image.stamp_ns) or not self._mount.is_known(image)

    def _on_patience(self) -> None:
        if self._candidate is None:
            self._patience_timer.cancel()
        self.proceed()

    def _try(self, image: StampedImage) -> None:
        if self._calibration is None:
            msg = 'an attempt without a calibration'
            raise RuntimeError(msg)
        self._candidate = None
        self._camera_had_its_turn = True
        attempt = Attempt(
            image=image,
            image_topic=self._inputs.image_topic,
            calibration=self._calibration,
            image_is_rectified=self._parameters.image_is_rectified,
            prior=self._prior(image),
        )
        self._worker.begin(attempt, partial(self._end_camera, attempt, self._epoch))

    def _prior(self, image: StampedImage) -> Prior:
        try:
            base_from_camera = self._mount.base_from_camera(image)
        except TransformError:  # it may come while the attempt is under way
            base_from_camera = None
        return self._continuity.prior(image.stamp_ns, base_from_camera)

    def _end_camera(self, attempt: Attempt, epoch: int, result: LocalizationResult) -> None:
        if epoch == self._epoch:
            answer = self._reporter.report(attempt, result, self._worker.map_id)
            self._camera_requests.answer(answer)

    def _refuse(self, image: StampedImage, status: Status, reason: str) -> None:
        answer = self._reporter.refuse(image, status, reason, self._worker.map_id)
        self._camera_requests.answer(answer)

    def _begin_brought(self) -> None:
        attempt = self._brought_images.begin()
        self._camera_had_its_turn = False
        self._worker.begin(attempt, partial(self._end_brought, attempt, self._worker.map_id))

    def _end_brought(self, attempt: Attempt, map_id: str, result: LocalizationResult) -> None:
        pose = None
        if result.accepted and result.estimate is not None:
            options = self._parameters.covariance_options()
            pose = robot_pose(result.estimate, pycolmap.Rigid3d(), options)
        self._brought_images.answer(Answer(result, map_id, attempt.image.stamp_ns, pose))
