# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from map_content import changed_map

from gam_relocalizer.errors import TrainingError
from gam_relocalizer.training.batches import STRIDE, GraphBatch
from gam_relocalizer.training.labelled import CandidateRule
from gam_relocalizer.training.sources import HELD_OUT_EVERY, MIN_TRUE_EDGES, GraphSource

if TYPE_CHECKING:
    from collections.abc import Sequence

    from gam_relocalizer.mapping.leave_one_out import ReferenceImages
    from gam_relocalizer.scene_map import MapContent
    from gam_relocalizer.training.labelled import LabelledGraph

SIZE = (64, 128), (200, 400)
RULE = CandidateRule()
# Tells the images of the map apart by the focal length that every graph carries.
FOCAL_LENGTHS = np.linspace(300, 700, 24)


def source(maps: Sequence[ReferenceImages] = (), share: float = 1.0) -> GraphSource:
    return GraphSource(RULE, *SIZE, maps, share)


def told_apart(references: ReferenceImages) -> ReferenceImages:
    """The map, each of its images taken with a focal length of its own."""
    changed = []
    for image, focal_length in zip(references.images, FOCAL_LENGTHS, strict=True):
        camera = type(image.camera)(image.camera.todict())
        camera.params = [focal_length, *camera.params[1:]]
        changed.append(replace(image, camera=camera))
    return replace(references, images=tuple(changed))


def images_of(focal_lengths: Sequence[float]) -> set[int]:
    pixels = np.array(focal_lengths) * 1.2 * 640
    return set(np.abs(pixels[:, None] - FOCAL_LENGTHS).argmin(axis=1).tolist())


def assert_same(first: LabelledGraph | GraphBatch, second: LabelledGraph | GraphBatch) -> None:
    for name in ('keypoints', 'points', 'edges', 'distances', 'labels'):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


@pytest.mark.parametrize('with_map', [False, True])
def test_same_generator_same_batch(references: ReferenceImages, with_map: bool) -> None:  # noqa: FBT001
    maps = [references] if with_map else []
    first, same, other = (source(maps).batch(np.random.default_rng(s), 3) for s in (1, 1, 2))

    assert first.labels.shape[1] == 3
    assert_same(first, same)
    assert not np.array_equal(first.labels, other.labels)


def test_every_second_graph_mirrors_the_one_before(references: ReferenceImages) -> None:
    batch = source([references]).batch(np.random.default_rng(0), 4)

    for one, mirror in ((0, 1), (2, 3)):
        seen, mirrored = (
            {
                (sign * x, y, label)
                for (x, y), label in zip(
                    batch.keypoints[batch.edges[:, i, 0], i].tolist(),
                    batch.labels[:, i].tolist(),
                    strict=True,
                )
            }
            for i, sign in ((one, 1), (mirror, -1))
        )
        # stacking leaves out a few edges of each
        assert len(seen & mirrored) > 0.8 * len(seen)
    assert len(set(batch.focal_lengths.tolist())) == 1


def test_sizes_of_batches_are_within_their_limits() -> None:
    for seed in range(5):
        batch = source().batch(np.random.default_rng(seed), 2)

        assert len(batch.keypoints) % STRIDE == len(batch.edges) % STRIDE == 0
        assert len(batch.keypoints) <= 128
        assert (batch.labels.sum(axis=0) > 0).all()


def test_a_share_of_the_batches_is_of_maps(references: ReferenceImages) -> None:
    own = source([told_apart(references)]).validation(1)[0].focal_length
    focal_lengths = {round(f / (1.2 * 640), 6) for f in FOCAL_LENGTHS}
    assert round(own, 6) in focal_lengths

    shares = {}
    for share in (0.0, 0.5, 1.0):
        mixed = source([told_apart(references)], share)
        batches = [mixed.batch(np.random.default_rng(i), 2) for i in range(16)]
        of_map = [round(float(b.focal_lengths[0]), 6) in focal_lengths for b in batches]
        shares[share] = np.mean(of_map)

    assert shares[0.0] == 0
    assert 0.2 < shares[0.5] < 0.8
    assert shares[1.0] == 1


