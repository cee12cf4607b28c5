# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The managed node: what happens between its states, and its parameters.

Everything but the inference happens in the thread that spins the node. Image callbacks store the
newest message; the worker's thread owns the model and does one attempt at a time; a guard
condition brings its result back to the spinning thread. Nothing queues.
"""

from __future__ import annotations

import traceback
from dataclasses import replace
from functools import wraps
from typing import TYPE_CHECKING

import torch
from rcl_interfaces.msg import SetParametersResult
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from std_msgs.msg import Header

from gam_relocalizer.errors import RelocalizerError, UsageError
from gam_relocalizer.localization.localizer import Localizer
from gam_relocalizer.ros.outputs import Outputs
from gam_relocalizer.ros.parameters import declare_parameters, fixed_changes, known_among
from gam_relocalizer.ros.session import Session
from gam_relocalizer.ros.worker import Worker

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rclpy.parameter import Parameter

    from gam_relocalizer.scene_map import SceneMap

    Transition = Callable[['RelocalizerNode', LifecycleState], TransitionCallbackReturn]

NODE_NAME = 'gam_relocalizer'


def _reported(transition: Transition) -> Transition:
    """Puts what went wrong in a transition into the log: rclpy swallows it."""

    @wraps(transition)
    def report(node: RelocalizerNode, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            return transition(node, state)
        except RelocalizerError as err:
            node.get_logger().error(str(err))
            return TransitionCallbackReturn.FAILURE
        except Exception:
            if node.context.ok():  # else everything fails, as the process is about to end
                node.get_logger().error(traceback.format_exc())
            return TransitionCallbackReturn.ERROR

    return report


class RelocalizerNode(LifecycleNode):
    """A managed node that publishes where the robot is in a map, from images of its camera."""

    def __init__(self, parameter_overrides: Sequence[Parameter] = ()) -> None:
        """Declares parameters and publishers; the map is loaded on configuration.

        Args:
            parameter_overrides: Values that go before those of the command line.

        Raises:
            UsageError: A parameter has a value that it cannot have.
        """
        super().__init__(NODE_NAME, parameter_overrides=list(parameter_overrides))
        self._settings = declare_parameters(self)
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._use_parameters)
        self._outputs = Outputs(self)
        self._worker_done = self.create_guard_condition(self._on_worker_done)
        self._worker: Worker | None = None
        self._session: Session | None = None

    def start(self) -> None:
        """Configures and activates, if the parameter `autostart` says so."""
        if not self._settings.autostart:
            return
        if self.trigger_configure() == TransitionCallbackReturn.SUCCESS:
            self.trigger_activate()
        elif self.context.ok():
            self.get_logger().error(
                f'not configured, waiting: mend that, then `ros2 lifecycle set '
                f'{self.get_fully_qualified_name()} configure` and `activate`, or start again'
            )

    @_reported
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Loads the map and the networks."""
        self._worker = self._load()
        return super().on_configure(state)

    @_reported
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribes and starts the timer."""
        if self._worker is None:
            msg = 'active without being configured'
            raise RuntimeError(msg)
        self._session = Session(self, self._settings, self._worker, self._outputs)
        self.get_logger().info(f'active: one attempt each {self._settings.period:g} s')
        outcome = super().on_activate(state)  # publishers are silent before
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id=self._settings.map_frame)
        self._outputs.publish_map_points(header, self._worker.scene_map.points)
        return outcome

    @_reported
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Ends the subscriptions and the timer."""
        self._end_session()
        return super().on_deactivate(state)

    @_reported
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Frees the map and the networks."""
        self._unload()
        return super().on_cleanup(state)

    @_reported
    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Ends everything, from whatever state."""
        self._unload()
        return super().on_shutdown(state)

    @_reported
    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Frees everything: after an error the node is unconfigured."""
        self._unload()
        return super().on_error(state)

    def destroy_node(self) -> None:
        """Waits for the attempt under way, then takes the node down."""
        self._unload()
        super().destroy_node()

    def _load(self) -> Worker:
        if not self._settings.map:
            msg = 'the parameter `map` is empty; expected the directory of a map bundle'
            raise UsageError(msg)
        if self._settings.torch_threads:
            torch.set_num_threads(self._settings.torch_threads)
        localizer = Localizer.load(self._settings.path('map'), self._settings.localizer_options())
        self._introduce(localizer.scene_map)
        return Worker(localizer, self._worker_done.trigger)

    def _introduce(self, scene_map: SceneMap) -> None:
        """Says which map is loaded, and warns when its frame is none that a robot can drive by."""
        manifest, log = scene_map.manifest, self.get_logger()
        log.info(
            f'map {scene_map.path} ({manifest.map_id}): {scene_map.num_images} images, '
            f'{len(scene_map.points)} points; extractor {manifest.extractor.name}, matcher '
            f'{self._settings.matcher}; networks on the CPU with {torch.get_num_threads()} threads'
        )
        if manifest.frame.metric:
            log.info(f'the map is metric: {manifest.frame.source}')
        else:
            log.warning(
                f'the map is not metric ({manifest.frame.source}): its poses are in no frame '
                f'`{self._settings.map_frame}` in the sense of REP-105 (metres, z up), and neither '
                f'odom nor initialpose nor max_tilt_deg is used'
            )

    def _end_session(self) -> None:
        if self._session is not None:
            self._session.close()
            self._session = None

    def _unload(self) -> None:
        self._end_session()
        if self._worker is not None:
            self._worker.close()
            self._worker = None

    def _on_worker_done(self) -> None:
        if self._session is not None:
            self._session.on_worker_done()
        elif self._worker is not None:
            self._worker.fetch()

    def _check_parameters(self, changed: list[Parameter]) -> SetParametersResult:
        fixed = fixed_changes(self._settings, changed)
        if fixed and self._worker is not None:
            reason = f'{", ".join(fixed)}: cannot change while the node is configured'
            return SetParametersResult(successful=False, reason=reason)
        try:
            replace(self._settings, **known_among(changed))
        except UsageError as err:
            return SetParametersResult(successful=False, reason=str(err))
        return SetParametersResult(successful=True)

    def _use_parameters(self, changed: list[Parameter]) -> None:
        self._settings = replace(self._settings, **known_among(changed))
        if self._worker is not None:
            self._worker.use(self._settings.localizer_options())
        if self._session is not None:
            self._session.use(self._settings)
