# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""What fixes every N seconds make of odometry that drifts, and whether a wrong one makes it jump.

Replays the demo's drive (rendered first, if there is no bag of it) for N = 1, 2, 5, 10 and 30 s,
with its own odometry and with one whose heading drifts on as well, as that of visual-inertial
odometry does. Prints Markdown tables of the absolute trajectory errors of odometry, fixes and
corrected odometry; writes `drift_correction.json`, `.md` and `.png`. The corrected odometry has to
stay below the fixes' own median error plus the drift that the odometry gains in one period.

Then one in ten of the fixes is made wrong: a pose of another time of the drive, as precise by its
own account as good fixes are. None of them may ever become the correction, and the errors may not
exceed those of fixes that come half as often.

    OMP_NUM_THREADS=1 python benchmarks/drift_correction.py
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from gam_relocalizer.cli.demo import DURATION_S
from gam_relocalizer.demo.recording import GROUND_TRUTH_TOPIC, ODOMETRY_TOPIC, record_query_bag
from gam_relocalizer.demo.shipped import demo_map_path
from gam_relocalizer.demo.trajectories import BASE_FROM_CAMERA
from gam_relocalizer.demo.world import demo_world
from gam_relocalizer.geometry import pose_error, rigid3d_from_rotation, write_text
from gam_relocalizer.localization.continuity import Continuity
from gam_relocalizer.localization.localizer import Localizer
from gam_relocalizer.localization.result import LocalizationResult, Status
from gam_relocalizer.localization.robot_pose import RobotPose, robot_pose
from gam_relocalizer.plots import write_picture
from gam_relocalizer.replay.drift import TimedPose, TrajectoryError, trajectories_of
from gam_relocalizer.replay.figures import REFUSED, draw_drift
from gam_relocalizer.replay.replay import DELAY_NS, ReplayOptions, replay_bag
from gam_relocalizer.replay.result import Attempt

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import pycolmap
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from gam_relocalizer.localization.prior import Prior
    from gam_relocalizer.replay.drift import Trajectories
    from gam_relocalizer.replay.result import OdometrySample

PERIODS = (1.0, 2.0, 5.0, 10.0, 30.0)
DRAWN_PERIODS = (2.0, 10.0, 30.0)
DRAWN_SEED = 1
# Of the second odometry, on top of the first [deg/s]: a gyroscope's bias that nobody estimates.
HEADING_DRIFT = 0.25
OF_THE_BAG, DRIFTING = 'of the bag', f'heading drifts {HEADING_DRIFT:g} deg/s'

WRONG_SHARE = 0.1
# What a wrong fix says of itself [m, rad].
WRONG_STD = (0.02, 0.005)
# In each so many-th seed the first fix is a wrong one.
FIRST_WRONG_EACH = 4
ACCEPTED = LocalizationResult(Status.ACCEPTED, 'a pose was found')


@dataclass(frozen=True)
class Found:
    """What the localizer found in an image, before odometry had its say.

    Attributes:
        stamp_ns: Of the image [ns].
        pose: None when nothing was accepted.
        truth: map_from_base.
        is_wrong: Whether it was made wrong.
    """

    stamp_ns: int
    pose: RobotPose | None
    truth: pycolmap.Rigid3d
    is_wrong: bool = False


@dataclass(frozen=True)
class Run:
    """Trajectories by one odometry and one list of fixes.

    Attributes:
        trajectories: Of it.
        largest_step: By how far a new correction moved the robot at most [m].
        misled: Whether a wrong fix became the correction.
    """

    trajectories: Trajectories
    largest_step: float
    misled: bool


@dataclass(frozen=True)
class Row:
    """What came out for one odometry and one period; lengths in metres.

    Attributes:
        odometry: Which one.
        period: Seconds between two attempts.
        errors: Of odometry, fixes and corrected odometry.
        drift: That the odometry gains in one period, mean over the drive.
        bound: Median error of the fixes plus this drift.
        largest_step: By how far a new correction moved the robot at most.
        wrong: Number of wrong fixes among how many, with wrong ones.
        injected_rmse: Of the corrected odometry with wrong fixes, largest over the seeds.
        injected_bound: Median error of the fixes plus the drift of two periods.
        injected_step: As `largest_step`, over all seeds.
        misled: Seeds in which a wrong fix became the correction.
        unguarded_step: The same if every fix counted by itself.
    """

    odometry: str
    period: float
    errors: Mapping[str, TrajectoryError]
    drift: float
    bound: float
    largest_step: float
    wrong: tuple[int, int]
    injected_rmse: float
    injected_bound: float
    injected_step: float
    misled: int
    unguarded_step: float

    @property
    def keeps_bound(self) -> bool:
        """Whether the corrected odometry is as good as it has to be."""
        return self.errors['corrected'].position_rmse <= self.bound

    @property
    def withstands(self) -> bool:
        """Whether wrong fixes do no harm."""
        return self.misled == 0 and self.injected_rmse <= self.injected_bound