def test_without_maps_all_is_synthetic_whatever_the_share(references: ReferenceImages) -> None:
    batch = source([], 1.0).batch(np.random.default_rng(0), 2)

    assert_same(batch, source([], 0.0).batch(np.random.default_rng(0), 2))
    assert_same(batch, source([references], 0.0).batch(np.random.default_rng(0), 2))


def test_held_out_images_validate_and_are_never_queries(references: ReferenceImages) -> None:
    of_map = source([told_apart(references)])

    trained = [of_map.batch(np.random.default_rng(i), 2).focal_lengths[0] for i in range(150)]
    validated = [graph.focal_length for graph in of_map.validation(20)]

    usable = range(23)  # the last image sees nothing
    assert images_of(validated) == set(usable[::HELD_OUT_EVERY])
    assert images_of(trained) == set(usable) - images_of(validated)


def test_validation_is_the_same_for_every_run(references: ReferenceImages) -> None:
    for maps in ([], [references]):
        first = source(maps).validation(3)
        drawing = source(maps)
        drawing.batch(np.random.default_rng(0), 2)

        for graph, again in zip(first, drawing.validation(3), strict=True):
            assert_same(graph, again)
            assert graph.labels.sum() >= MIN_TRUE_EDGES


def test_says_what_becomes_of_the_images(
    references: ReferenceImages, other_references: ReferenceImages
) -> None:
    first, second = source([references, other_references]).map_uses

    assert (first.name, first.queries, first.held_out, first.left_out) == ('cloud', 20, 3, 1)
    # the tenth images are counted over all maps
    assert (second.name, second.queries, second.held_out, second.left_out) == ('other', 3, 0, 1)
    assert source().map_uses == ()


def test_images_that_share_nothing_are_no_queries(references: ReferenceImages) -> None:
    def without_first(content: MapContent) -> MapContent:
        offsets = content.observation_offsets
        return replace(
            content,
            observation_offsets=np.maximum(offsets - offsets[1], 0),
            observation_points=content.observation_points[offsets[1] :],
        )

    alone = changed_map(references.scene_map, without_first)

    (use,) = source([replace(references, scene_map=alone)]).map_uses

    assert use.left_out == 2
    assert use.queries + use.held_out == 22


def test_all_maps_are_drawn_from(
    references: ReferenceImages, other_references: ReferenceImages
) -> None:
    both = source([told_apart(references), other_references])
    other = 500 / (1.2 * 640)

    drawn = [both.batch(np.random.default_rng(i), 2).focal_lengths[0] for i in range(60)]

    # three of 23 queries
    assert 0 < np.isclose(drawn, other, atol=1e-4).sum() < 25


def test_maps_that_hold_nothing_are_refused(lonely_references: ReferenceImages) -> None:
    with pytest.raises(TrainingError):
        source([lonely_references])


def test_maps_whose_views_have_no_true_edges_are_refused(
    other_references: ReferenceImages,
) -> None:
    images = other_references.images
    blank = [replace(image, descriptors=np.zeros_like(image.descriptors)) for image in images]
    nothing = replace(other_references, images=tuple(blank))

    with pytest.raises(TrainingError):
        source([nothing]).batch(np.random.default_rng(0), 2)


def test_extractors_are_those_of_the_maps(
    references: ReferenceImages, other_references: ReferenceImages
) -> None:
    scene_map = other_references.scene_map
    identity = replace(scene_map.manifest.extractor, name='another')
    manifest = replace(scene_map.manifest, extractor=identity)
    other = replace(other_references, scene_map=replace(scene_map, manifest=manifest))

    assert source().extractors == ()
    assert source([references, references]).extractors == ('synthetic',)
    assert source([references, other]).extractors == ('another', 'synthetic')
