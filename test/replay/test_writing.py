# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
from recorded_drive import KnowingLocalizer

from gam_relocalizer.errors import UsageError
from gam_relocalizer.geometry import pose_error, rigid3d_from
from gam_relocalizer.replay.bag import open_bag
from gam_relocalizer.replay.messages import pose_in
from gam_relocalizer.replay.replay import ReplayOptions, replay_bag
from gam_relocalizer.replay.summary import Row, row_of
from gam_relocalizer.replay.writing import (
    FIX_TOPIC,
    FIXES,
    POSES,
    SUMMARY,
    output_folder,
    write_fixes,
    write_summary,
    write_trajectory,
)

if TYPE_CHECKING:
    from pathlib import Path

    from gam_relocalizer.scene_map import SceneMap


@pytest.fixture(scope='module')
def rows(mcap_drive: Path, wall_map: SceneMap) -> list[Row]:
    """Ten attempts, of which the one at index 20 was refused."""
    localizer = KnowingLocalizer(wall_map.points, refuse=[20])
    options = ReplayOptions(period=1.0, truth_topic='/ground_truth')
    return [row_of(attempt) for attempt in replay_bag(mcap_drive, localizer, options).attempts]


def test_trajectory_has_one_line_for_every_fix(rows: list[Row], tmp_path: Path) -> None:
    write_trajectory(tmp_path, rows)
    lines = (tmp_path / POSES).read_text(encoding='utf-8').splitlines()
    fixes = [row for row in rows if row.robot_pose]
    assert len(lines) == len(fixes) == 9
    for line, row in zip(lines, fixes, strict=True):
        stamp, *numbers = line.split()
        tx, ty, tz, qx, qy, qz, qw = map(float, numbers)
        seconds, nanoseconds = stamp.split('.')
        assert (len(nanoseconds), int(seconds + nanoseconds)) == (9, row.stamp_ns)
        written = rigid3d_from((qw, qx, qy, qz), (tx, ty, tz))
        assert row.robot_pose is not None
        error = pose_error(written.inverse(), row.robot_pose.map_from_base.inverse())
        assert error.position < 1e-8
        assert error.rotation_deg < 1e-6


def test_trajectory_has_no_negative_zero(rows: list[Row], tmp_path: Path) -> None:
    write_trajectory(tmp_path, rows)
    assert '-0.000000000' not in (tmp_path / POSES).read_text(encoding='utf-8')


def test_fixes_are_a_bag_of_stamped_poses_with_covariance(rows: list[Row], tmp_path: Path) -> None:
    write_fixes(tmp_path, rows, 'map')
    assert [file.name for file in tmp_path.iterdir()] == [FIXES]
    fixes = [(row.stamp_ns, row.robot_pose) for row in rows if row.robot_pose]
    with open_bag(tmp_path / FIXES) as bag:
        messages = list(bag.messages([FIX_TOPIC]))
    assert [message.log_ns for message in messages] == [stamp for stamp, _ in fixes]
    for message, (stamp_ns, robot_pose) in zip(messages, fixes, strict=True):
        assert (message.stamp_ns, message.value.header.frame_id) == (stamp_ns, 'map')
        error = pose_error(pose_in(message).inverse(), robot_pose.map_from_base.inverse())
        assert error.position < 1e-12
        covariance = message.value.pose.covariance.reshape(6, 6)
        np.testing.assert_array_equal(covariance, robot_pose.covariance)


def test_no_fix_is_an_empty_trajectory_and_a_readable_bag(tmp_path: Path, rows: list[Row]) -> None:
    refused = [row for row in rows if row.robot_pose is None]
    write_trajectory(tmp_path, refused)
    write_fixes(tmp_path, refused, 'map')
    assert (tmp_path / POSES).read_bytes() == b''
    with open_bag(tmp_path / FIXES) as bag:
        assert bag.topics[FIX_TOPIC].count == 0
        assert list(bag.messages([FIX_TOPIC])) == []


