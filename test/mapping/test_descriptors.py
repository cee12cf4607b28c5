# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from gam_relocalizer.features.local import LocalFeatures
from gam_relocalizer.mapping.descriptors import describe_points
from gam_relocalizer.mapping.extraction import MappingImage


@pytest.fixture
def model() -> pycolmap.Reconstruction:
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs = 1
    options.num_frames_per_rig = 4
    options.num_points3D = 30
    pycolmap.set_random_seed(0)
    return pycolmap.synthesize_dataset(options)


def described_images(model: pycolmap.Reconstruction) -> list[MappingImage]:
    """Images whose keypoints carry random descriptors."""
    images = []
    for image_id in sorted(model.images):
        image = model.image(image_id)
        count = image.num_points2D()
        descriptors = np.random.default_rng(image_id).normal(size=(count, 8)).astype(np.float32)
        descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
        keypoints = np.array([point.xy for point in image.points2D], dtype=np.float32)
        features = LocalFeatures(keypoints, descriptors, np.ones(count, np.float32))
        images.append(MappingImage(image.name, 1024, 768, features))
    return images


def test_descriptor_is_the_normalised_mean_over_the_track(model: pycolmap.Reconstruction) -> None:
    images = described_images(model)

    described = describe_points(model, images)

    for row, point_id in enumerate(sorted(model.point3D_ids())):
        point = model.point3D(point_id)
        mean = np.mean(
            [
                images[element.image_id - 1].features.descriptors[element.point2D_idx]
                for element in point.track.elements
            ],
            axis=0,
        )
        np.testing.assert_allclose(
            described.descriptors[row], mean / np.linalg.norm(mean), atol=1e-5
        )
        np.testing.assert_array_equal(described.points[row], point.xyz)


def test_observations_follow_the_tracks(model: pycolmap.Reconstruction) -> None:
    described = describe_points(model, described_images(model))

    point_ids = np.array(sorted(model.point3D_ids()))
    for row, image in enumerate(described.images):
        begin, end = described.observation_offsets[row : row + 2]
        seen = point_ids[described.observation_points[begin:end]]
        expected = {point.point3D_id for point in model.image(image + 1).get_observation_points2D()}
        assert set(seen.tolist()) == expected


def test_images_that_see_nothing_are_left_out(model: pycolmap.Reconstruction) -> None:
    images = described_images(model)
    for keypoint in model.image(2).get_observation_point2D_idxs():
        model.delete_observation(2, keypoint)

    described = describe_points(model, images)

    assert described.images == (0, 2, 3)
    assert len(described.observation_offsets) == 4
