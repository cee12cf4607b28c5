# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""BMNet: the probability of every candidate match, from geometry alone.

Section 'Network Architecture' of the paper.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from gam_relocalizer.cameras import undistort
from gam_relocalizer.matching.graph import MatchingNetwork

if TYPE_CHECKING:
    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.matching.graph import CandidateGraphs

NORM_EPSILON = 1e-3
FAR_DISTANCE = 10.0


@dataclass(frozen=True)
class BMNetConfig:
    """Size of the network; the default is the published one with two perceptrons per block.

    Attributes:
        point_blocks: Blocks of U-Net and of V-Net (L_p), 32, 64, `point_width`, ... wide.
        edge_blocks: Blocks of E-Net (L_e).
        point_width: Features per keypoint and per point; an edge has twice as many.
        perceptrons: Perceptrons in a block.
    """

    point_blocks: int = 5
    edge_blocks: int = 18
    point_width: int = 128
    perceptrons: int = 2


class ContextNorm(nn.Module):
    """Normalise every feature over the set, then scale and shift.

    Each graph by itself. Batch normalisation repeats this with one graph per batch: it is both.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.ones(width))
        self.shift = nn.Parameter(torch.zeros(width))

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """[S, B, width] -> the same, normalised over S; a set of one becomes the shift alone."""
        size, batch, width = features.shape
        if size < 2:
            return torch.zeros_like(features) * self.scale + self.shift
        # every graph of the batch gets features of its own, so one call serves all of them
        normal = functional.batch_norm(
            features.reshape(size, batch * width),
            None,
            None,
            self.scale.expand(batch, width).flatten(),
            self.shift.expand(batch, width).flatten(),
            training=True,
            eps=NORM_EPSILON,
        )
        return normal.view(size, batch, width)


class Block(nn.Module):
    """Perceptrons (norm, ReLU, linear without bias) with a shortcut around them."""

    def __init__(self, width_in: int, width_out: int, perceptrons: int) -> None:
        super().__init__()
        widths = [width_in] + [width_out] * perceptrons
        self.norms = nn.ModuleList(ContextNorm(width) for width in widths[:-1])
        self.linears = nn.ModuleList(
            nn.Linear(width, width_out, bias=False) for width in widths[:-1]
        )
        same = width_in == width_out
        self.shortcut = nn.Identity() if same else nn.Linear(width_in, width_out, bias=False)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """[S, B, width_in] -> [S, B, width_out]."""
        hidden = features
        for norm, linear in zip(self.norms, self.linears, strict=True):
            hidden = linear(functional.relu(norm(hidden), inplace=True))
        shortcut: torch.Tensor = self.shortcut(features)
        return shortcut + hidden


class BMNet(MatchingNetwork):
    """U-Net on keypoints, V-Net on points, E-Net on the edges between them."""

    def __init__(self, config: BMNetConfig | None = None) -> None:
        super().__init__()
        self.config = config or BMNetConfig()
        size = self.config.point_blocks, self.config.point_width, self.config.perceptrons
        self.keypoint_net = point_net(2, *size)
        self.point_net = point_net(3, *size)
        width = 2 * self.config.point_width
        self.edge_net = nn.Sequential(
            *(Block(width, width, self.config.perceptrons) for _ in range(self.config.edge_blocks)),
            ContextNorm(width),
            nn.ReLU(),
            nn.Linear(width, 1),
        )

    def forward(self, graphs: CandidateGraphs) -> torch.Tensor:
        """See `MatchingNetwork.forward`; geometry alone decides, distances do not."""
        graph = torch.arange(graphs.edges.shape[1])
        of_keypoints = embed(self.keypoint_net, graphs.keypoints)[graphs.edges[..., 0], graph]
        of_points = embed(self.point_net, graphs.points)[graphs.edges[..., 1], graph]
        logits: torch.Tensor = self.edge_net(torch.cat([of_keypoints, of_points], dim=2))
        return logits[..., 0].float()


def embed(net: nn.Sequential, coordinates: torch.Tensor) -> torch.Tensor:
    """Features of coordinates, whose first layer computes in full precision.

    bfloat16, where training uses it, is too coarse for coordinates.
    """
    with torch.autocast(coordinates.device.type, enabled=False):
        features = net[0](coordinates)
    embedded: torch.Tensor = net[1:](features)
    return embedded


def point_net(dimensions: int, blocks: int, width: int, perceptrons: int) -> nn.Sequential:
    """Blocks from coordinates to 32, 64, `width`, ... features."""
    widening = [32, 64][: blocks - 1]
    widths = [dimensions, *widening, *[width] * (blocks - len(widening))]
    return nn.Sequential(*(Block(a, b, perceptrons) for a, b in pairwise(widths)))


def normalise_keypoints(
    keypoints: NDArray[np.floating], camera: pycolmap.Camera
) -> NDArray[np.float32]:
    """Undistort keypoints and scale them to the size of the image.

    For a pinhole with a central principal point this is (x - size / 2) / (1.2 * longer side), as
    published; distortion and an offset principal point are taken out first.

    Args:
        keypoints: [M, 2] pixels, COLMAP convention.
        camera: Camera that took the image.

    Returns:
        [M, 2]; NaN where the camera model knows no ray, see `undistort`.
    """
    focal_length = np.float32(normalised_focal_length(camera))
    return undistort(keypoints, camera).astype(np.float32) * focal_length


def normalised_focal_length(camera: pycolmap.Camera) -> float:
    """The focal length in the unit of normalised keypoints."""
    return float(camera.mean_focal_length()) / (1.2 * max(camera.width, camera.height))


def normalise_points(points: NDArray[np.floating]) -> NDArray[np.float32]:
    """Scale the points of a scene, whatever its unit and however wild a few of them.

    The unit is the median distance from the origin: it does not move when a minority of the
    triangulated points lies far away, as range and mean do. Points more than 10 units out keep
    their direction only, so that no single one dominates the context norm. The origin stays, for
    it is where the reference camera stands.

    Args:
        points: [N, 3] finite points in the frame of a camera that looks at them, any unit.

    Returns:
        [N, 3] without unit.
    """
    if not len(points):
        return np.empty((0, 3), np.float32)
    distances = np.linalg.norm(np.asarray(points, np.float64), axis=1)
    unit = float(np.median(distances)) or float(distances.max()) or 1.0
    shrink = unit * np.maximum(1.0, distances / (FAR_DISTANCE * unit))
    return np.asarray(points / shrink[:, None], np.float32)
