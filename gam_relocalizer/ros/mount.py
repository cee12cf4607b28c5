# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Where the camera sits on the robot: from a parameter, or from /tf and /tf_static."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pycolmap

from gam_relocalizer.errors import TransformError

if TYPE_CHECKING:
    from rclpy.node import Node

    from gam_relocalizer.ros.parameters import NodeParameters
    from gam_relocalizer.ros.schedule import StampedImage
    from gam_relocalizer.ros.transform_listener import TransformListener


class Mount:
    """Tells `base_from_camera`; has the transforms listened to if they are what tells it."""

    def __init__(
        self, node: Node, parameters: NodeParameters, transforms: TransformListener
    ) -> None:
        self._log = node.get_logger()
        self._transforms = transforms
        self.use(parameters)

    def use(self, parameters: NodeParameters) -> None:
        """Takes other parameters from now on."""
        self._parameters = parameters
        if parameters.mount() is not None:
            return
        if parameters.base_frame:
            self._transforms.listen()
        else:
            self._log.info(
                'the parameter `base_frame` is empty: the published pose is that of the camera '
                '(its optical frame), not of the robot',
                once=True,
            )

    def is_known(self, image: StampedImage) -> bool:
        """Whether `base_from_camera` can tell."""
        try:
            self.base_from_camera(image)
        except TransformError:
            return False
        return True

    def base_from_camera(self, image: StampedImage) -> pycolmap.Rigid3d:
        """The mount of the camera that took an image, when it did.

        Raises:
            TransformError: The transforms do not tell (yet).
        """
        mount = self._parameters.mount()
        if mount is not None:
            return mount
        if not self._parameters.base_frame:
            return pycolmap.Rigid3d()
        camera_frame = image.message.header.frame_id
        if not camera_frame:
            msg = 'the images have no frame_id'
            raise TransformError(msg)
        return self._transforms.tree.lookup(
            self._parameters.base_frame, camera_frame, image.stamp_ns
        )
