# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Every error raised on purpose; each message is written for the person who can act on it."""

from __future__ import annotations


class RelocalizerError(Exception):
    """Base of all errors of this project; the command line prints it and exits with 1."""


class UsageError(RelocalizerError):
    """The arguments themselves cannot be used; the command line exits with 2."""


class CameraError(UsageError):
    """A camera description or a CameraInfo cannot be understood."""


class PosesFileError(UsageError):
    """A poses file is missing or malformed."""


class ImageError(RelocalizerError):
    """An image cannot be read or decoded."""


class MapError(RelocalizerError):
    """A map bundle is missing, damaged, of another version or of another extractor."""


class MapBuildError(RelocalizerError):
    """A map cannot be built from the given images."""


class AlignmentError(RelocalizerError):
    """A map cannot be laid into the wanted frame by what is given."""


class VideoError(RelocalizerError):
    """A video cannot be read."""


class BagError(RelocalizerError):
    """A bag cannot be read, or lacks what a replay needs."""


class MatchingError(RelocalizerError):
    """The features of an image and the points of a map do not fit together."""


class TransformError(RelocalizerError):
    """A transform between two frames is not known at the requested time."""


class WeightsError(RelocalizerError):
    """Network weights are missing, damaged or do not fit the network."""


class TrainingError(RelocalizerError):
    """A training run cannot start or continue."""


class DatasetError(RelocalizerError):
    """A dataset's folder lacks files, or they are malformed."""


class ModelError(RelocalizerError):
    """A COLMAP model, or the features that go with it, are missing, damaged or do not fit."""


class ViewerError(RelocalizerError):
    """The 3D viewer did not start, or failed."""