def main() -> None:
    """Replays, injects, reports."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--bag', type=Path, default=Path('build/demo/query_bag'))
    parser.add_argument('--out', type=Path, default=Path('build/drift_correction'))
    parser.add_argument('--seeds', type=int, default=20)
    # after the longest period, of 16 m, odometry may be off by a metre: it cannot tell nearer ones
    parser.add_argument('--wrong-by', type=float, default=2.0, help='wrong fixes: at least [m]')
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    arguments.out.mkdir(parents=True, exist_ok=True)
    if not arguments.bag.exists():
        print(f'rendering {arguments.bag}', file=sys.stderr)
        record_query_bag(demo_world(rearranged=True), arguments.bag, duration_s=DURATION_S)
    found, odometry = _record(arguments.bag)
    odometries = {OF_THE_BAG: odometry, DRIFTING: _with_heading_drift(odometry)}
    rows = [
        _row(name, period, found[period], samples, arguments)
        for name, samples in odometries.items()
        for period in PERIODS
    ]
    report = _report(rows, arguments)
    write_text(arguments.out / 'drift_correction.md', f'{report}\n')
    content = {
        'seeds': arguments.seeds,
        'wrong_by': arguments.wrong_by,
        'rows': [asdict(row) for row in rows],
    }
    write_text(arguments.out / 'drift_correction.json', json.dumps(content, indent=2) + '\n')
    write_picture(
        arguments.out / 'drift_correction.png', _figure(found, odometries, arguments.wrong_by)
    )
    print(report)
    sys.exit(not all(row.keeps_bound and row.withstands for row in rows))


class _Recorder:
    """Passes on what a localizer says, and keeps it."""

    def __init__(self, localizer: Localizer) -> None:
        self._localizer = localizer
        self.results: list[LocalizationResult] = []

    def localize(
        self, image: NDArray[np.uint8], camera: pycolmap.Camera, prior: Prior | None = None
    ) -> LocalizationResult:
        self.results.append(self._localizer.localize(image, camera, prior))
        return self.results[-1]


def _record(bag: Path) -> tuple[dict[float, list[Found]], tuple[OdometrySample, ...]]:
    """What the localizer finds, by period, and the odometry."""
    localizer = Localizer.load(demo_map_path())
    found: dict[float, list[Found]] = {}
    odometry: tuple[OdometrySample, ...] = ()
    for period in PERIODS:
        options = ReplayOptions(
            period=period,
            base_from_camera=BASE_FROM_CAMERA,
            odometry_topic=ODOMETRY_TOPIC,
            truth_topic=GROUND_TRUTH_TOPIC,
        )
        recorder = _Recorder(localizer)
        replayed = replay_bag(bag, recorder, options)
        found[period] = [
            _found(attempt, result)
            for attempt, result in zip(replayed.attempts, recorder.results, strict=True)
        ]
        odometry = replayed.odometry
        print(f'replayed with a fix every {period:g} s', file=sys.stderr)
    return found, odometry


def _found(attempt: Attempt, result: LocalizationResult) -> Found:
    accepted = result.accepted and result.estimate is not None
    pose = robot_pose(result.estimate, BASE_FROM_CAMERA) if accepted else None
    return Found(attempt.stamp_ns, pose, attempt.truth)


def _with_heading_drift(odometry: Sequence[OdometrySample]) -> list[OdometrySample]:
    """The same odometry, as measured with a heading that drifts by `HEADING_DRIFT` more."""
    drifting = [odometry[0]]
    for before, sample in pairwise(odometry):
        moved = before.odom_from_base.inverse() * sample.odom_from_base
        degrees = HEADING_DRIFT * (sample.stamp_ns - before.stamp_ns) / 1e9
        slip = rigid3d_from_rotation(Rotation.from_euler('z', degrees, degrees=True), np.zeros(3))
        odom_from_base = drifting[-1].odom_from_base * moved * slip
        drifting.append(replace(sample, odom_from_base=odom_from_base))
    return drifting


def _row(
    name: str,
    period: float,
    found: Sequence[Found],
    odometry: Sequence[OdometrySample],
    arguments: argparse.Namespace,
) -> Row:
    clean = _run(found, odometry)
    errors = clean.trajectories.errors()
    fix_error = errors['fixes'].position_median
    spoilt = [
        _with_wrong_fixes(found, odometry, arguments.wrong_by, seed)
        for seed in range(arguments.seeds)
    ]
    runs = [_run(one, odometry) for one in spoilt]
    drift = _drift_gained(odometry, period)
    return Row(
        odometry=name,
        period=period,
        errors=errors,
        drift=drift,
        bound=fix_error + drift,
        largest_step=clean.largest_step,
        wrong=(
            sum(one.is_wrong for one in spoilt[0]),
            sum(one.pose is not None for one in found),
        ),
        injected_rmse=max(_corrected_rmse(run) for run in runs),
        injected_bound=fix_error + _drift_gained(odometry, 2.0 * period),
        injected_step=max(run.largest_step for run in runs),
        misled=sum(run.misled for run in runs),
        unguarded_step=max(_unguarded_step(one, odometry) for one in spoilt),
    )


def _corrected_rmse(run: Run) -> float:
    error = TrajectoryError.of(run.trajectories.corrected)
    return 0.0 if error is None else error.position_rmse


def _run(found: Sequence[Found], odometry: Sequence[OdometrySample]) -> Run:
    """Feeds a fresh `Continuity` as the replay does."""
    continuity, coming, attempts = Continuity(), iter(odometry), []
    sample = next(coming, None)
    for one in found:
        while sample is not None and sample.stamp_ns <= one.stamp_ns + DELAY_NS:
            continuity.add_odometry(sample.stamp_ns, sample.odom_from_base)
            sample = next(coming, None)
        passes = one.pose and continuity.judge(one.stamp_ns, ACCEPTED, one.pose).accepted
        pose = one.pose if passes else None
        attempts.append(Attempt(one.stamp_ns, ACCEPTED, pose, one.truth, continuity.correction))
    trajectories = trajectories_of(odometry, attempts)
    wrong = {one.stamp_ns for one in found if one.is_wrong}
    corrections = [attempt.correction for attempt in attempts if attempt.correction is not None]
    return Run(
        trajectories,
        _largest_step(trajectories.corrected, odometry),
        any(correction.stamp_ns in wrong for correction in corrections),
    )


def _largest_step(poses: Sequence[TimedPose], odometry: Sequence[OdometrySample]) -> float:
    """By how far the robot is moved at most beyond what odometry moves it, from pose to pose."""
    by_stamp = {sample.stamp_ns: sample.odom_from_base for sample in odometry}
    steps = [0.0]
    for before, pose in pairwise(poses):
        moved = by_stamp[before.stamp_ns].inverse() * by_stamp[pose.stamp_ns]
        carried_on = before.map_from_base * moved
        steps.append(float(np.linalg.norm(pose.map_from_base.translation - carried_on.translation)))
    return max(steps)


def _unguarded_step(found: Sequence[Found], odometry: Sequence[OdometrySample]) -> float:
    """As `_largest_step`, if the newest fix were always believed."""
    by_stamp = {sample.stamp_ns: sample.odom_from_base for sample in odometry}
    fixes = [
        TimedPose(one.stamp_ns, one.pose.map_from_base)
        for one in found
        if one.pose is not None and one.stamp_ns in by_stamp
    ]
    return _largest_step(fixes, odometry)


def _drift_gained(odometry: Sequence[OdometrySample], seconds: float) -> float:
    """How far odometry that is right at one time is off so much later; mean over the drive [m]."""
    known = [sample for sample in odometry if sample.truth is not None]
    stamps = [sample.stamp_ns for sample in known]
    gained = []
    for sample in known:
        later = int(np.searchsorted(stamps, sample.stamp_ns + round(seconds * 1e9)))
        if later == len(known):
            break
        map_from_odom = sample.truth * sample.odom_from_base.inverse()
        predicted = map_from_odom * known[later].odom_from_base
        gained.append(pose_error(predicted.inverse(), known[later].truth.inverse()).position)
    return float(np.mean(gained))


def _with_wrong_fixes(
    found: Sequence[Found], odometry: Sequence[OdometrySample], wrong_by: float, seed: int
) -> list[Found]:
    """One in ten of the fixes, at least one, is of another time of the drive."""
    rng = np.random.default_rng(seed)
    fixes = [index for index, one in enumerate(found) if one.pose is not None]
    count = max(1, round(WRONG_SHARE * len(fixes)))
    chosen = set(rng.choice(fixes, count, replace=False).tolist())
    if seed % FIRST_WRONG_EACH == 0 and fixes[0] not in chosen:
        chosen = {fixes[0], *sorted(chosen)[1:]}
    covariance = np.diag(np.square(np.repeat(WRONG_STD, 3)))
    spoilt = list(found)
    for index in sorted(chosen):
        pose = RobotPose(_elsewhere(found[index].truth, odometry, wrong_by, rng), covariance)
        spoilt[index] = replace(found[index], pose=pose, is_wrong=True)
    return spoilt


def _elsewhere(
    truth: pycolmap.Rigid3d,
    odometry: Sequence[OdometrySample],
    wrong_by: float,
    rng: np.random.Generator,
) -> pycolmap.Rigid3d:
    """Another place of the drive, far enough to be wrong."""
    while True:
        place = odometry[int(rng.integers(len(odometry)))].truth
        if place is not None:
            apart = np.linalg.norm(place.translation - truth.translation)
            if apart > wrong_by:
                return place


def _report(rows: Sequence[Row], arguments: argparse.Namespace) -> str:
    """Tables in Markdown."""
    header = (
        '| odometry | N | odometry alone | fixes, median | fixes | corrected '
        '| drift in N | bound | kept |'
    )
    clean = [header, '|---' * 9 + '|', *map(_clean_line, rows)]
    header = (
        '| odometry | N | wrong fixes | corrected, worst seed | bound | kept '
        '| wrong fixes believed | largest step | without wrong ones | if all fixes counted |'
    )
    injected = [header, '|---' * 10 + '|', *map(_injected_line, rows)]
    return '\n'.join(
        [
            'Absolute trajectory error of the position [cm]: RMSE / largest.',
            '',
            *clean,
            '',
            f'With wrong fixes, by {arguments.wrong_by:g} m or more, {arguments.seeds} seeds; in '
            f'each {FIRST_WRONG_EACH}th the first fix is wrong. RMSE and steps [cm].',
            '',
            *injected,
        ]
    )


def _clean_line(row: Row) -> str:
    sizes = [
        f'{_cm(row.errors[name].position_rmse)} / {_cm(row.errors[name].position_max)}'
        for name in ('odometry', 'fixes', 'corrected')
    ]
    median = _cm(row.errors['fixes'].position_median)
    cells = [row.odometry, f'{row.period:g} s', sizes[0], median, sizes[1], sizes[2]]
    cells += [_cm(row.drift), _cm(row.bound), _yes(truth=row.keeps_bound)]
    return f'| {" | ".join(cells)} |'


def _injected_line(row: Row) -> str:
    wrong, fixes = row.wrong
    cells = [row.odometry, f'{row.period:g} s', f'{wrong} of {fixes}', _cm(row.injected_rmse)]
    cells += [_cm(row.injected_bound), _yes(truth=row.withstands), str(row.misled)]
    cells += [_cm(row.injected_step), _cm(row.largest_step), _cm(row.unguarded_step)]
    return f'| {" | ".join(cells)} |'


def _cm(metres: float) -> str:
    return f'{100.0 * metres:.1f}'


def _yes(*, truth: bool) -> str:
    return 'yes' if truth else '**no**'


def _figure(
    found: Mapping[float, Sequence[Found]],
    odometries: Mapping[str, Sequence[OdometrySample]],
    wrong_by: float,
) -> Figure:
    """Errors over time: both odometries, and the second one with wrong fixes."""
    figure = Figure(figsize=(11.0, 7.0), layout='constrained')
    grid = figure.subplots(3, len(DRAWN_PERIODS), sharex=True, sharey='row')
    for column, period in enumerate(DRAWN_PERIODS):
        drifting = odometries[DRIFTING]
        spoilt = _with_wrong_fixes(found[period], drifting, wrong_by, DRAWN_SEED)
        panels = (
            (f'odometry {OF_THE_BAG}', found[period], odometries[OF_THE_BAG]),
            (DRIFTING, found[period], drifting),
            ('the same, with wrong fixes (x)', spoilt, drifting),
        )
        for axes, (title, fixes, odometry) in zip(grid[:, column], panels, strict=True):
            _draw(axes, f'{title}, N = {period:g} s', fixes, odometry)
        grid[-1, column].set_xlabel('time [s]')
    for axes in grid[:, 0]:
        axes.set_ylabel('position error [cm]')
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc='outside upper center', ncols=3)
    return figure


def _draw(
    axes: Axes, title: str, found: Sequence[Found], odometry: Sequence[OdometrySample]
) -> None:
    trajectories = _run(found, odometry).trajectories
    wrong = [one.stamp_ns for one in found if one.is_wrong]
    good = tuple(pose for pose in trajectories.fixes if pose.stamp_ns not in wrong)
    shown = replace(trajectories, fixes=good)
    draw_drift(axes, shown, lambda error: 100.0 * error.position)
    axes.get_legend().remove()
    # all panels of a row have the same odometry, which is what drifts furthest
    top = 110.0 * shown.errors()['odometry'].position_max
    axes.set_ylim(0.0, top)
    seconds = [(stamp_ns - odometry[0].stamp_ns) / 1e9 for stamp_ns in wrong]
    axes.plot(seconds, np.full(len(wrong), 0.03 * top), 'x', color=REFUSED, markersize=6)
    axes.set_title(title, fontsize=9)


if __name__ == '__main__':
    main()
