# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Where the graphs of a run come from: synthetic scenes and, where there are any, maps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gam_relocalizer.errors import TrainingError
from gam_relocalizer.training.batches import STRIDE, GraphBatch, stacked
from gam_relocalizer.training.labelled import LabelledGraph, labelled_graph, mirrored
from gam_relocalizer.training.map_views import FEWEST_KEYPOINTS, FEWEST_POINTS, map_view
from gam_relocalizer.training.synthetic import synthetic_view

if TYPE_CHECKING:
    from collections.abc import Sequence

    from gam_relocalizer.mapping.leave_one_out import ReferenceImages
    from gam_relocalizer.training.labelled import CandidateRule, View

MIN_TRUE_EDGES = 12
VALIDATION_SEED = 20_000_003
HELD_OUT_EVERY = 10
"""Every so manieth reference image of a map validates, and is never a query in training."""
MAX_DRAWS = 1_000


@dataclass(frozen=True)
class MapUse:
    """What a run makes of a map.

    Attributes:
        name: Of the map's directory.
        queries: Images that are queries in training.
        held_out: Images that are queries in validation only.
        left_out: Images that share too little with the others to be queries.
    """

    name: str
    queries: int
    held_out: int
    left_out: int


class GraphSource:
    """Draws graphs; what it draws is a function of the generator that is handed in."""

    def __init__(
        self,
        rule: CandidateRule,
        keypoints: tuple[int, int],
        points: tuple[int, int],
        maps: Sequence[ReferenceImages] = (),
        map_share: float = 0.0,
    ) -> None:
        """Draw synthetic graphs and, in their share of the batches, graphs of maps.

        Args:
            rule: How edges are found.
            keypoints: Least and greatest number of keypoints of a graph.
            points: Least and greatest number of points of a graph.
            maps: The maps; each is drawn from as often as it has images.
            map_share: Share of the batches that come from maps.

        Raises:
            TrainingError: The maps hold no image that shares enough with the others.
        """
        self._rule = rule
        self._keypoints = keypoints
        self._points = points
        self._map_share = map_share if maps else 0.0
        self._maps = tuple(maps)
        usable = [(m, i) for m, references in enumerate(maps) for i in _usable_images(references)]
        self._held_out = usable[::HELD_OUT_EVERY]
        self._queries = [one for i, one in enumerate(usable) if i % HELD_OUT_EVERY]
        if maps and not self._queries:
            msg = (
                f'the maps have {len(usable)} images with at least {FEWEST_KEYPOINTS} keypoints in '
                f'tracks and {FEWEST_POINTS} points in common with others, expected 2 or more: '
                'give larger maps, or none'
            )
            raise TrainingError(msg)

    @property
    def extractors(self) -> tuple[str, ...]:
        """Whose descriptors the graphs of maps were made with."""
        names = {references.scene_map.manifest.extractor.name for references in self._maps}
        return tuple(sorted(names))

    @property
    def map_uses(self) -> tuple[MapUse, ...]:
        """What becomes of the images of each map, in the order of the maps."""
        uses = []
        for number, references in enumerate(self._maps):
            queries = sum(m == number for m, _ in self._queries)
            held_out = sum(m == number for m, _ in self._held_out)
            left_out = len(references.images) - queries - held_out
            uses.append(MapUse(references.scene_map.path.name, queries, held_out, left_out))
        return tuple(uses)

    def batch(self, rng: np.random.Generator, graphs: int) -> GraphBatch:
        """`graphs` graphs of one size; every second one mirrors the one before."""
        count = _round_to_stride(float(np.exp(rng.uniform(*np.log(self._keypoints)))))
        from_map = rng.random() < self._map_share
        drawn: list[LabelledGraph] = []
        while len(drawn) < graphs:
            queries = self._queries if from_map else []
            graph = self._draw(rng, (count, count), queries)
            drawn += [graph, mirrored(graph)]
        return stacked(drawn[:graphs], rng)

    def validation(self, graphs: int) -> list[LabelledGraph]:
        """Graphs that no run trains on: of held-out images if there are maps, else synthetic."""
        return [
            self._draw(np.random.default_rng([VALIDATION_SEED, i]), self._keypoints, self._held_out)
            for i in range(graphs)
        ]

    def _draw(
        self,
        rng: np.random.Generator,
        keypoints: tuple[int, int],
        queries: Sequence[tuple[int, int]],
    ) -> LabelledGraph:
        """A graph with enough true edges to learn a pose from; synthetic without queries."""
        view: View | None
        for _ in range(MAX_DRAWS):
            if queries:
                index, image = queries[int(rng.integers(len(queries)))]
                view = map_view(self._maps[index], image, rng, keypoints, self._points)
            else:
                view = synthetic_view(rng, keypoints, self._points)
            graph = None if view is None else labelled_graph(view, self._rule, rng)
            if graph is not None and graph.labels.sum() >= MIN_TRUE_EDGES:
                return graph
        msg = f'of {MAX_DRAWS} views of the maps none has {MIN_TRUE_EDGES} true edges'
        raise TrainingError(msg)


def _usable_images(references: ReferenceImages) -> list[int]:
    """Images that share points with others and have keypoints to find them by."""
    covisibility = references.scene_map.covisibility
    shared = np.asarray(covisibility.sum(axis=1)).ravel() - covisibility.diagonal()
    return [
        i
        for i, image in enumerate(references.images)
        if shared[i] >= FEWEST_POINTS
        and int((image.point_of_keypoint >= 0).sum()) >= FEWEST_KEYPOINTS
    ]


def _round_to_stride(number: float) -> int:
    return STRIDE * max(1, round(number / STRIDE))
