# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Poses files of the long-term visual localization benchmark, to hand in and from others.

Lines `name qw qx qy qz tx ty tz`, camera_from_world. The benchmark (Sattler et al., CVPR 2018)
wants the base name of an image; for RobotCar Seasons, whose three cameras may have images of one
name, the folder of the camera before it. hloc writes its results in the same form.
"""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import TYPE_CHECKING

from gam_relocalizer.errors import UsageError
from gam_relocalizer.geometry import read_poses, write_poses

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    import pycolmap

    from gam_relocalizer.evaluation.localization import SetEvaluation

SUBMISSION = 'submission.txt'

_ROBOTCAR_CAMERAS = frozenset({'left', 'right', 'rear'})


def submission_names(names: Iterable[str]) -> dict[str, str]:
    """What the benchmark calls images, by their names in the lists of queries.

    Raises:
        UsageError: Two of them would have the same name.
    """
    by_submitted: dict[str, str] = {}
    for name in names:
        submitted = _submission_name(PurePosixPath(name))
        if submitted in by_submitted:
            msg = (
                f'images `{by_submitted[submitted]}` and `{name}` would both be called '
                f'`{submitted}` in the submission; evaluate them in separate runs'
            )
            raise UsageError(msg)
        by_submitted[submitted] = name
    return {name: submitted for submitted, name in by_submitted.items()}


def write_submission(
    file: Path, evaluations: Iterable[SetEvaluation], names: Mapping[str, str]
) -> None:
    """Writes the poses that the last method found in the sets without truth.

    Those that the verdict rejects are among them: a benchmark counts a missing pose as a wrong one,
    so an answer can only help. An image without any pose has no line.

    Args:
        file: To write.
        evaluations: Of all sets.
        names: See `submission_names`.
    """
    poses: dict[str, pycolmap.Rigid3d] = {}
    for evaluation in evaluations:
        *_, outcomes = evaluation.outcomes.values()
        for name, outcome in outcomes.items():
            if not evaluation.has_truth and outcome.camera_from_world is not None:
                poses[names[name]] = outcome.camera_from_world
    write_poses(file, poses)


def read_results(file: Path, names: Iterable[str]) -> dict[str, pycolmap.Rigid3d]:
    """Poses that some localizer found, by the names of the queries.

    A name in the file is that of a query, or its end: `rear/1.jpg` or `1.jpg` for
    `night/rear/1.jpg`. Poses of other images are left out.

    Args:
        file: The poses, camera_from_world.
        names: Of the queries.

    Raises:
        PosesFileError: See `read_poses`.
        UsageError: A name that fits several queries, two that fit the same one, or none that fits.
    """
    queries = frozenset(names)
    by_end = _by_end(queries)
    found: dict[str, pycolmap.Rigid3d] = {}
    for written, pose in read_poses(file).items():
        fitting = [written] if written in queries else by_end.get(written, [])
        if len(fitting) > 1:
            msg = (
                f'{file}: `{written}` could be `{fitting[0]}` or `{fitting[1]}`; name the images '
                f'as the queries are'
            )
            raise UsageError(msg)
        for name in fitting:
            if name in found:
                msg = f'{file}: query `{name}` has a second pose, under the name `{written}`'
                raise UsageError(msg)
            found[name] = pose
    if not found:
        msg = f'{file}: names none of the {len(queries)} queries, for example `{min(queries)}`'
        raise UsageError(msg)
    return found


def _submission_name(name: PurePosixPath) -> str:
    if name.parent.name in _ROBOTCAR_CAMERAS:
        return f'{name.parent.name}/{name.name}'
    return name.name


def _by_end(names: Iterable[str]) -> dict[str, list[str]]:
    """Names by all their ends but the whole."""
    by_end: dict[str, list[str]] = {}
    for name in sorted(names):
        parts = PurePosixPath(name).parts
        for begin in range(1, len(parts)):
            by_end.setdefault('/'.join(parts[begin:]), []).append(name)
    return by_end
