# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

import numpy as np
import pytest
from recorded_drive import BagWriter, write_bag
from typer.testing import CliRunner

from gam_relocalizer.cli.map import app
from gam_relocalizer.demo import trajectories
from gam_relocalizer.demo.recording import START_NS
from gam_relocalizer.demo.world import tiny_world
from gam_relocalizer.errors import BagError, UsageError, VideoError
from gam_relocalizer.geometry import rotation_of
from gam_relocalizer.scene_map import load_map

if TYPE_CHECKING:
    from pathlib import Path

    from click.testing import Result
    from tiny_place import TinyPlace

    from gam_relocalizer.scene_map import SceneMap

RUNNER = CliRunner()


def run(*arguments: str) -> Result:
    return RUNNER.invoke(app, arguments)


@pytest.fixture(scope='module')
def built(tiny_place: TinyPlace, tmp_path_factory: pytest.TempPathFactory) -> tuple[SceneMap, str]:
    """The map of a robot's drive, built and aligned from nothing but its bag."""
    out = tmp_path_factory.mktemp('built') / 'map'
    done = run('build', '--bag', str(tiny_place.bag), '--out', str(out))
    assert done.exit_code == 0, done.output
    return load_map(out), done.stdout


def test_a_bag_with_odometry_gives_a_metric_map_that_is_level(
    built: tuple[SceneMap, str],
) -> None:
    scene_map, _ = built
    drive = trajectories.drive(tiny_world().drive_route)
    found = list(scene_map.camera_from_map)
    stamps = [float(name.removesuffix('.jpg')) - START_NS / 1e9 for name in scene_map.image_names]
    truth = [drive.camera_from_map(stamp) for stamp in stamps]

    # odometry starts at the origin: only that lies between its frame and the true one
    map_from_odom = drive.map_from_base(0.0)
    positions = np.array([map_from_odom * pose.tgt_origin_in_src() for pose in found])
    expected = np.array([pose.tgt_origin_in_src() for pose in truth])
    turned = [
        (rotation_of(one) * rotation_of(map_from_odom.inverse()) * rotation_of(other).inv())
        for one, other in zip(found, truth, strict=True)
    ]
    ups = np.array([rotation_of(pose).apply([0.0, 0.0, 1.0]) for pose in found])
    true_ups = np.array([rotation_of(pose).apply([0.0, 0.0, 1.0]) for pose in truth])

    assert scene_map.manifest.frame.metric
    assert np.linalg.norm(positions - expected, axis=1).max() < 0.08
    assert max(np.degrees(turn.magnitude()) for turn in turned) < 3.0
    assert np.degrees(np.arccos(np.sum(ups * true_ups, axis=1).clip(-1, 1))).max() < 1.0


def test_the_camera_of_the_bag_is_that_of_the_map(
    built: tuple[SceneMap, str], tiny_place: TinyPlace
) -> None:
    (line,) = built[0].manifest.build['report']['cameras']
    assert [float(word) for word in line.split()[3:]] == pytest.approx(
        list(tiny_place.camera.params)
    )


def test_says_what_became_of_the_frames_and_how_well_the_map_fits(
    built: tuple[SceneMap, str],
) -> None:
    _, output = built
    for word in ('frames read', 'blurred', 'keyframes', '/odom', 'residual', 'scale'):
        assert word in output


def test_a_map_of_a_bag_is_named_after_it(
    built: tuple[SceneMap, str], tiny_place: TinyPlace
) -> None:
    assert built[0].manifest.build['images'] == tiny_place.bag.name


def test_a_bag_extends_a_map_in_place_and_the_images_of_both_remain(
    built: tuple[SceneMap, str], tiny_place: TinyPlace, tmp_path: Path
) -> None:
    before, _ = built
    out = tmp_path / 'map'
    shutil.copytree(before.path, out)
    shutil.copytree(f'{before.path}.work', f'{out}.work')
    shutil.copytree(tiny_place.bag, tmp_path / 'day 2')

    arguments = ['--bag', str(tmp_path / 'day 2'), '--prefix', 'day2/', '--out', str(out)]
    done = run('extend', str(out), *arguments)
    assert done.exit_code == 0, done.exception

    after = load_map(out)
    (change,) = after.manifest.build['changes']
    keyframes = set((tmp_path / 'map.work' / 'keyframes').iterdir())
    (added,) = (folder for folder in keyframes if str(folder) in done.stdout)
    (there,) = keyframes - {added}

    assert change['images'] == 'day 2'
    assert after.image_names[: before.num_images] == before.image_names
    assert after.num_images > 1.9 * before.num_images
    for name in after.image_names:
        is_added = name.startswith('day2/')
        assert ((added / name[len('day2/') :]) if is_added else (there / name)).is_file()


@pytest.mark.parametrize(
    'arguments',
    [
        [],
        ['--images', '.', '--video', 'walk.mp4'],
        ['--video', 'walk.mp4', '--bag', 'drive'],
        ['--video', 'walk.mp4', '--poses', 'poses.txt'],
        ['--bag', 'drive', '--poses', 'poses.txt'],
        ['--video', 'walk.mp4', '--odom-topic', '/odom'],
        ['--images', '.', '--image-is-rectified'],
        ['--images', '.', '--base-frame', ''],
    ],
)
def test_options_that_do_not_go_together_are_usage_errors(
    arguments: list[str], tmp_path: Path
) -> None:
    done = run('build', *arguments, '--out', str(tmp_path / 'map'))
    assert isinstance(done.exception, UsageError)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(('source', 'error'), [('--video', VideoError), ('--bag', BagError)])
def test_a_source_that_is_missing_leaves_nothing_behind(
    source: str, error: type[Exception], tmp_path: Path
) -> None:
    done = run('build', source, str(tmp_path / 'nothing'), '--out', str(tmp_path / 'map'))
    assert isinstance(done.exception, error)
    assert list(tmp_path.iterdir()) == []


def test_a_bag_that_makes_no_map_leaves_its_keyframes_only(tmp_path: Path) -> None:
    def fill(bag: BagWriter) -> None:
        for index in range(3):
            random = np.random.default_rng(index)
            bag.image(index, data=random.integers(0, 255, 64 * 48, dtype=np.uint8))

    bag = write_bag(tmp_path / 'drive', fill)
    done = run('build', '--bag', str(bag), '--out', str(tmp_path / 'map'))

    assert done.exit_code == 1
    assert not (tmp_path / 'map').exists()
