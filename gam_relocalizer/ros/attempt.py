# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""One attempt, from the message to the result: what the node's worker thread does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from gam_relocalizer.cameras import camera_from_calibration
from gam_relocalizer.errors import CameraError, ImageError
from gam_relocalizer.localization.result import LocalizationResult, Status
from gam_relocalizer.ros.conversions import pixels_from

if TYPE_CHECKING:
    from gam_relocalizer.cameras import CameraCalibration
    from gam_relocalizer.localization.localizer import Localizer
    from gam_relocalizer.localization.prior import Prior
    from gam_relocalizer.ros.schedule import StampedImage


@dataclass(frozen=True)
class Attempt:
    """All that one attempt needs; nothing of it changes while the worker is at it.

    Attributes:
        image: The image.
        image_topic: Resolved name of its topic.
        calibration: The newest calibration of its camera.
        image_is_rectified: Whether P holds for it, without distortion.
        prior: What is known beforehand about where it was taken.
    """

    image: StampedImage
    image_topic: str
    calibration: CameraCalibration
    image_is_rectified: bool
    prior: Prior


def carry_out(attempt: Attempt, localizer: Localizer) -> LocalizationResult:
    """Decodes the image, makes a camera of the calibration, and localizes."""
    try:
        pixels = pixels_from(attempt.image.message, attempt.image_topic)
    except ImageError as err:
        return LocalizationResult(Status.UNDECODABLE_IMAGE, str(err))
    try:
        camera = camera_from_calibration(
            attempt.calibration, image_is_rectified=attempt.image_is_rectified
        )
    except CameraError as err:
        return LocalizationResult(Status.NO_CALIBRATION, str(err))
    return localizer.localize(pixels, camera, attempt.prior)
