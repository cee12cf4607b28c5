# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Fits `BELIEF` of localization/confidence.py: which poses are right, by what speaks for them.

Renders rooms that are neither those of the demo nor of any benchmark, maps them, and localizes
views from anywhere, in scene after scene: those that fit give right poses, the others wrong ones.
Then holds the covariance of the poses that are believed against their errors.

    python scripts/fit_belief.py [FOLDER]
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from rich.progress import track
from scipy.optimize import minimize

from gam_relocalizer.cameras import parse_camera
from gam_relocalizer.demo.adversarial_worlds import random_views
from gam_relocalizer.demo.recording import drive_appearance, record_mapping_pass, robot_camera
from gam_relocalizer.demo.renderer import Renderer
from gam_relocalizer.demo.world import demo_world
from gam_relocalizer.evaluation.calibration import normalised_error_squared, summarise_nees
from gam_relocalizer.evaluation.metrics import Threshold
from gam_relocalizer.features.registry import create_extractor, global_descriptor_of
from gam_relocalizer.geometry import pose_error, read_poses, write_poses
from gam_relocalizer.image_set import ImageSet
from gam_relocalizer.images import read_image
from gam_relocalizer.localization.confidence import Evidence, scaled_residual
from gam_relocalizer.localization.localizer import Localizer, LocalizerOptions
from gam_relocalizer.localization.result import Status
from gam_relocalizer.localization.verdict import VerdictOptions
from gam_relocalizer.mapping.build import MapBuildOptions, build_map

SEEDS = (1, 2)
VIEWS = 300
MAX_KEYPOINTS = 1536
# Far wider than a right pose's noise, far narrower than a wrong one's error.
RIGHT = Threshold(0.3, 5.0)
# Pulls the weights of terms that tell little to zero.
SHRINKAGE = 2e-3
# Every scene is tried, and nothing but the belief rejects.
OPTIONS = LocalizerOptions(enough_inliers=10**9, verdict=VerdictOptions(min_belief=0.0))


@dataclass(frozen=True)
class Found:
    """A pose that passes all checks but the belief."""

    terms: np.ndarray
    belief: float
    is_right: bool
    nees: float


def main() -> None:
    """Renders and maps what is missing in the folder, then fits."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path('build/belief')
    torch.set_num_threads(1)
    found: list[Found] = []
    for seed in SEEDS:
        _prepare(folder / str(seed), seed)
        found += _poses_in(folder / str(seed))
    right = np.array([one.is_right for one in found])
    belief = _fitted(np.array([one.terms for one in found]), right)
    print(f'{np.count_nonzero(right)} right and {np.count_nonzero(~right)} wrong poses')
    print(f'BELIEF = np.array([{", ".join(f"{weight:.3g}" for weight in belief)}])')
    believed = [one for one in found if one.is_right and one.belief >= VerdictOptions().min_belief]
    nees = summarise_nees([one.nees for one in believed])
    print(
        f'{nees.trials} believed and right: NEES {nees.mean:.2f}, 95 % band {nees.band[0]:.2f} to '
        f'{nees.band[1]:.2f}, within 95 %: {nees.within:.1%}, worst {nees.worst_sigma:.1f} sigma'
    )


def _prepare(folder: Path, seed: int) -> None:
    """A map, and views of the same rooms on another evening with the chairs elsewhere."""
    if not (folder / 'walk').is_dir():
        folder.mkdir(parents=True, exist_ok=True)
        record_mapping_pass(demo_world(seed), folder / 'walk')
    if not (folder / 'map').is_dir():
        walk = folder / 'walk'
        images = ImageSet.of_folder(
            walk / 'images',
            parse_camera(walk / 'camera.txt'),
            read_poses(walk / 'poses.txt'),
        )
        options = MapBuildOptions(max_keypoints=MAX_KEYPOINTS)
        build_map(images, folder / 'map', options)
    if (folder / 'poses_query.txt').is_file():
        return
    world = demo_world(seed, rearranged=True)
    renderer = Renderer(world, drive_appearance(world))
    views = random_views(world, VIEWS, np.random.default_rng(seed))
    (folder / 'query').mkdir(exist_ok=True)
    for index, view in enumerate(track(views, f'render {seed}')):
        image = renderer.render(robot_camera(), [view], index)
        cv2.imwrite(
            str(folder / 'query' / f'{index:04d}.png'), cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
        )
    write_poses(
        folder / 'poses_query.txt', {f'{index:04d}.png': view for index, view in enumerate(views)}
    )


def _poses_in(folder: Path) -> list[Found]:
    """All poses that pass the other checks."""
    localizer = Localizer.load(folder / 'map', OPTIONS)
    extractor = create_extractor('xfeat')
    describer = global_descriptor_of(localizer.scene_map, None)
    camera, found = robot_camera(), []
    for name, truth in track(read_poses(folder / 'poses_query.txt').items(), f'{folder.name}'):
        image = read_image(folder / 'query' / name)
        features = extractor.extract(image)
        described = describer.describe(image, features)
        for attempt in localizer.attempts(features, described, camera):
            estimate = attempt.estimate
            if estimate is None or attempt.status is not Status.ACCEPTED:
                continue
            residual = scaled_residual(estimate.reprojection_error, camera.width)
            evidence = Evidence(estimate.coverage, residual, estimate.support.unmatched)
            error = pose_error(estimate.camera_from_map, truth)
            found.append(
                Found(
                    terms=evidence.terms,
                    belief=estimate.belief,
                    is_right=RIGHT.admits(error),
                    nees=normalised_error_squared(
                        estimate.camera_from_map, truth, estimate.covariance
                    ),
                )
            )
    return found


def _fitted(terms: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Weights of a logistic regression; the last term is the constant and not shrunk."""
    scale = np.append(terms[:, :-1].std(axis=0), 1.0)
    sign = np.where(right, 1.0, -1.0)

    def loss(weights: np.ndarray) -> float:
        misfit = np.logaddexp(0.0, -sign * (terms / scale @ weights))
        return float(np.mean(misfit) + SHRINKAGE * np.sum(np.square(weights[:-1])))

    return minimize(loss, np.zeros(terms.shape[1])).x / scale


if __name__ == '__main__':
    main()
