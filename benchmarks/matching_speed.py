# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""How long matching takes: kNN ratio candidates, network, pooling; prints a Markdown table.

The view is synthetic, with the wanted numbers of keypoints and points and 64-dimensional
descriptors in half precision as a map has them. Every stage is repeated; the median counts.

    python benchmarks/matching_speed.py --threads 2
"""

from __future__ import annotations

import argparse
import statistics
import time
from typing import TYPE_CHECKING

import numpy as np
import torch

from gam_relocalizer.matching.candidates import knn_ratio
from gam_relocalizer.matching.matcher import MatchInput
from gam_relocalizer.matching.pooling import hungarian_pooling
from gam_relocalizer.matching.registry import create_matcher
from gam_relocalizer.training.synthetic import synthetic_view

if TYPE_CHECKING:
    from collections.abc import Callable


SEED = 0
SIZES = ((512, 5_000), (1024, 10_000), (2048, 20_000))


def main() -> None:
    """Times every matcher at every size."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--threads', type=int, default=2)
    parser.add_argument('--repeats', type=int, default=20)
    parser.add_argument('--matchers', nargs='+', default=['gam', 'bmnet', 'nn-cross'])
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    print('| matcher | keypoints | points | edges | kNN ratio | pooling | whole matching |')
    print('|---' * 7 + '|')
    for name in arguments.matchers:
        for keypoints, points in SIZES:
            print(_row(name, keypoints, points, arguments.repeats), flush=True)


def _row(name: str, keypoints: int, points: int, repeats: int) -> str:
    view = synthetic_view(np.random.default_rng(SEED), (keypoints,) * 2, (points,) * 2)
    matcher = create_matcher(name)
    stored = view.point_descriptors.astype(np.float16)
    given = MatchInput(view.keypoints, view.focal_length, view.descriptors, view.points, stored)
    candidates = knn_ratio(view.descriptors, stored)
    weights = np.random.default_rng(SEED).random(len(candidates.edges))
    milliseconds = [
        _median_ms(lambda: knn_ratio(view.descriptors, stored), repeats),
        _median_ms(lambda: hungarian_pooling(candidates.edges, weights), repeats),
        _median_ms(lambda: matcher.match(given), repeats),
    ]
    sizes = [len(view.keypoints), len(view.points), len(candidates.edges)]
    cells = [name, *map(str, sizes), *(f'{one:.0f} ms' for one in milliseconds)]
    return f'| {" | ".join(cells)} |'


def _median_ms(work: Callable[[], object], repeats: int) -> float:
    work()
    seconds = []
    for _ in range(repeats):
        begin = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - begin)
    return 1e3 * statistics.median(seconds)


if __name__ == '__main__':
    main()