def test_same_bag_gives_the_same_bytes(
    mcap_drive: Path, wall_map: SceneMap, tmp_path: Path
) -> None:
    for name in ('first', 'second'):
        (tmp_path / name).mkdir()
        replay = replay_bag(
            mcap_drive, KnowingLocalizer(wall_map.points), ReplayOptions(period=0.5)
        )
        again = [row_of(attempt) for attempt in replay.attempts]
        write_trajectory(tmp_path / name, again)
        write_fixes(tmp_path / name, again, 'map')
    for file in (POSES, FIXES):
        first = (tmp_path / 'first' / file).read_bytes()
        assert first == (tmp_path / 'second' / file).read_bytes()


def test_summary_counts_verdicts_errors_and_times(rows: list[Row], tmp_path: Path) -> None:
    write_summary(tmp_path, rows, {'bag': 'drive', 'map_id': 'abc'})
    summary = json.loads((tmp_path / SUMMARY).read_text(encoding='utf-8'))
    assert (summary['attempts'], summary['accepted']) == (10, 9)
    assert summary['statuses'] == {'ACCEPTED': 9, 'TOO_FEW_INLIERS': 1}
    assert summary['position_error']['max'] < 1e-9
    assert summary['milliseconds']['matching']['median'] == pytest.approx(50.0)
    assert summary['total_milliseconds']['max'] == pytest.approx(108.0)
    assert (summary['bag'], summary['map_id']) == ('drive', 'abc')


def test_summary_without_truth_claims_no_error(tmp_path: Path) -> None:
    write_summary(tmp_path, [], {})
    summary = json.loads((tmp_path / SUMMARY).read_text(encoding='utf-8'))
    assert summary['attempts'] == 0
    assert summary['position_error'] is None
    assert summary['total_milliseconds'] is None


def make_replay(out: Path, text: str = '') -> None:
    with output_folder(out) as folder:
        write_summary(folder, [], {'text': text})


def test_output_replaces_an_earlier_replay(tmp_path: Path) -> None:
    out = tmp_path / 'deep' / 'out'
    make_replay(out, 'first')
    (out / 'leftover.txt').write_text('old', encoding='utf-8')
    make_replay(out, 'second')
    assert [file.name for file in out.iterdir()] == [SUMMARY]
    assert 'second' in (out / SUMMARY).read_text(encoding='utf-8')
    assert list(out.parent.iterdir()) == [out]


def test_output_may_be_an_empty_folder(tmp_path: Path) -> None:
    out = tmp_path / 'out'
    out.mkdir()
    make_replay(out)
    assert (out / SUMMARY).is_file()


@pytest.mark.parametrize('name', ['notes.txt', SUMMARY])
def test_output_never_replaces_anything_else(tmp_path: Path, name: str) -> None:
    out = tmp_path / 'out'
    out.mkdir()
    (out / name).write_text('{"precious": true}', encoding='utf-8')
    with pytest.raises(UsageError, match='out'):
        make_replay(out)
    assert [file.name for file in tmp_path.iterdir()] == ['out']
    assert (out / name).read_text(encoding='utf-8') == '{"precious": true}'


def test_output_never_replaces_a_file(tmp_path: Path) -> None:
    out = tmp_path / 'out'
    out.write_text('precious', encoding='utf-8')
    with pytest.raises(UsageError, match='out'):
        make_replay(out)
    assert out.read_text(encoding='utf-8') == 'precious'


def test_failed_replay_leaves_nothing_behind(tmp_path: Path) -> None:
    out = tmp_path / 'out'
    make_replay(out, 'first')
    with pytest.raises(IsADirectoryError), output_folder(out) as folder:
        folder.write_text('a replay that fails', encoding='utf-8')
    assert list(tmp_path.iterdir()) == [out]
    assert 'first' in (out / SUMMARY).read_text(encoding='utf-8')
