# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The services of the node: every request is answered with what came of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

from rclpy.callback_groups import ReentrantCallbackGroup
from std_msgs.msg import Header

from gam_relocalizer.ros.conversions import (
    nanoseconds_from,
    pose_with_covariance_message,
    stamp_from,
    status_message,
)
from gam_relocalizer.ros.interface import Service

if TYPE_CHECKING:
    from rclpy.node import Node
    from rclpy.task import Future
    from sensor_msgs.msg import CameraInfo, Image
    from std_srvs.srv import SetBool

    from gam_relocalizer.ros.requests import Answer
    from gam_relocalizer_msgs.srv import LoadMap, LocalizeImage, Relocalize

DEFAULT_TIMEOUT_S = 5.0
NANOSECONDS = 10**9


class Desk(Protocol):
    """What the services ask the node for."""

    @property
    def map_frame(self) -> str:
        """Frame of the poses."""

    @property
    def map_id(self) -> str:
        """Identity of the map in use, or empty."""

    def relocalize(self, timeout_s: float) -> Future:
        """The future of an `Answer`."""

    def localize_image(self, image: Image, camera_info: CameraInfo) -> Future:
        """The future of an `Answer`."""

    def load_map(self, path: str) -> Future:
        """The future of whether it was loaded, and what there is to say."""

    def set_enabled(self, *, enabled: bool) -> tuple[bool, str]:
        """Whether that was done, and what there is to say."""


class Services:
    """Offers the services in every state of the node.

    A request is a coroutine that waits beside everything else that the node does: a callback group
    that excludes others would hold up the node until the answer.
    """

    def __init__(self, node: Node, desk: Desk) -> None:
        self._desk = desk
        group = ReentrantCallbackGroup()
        for offered, callback in (
            (Service.RELOCALIZE, self._relocalize),
            (Service.LOCALIZE_IMAGE, self._localize_image),
            (Service.LOAD_MAP, self._load_map),
            (Service.SET_ENABLED, self._set_enabled),
        ):
            node.create_service(offered.kind, offered.service, callback, callback_group=group)

    async def _relocalize(
        self, request: Relocalize.Request, response: Relocalize.Response
    ) -> Relocalize.Response:
        timeout_s = nanoseconds_from(request.timeout) / NANOSECONDS
        answer = await self._desk.relocalize(timeout_s if timeout_s > 0.0 else DEFAULT_TIMEOUT_S)
        return self._filled(response, answer)

    async def _localize_image(
        self, request: LocalizeImage.Request, response: LocalizeImage.Response
    ) -> LocalizeImage.Response:
        answer = await self._desk.localize_image(request.image, request.camera_info)
        return self._filled(response, answer)

    async def _load_map(
        self, request: LoadMap.Request, response: LoadMap.Response
    ) -> LoadMap.Response:
        response.success, response.message = await self._desk.load_map(request.path)
        response.map_id = self._desk.map_id
        return response

    async def _set_enabled(
        self, request: SetBool.Request, response: SetBool.Response
    ) -> SetBool.Response:
        response.success, response.message = self._desk.set_enabled(enabled=request.data)
        return response

    def _filled(self, response: Any, answer: Answer) -> Any:  # noqa: ANN401 - of two services
        header = Header(stamp=stamp_from(answer.stamp_ns), frame_id=self._desk.map_frame)
        response.status = status_message(answer.result, header, answer.map_id)
        response.accepted = answer.pose is not None
        if answer.pose is None:
            response.pose.header = header
        else:
            response.pose = pose_with_covariance_message(answer.pose, header)
        return response
