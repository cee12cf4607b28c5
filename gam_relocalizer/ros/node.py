# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The managed node: what happens between its states, and its parameters.

Everything but the inference happens in the thread that spins the node. Image callbacks store the
newest message; the worker's thread owns the model and does one attempt at a time; another one
loads a map that is to replace it; a guard condition brings what they did back to the spinning
thread. Images do not queue.
"""

from __future__ import annotations

import traceback
from dataclasses import replace
from functools import partial, wraps
from typing import TYPE_CHECKING

import torch
from rcl_interfaces.msg import SetParametersResult
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.task import Future
from std_msgs.msg import Header

from gam_relocalizer.errors import RelocalizerError, UsageError
from gam_relocalizer.localization.localizer import Localizer
from gam_relocalizer.localization.result import LocalizationResult, Status
from gam_relocalizer.ros.diagnostics import Diagnostics
from gam_relocalizer.ros.health import Health, State
from gam_relocalizer.ros.interface import MAP_POINTS_SHOWN
from gam_relocalizer.ros.map_loader import MapLoader
from gam_relocalizer.ros.memory import give_back_freed_memory
from gam_relocalizer.ros.outputs import Outputs
from gam_relocalizer.ros.parameters import declare_parameters, fixed_changes, known_among
from gam_relocalizer.ros.requests import Answer, answered
from gam_relocalizer.ros.services import Services
from gam_relocalizer.ros.session import Session
from gam_relocalizer.ros.worker import Worker

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from sensor_msgs.msg import CameraInfo, Image

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
            node.health.failed(str(err))
            node.get_logger().error(str(err))
            return TransitionCallbackReturn.FAILURE
        except Exception:
            if node.context.ok():  # else everything fails, as the process is about to end
                trace = traceback.format_exc()
                node.health.failed(trace.splitlines()[-1])
                node.get_logger().error(trace)
            return TransitionCallbackReturn.ERROR

    return report


class RelocalizerNode(LifecycleNode):
    """A managed node that publishes where the robot is in a map, from images of its camera.

    Attributes:
        health: What the node counts of itself.
    """

    def __init__(
        self, parameter_overrides: Sequence[Parameter] = (), *, namespace: str = ''
    ) -> None:
        """Declares parameters and publishers; the map is loaded on configuration.

        Args:
            parameter_overrides: Values that go before those of the command line.
            namespace: Of the node; that of the command line goes before it.

        Raises:
            UsageError: A parameter has a value that it cannot have.
        """
        super().__init__(
            NODE_NAME, namespace=namespace, parameter_overrides=list(parameter_overrides)
        )
        self.health = Health()
        self._diagnostics = Diagnostics(self, self.health)
        self._settings = declare_parameters(self)
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._use_parameters)
        self._outputs = Outputs(self)
        self._thread_done = self.create_guard_condition(self._on_thread_done)
        self._loader = MapLoader(self._thread_done.trigger)
        self._worker: Worker | None = None
        self._session: Session | None = None
        self._offered = Services(self, self)

    def start(self) -> None:
        """Configures and activates, if the parameter `autostart` says so."""
        if not self._settings.autostart:
            return
        if self.trigger_configure() == TransitionCallbackReturn.SUCCESS:
            self.trigger_activate()
        elif self.context.ok():
            self.get_logger().error(
                f'not configured, waiting: mend that, then {self._how_to()}, or start again'
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
        self._session = Session(self, self._settings, self._worker, self._outputs, self.health)
        self.get_logger().info(f'active: one attempt each {self._settings.period:g} s')
        outcome = super().on_activate(state)  # publishers are silent before
        self._show_map(self._worker.scene_map)
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
        self.health.shut_down()
        return super().on_shutdown(state)

    @_reported
    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Frees everything: after an error the node is unconfigured."""
        self._unload()
        return super().on_error(state)

    def destroy_node(self) -> None:
        """Waits for the attempt and the map under way, then takes the node down."""
        self._loader.close()
        self._unload()
        super().destroy_node()

    # What the services ask for

    @property
    def map_frame(self) -> str:
        """Frame of the published poses."""
        return self._settings.map_frame

    @property
    def map_id(self) -> str:
        """Identity of the map in use, or empty."""
        return '' if self._worker is None else self._worker.map_id

    def relocalize(self, timeout_s: float) -> Future:
        """Tries the next image; see `Session.relocalize`."""
        if self._session is None:
            return answered(self._not_active())
        return self._session.relocalize(timeout_s)

    def localize_image(self, image: Image, camera_info: CameraInfo) -> Future:
        """Tries an image of the caller; see `Session.localize_image`."""
        if self._session is None:
            return answered(self._not_active())
        return self._session.localize_image(image, camera_info)

    def set_enabled(self, *, enabled: bool) -> tuple[bool, str]:
        """Goes on with, or stops, attempts that nobody asks for."""
        if self._session is None:
            return False, self._not_active().result.reason
        self._session.set_enabled(enabled=enabled)
        self.health.set_enabled(enabled=enabled)
        what = f'one attempt each {self._settings.period:g} s' if enabled else 'only on request'
        self.get_logger().info(f'attempts: {what}')
        return True, what

    def load_map(self, path: str) -> Future:
        """Loads another map beside the one in use, which serves until then.

        Returns:
            The future of whether it is in use now, and what there is to say.
        """
        future = Future()
        if self.health.state is State.FINALIZED:
            future.set_result((False, self._not_active().result.reason))
        elif self._loader.busy:
            future.set_result((False, 'another map is being loaded; ask again later'))
        elif self._worker is None:
            future.set_result(self._start_with(path))
        else:
            settings = replace(self._settings, map=path)
            try:
                place, options = settings.path('map'), settings.localizer_options()
            except UsageError as err:
                future.set_result((False, str(err)))
            else:
                self._loader.begin(place, options, partial(self._end_loading, future, path))
        return future

    def _start_with(self, path: str) -> tuple[bool, str]:
        """Configures and activates with a map, as at the start of the process."""
        if not self._settings.autostart:
            return False, f'the node is unconfigured: set the parameter `map`, and {self._how_to()}'
        self._set_map(path)
        self.start()
        if self._worker is None:
            return False, self.health.error
        return True, self._describe(self._worker.scene_map)

    def _end_loading(self, future: Future, path: str, loaded: Localizer | RelocalizerError) -> None:
        if isinstance(loaded, RelocalizerError):
            self.get_logger().error(f'the map stays as it was: {loaded}')
            self.health.map_refused(str(loaded))
            future.set_result((False, str(loaded)))
        elif self._worker is None:
            future.set_result((False, 'the node was cleaned up meanwhile'))
        else:
            self._worker.replace(loaded.with_options(self._settings.localizer_options()))
            self._set_map(path)
            self._introduce(loaded.scene_map)
            if self._session is not None:
                self._session.map_was_replaced()
                self._show_map(loaded.scene_map)
            future.set_result((True, self._describe(loaded.scene_map)))
            give_back_freed_memory()

    def _set_map(self, path: str) -> None:
        """Makes the parameter say which map it is."""
        self._settings = replace(self._settings, map=path)
        self.set_parameters([Parameter('map', value=path)])

    def _not_active(self) -> Answer:
        reason = f'the node is {self.health.state.value}: {self._how_to()}'
        return Answer(LocalizationResult(Status.NOT_ACTIVE, reason), self.map_id)

    def _how_to(self) -> str:
        """What makes the node active."""
        if self.health.state is State.FINALIZED:
            return 'it was shut down; start its process again'
        states = ('activate',) if self._worker is not None else ('configure', 'activate')
        name = self.get_fully_qualified_name()
        return ' and '.join(f'`ros2 lifecycle set {name} {state}`' for state in states)

    # Map and networks

    def _load(self) -> Worker:
        if not self._settings.map:
            msg = 'the parameter `map` is empty; expected the directory of a map bundle'
            raise UsageError(msg)
        if self._settings.torch_threads:
            torch.set_num_threads(self._settings.torch_threads)
        localizer = Localizer.load(self._settings.path('map'), self._settings.localizer_options())
        self._introduce(localizer.scene_map)
        return Worker(localizer, self._thread_done.trigger)

    def _describe(self, scene_map: SceneMap) -> str:
        manifest = scene_map.manifest
        return (
            f'map {scene_map.path} ({manifest.map_id}): {scene_map.num_images} images, '
            f'{scene_map.num_points} points; extractor {manifest.extractor.name}, matcher '
            f'{self._settings.matcher}; networks on the CPU with {torch.get_num_threads()} threads'
        )

    def _introduce(self, scene_map: SceneMap) -> None:
        """Says which map is loaded, and warns when its frame is none that a robot can drive by."""
        manifest, log = scene_map.manifest, self.get_logger()
        log.info(self._describe(scene_map))
        self.health.map_loaded(scene_map, f'cpu, {torch.get_num_threads()} threads')
        if manifest.frame.metric:
            log.info(f'the map is metric: {manifest.frame.source}')
        else:
            log.warning(
                f'the map is not metric ({manifest.frame.source}): its poses are in no frame '
                f'`{self._settings.map_frame}` in the sense of REP-105 (metres, z up), and neither '
                f'odom nor initialpose nor max_tilt_deg is used'
            )

    def _show_map(self, scene_map: SceneMap) -> None:
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id=self._settings.map_frame)
        self._outputs.publish_map_points(header, scene_map.some_points(MAP_POINTS_SHOWN))

    def _end_session(self) -> None:
        if self._session is not None:
            self._session.close()
            self._session = None
            self.health.deactivated()

    def _unload(self) -> None:
        self._end_session()
        if self._worker is not None:
            self._worker.close()
            self._worker = None
            self.health.unloaded()
            give_back_freed_memory()

    def _on_thread_done(self) -> None:
        """Takes over what the worker or the loader has done."""
        self._loader.finish()
        if self._worker is not None:
            self._worker.finish()
        if self._session is not None:
            self._session.proceed()

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
