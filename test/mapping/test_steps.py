# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import shutil
import signal
import subprocess
import sys
from contextlib import ExitStack
from typing import TYPE_CHECKING

import cv2
import pytest
from corner_room import CAMERA, CornerRoom, looking_into_the_corner
from full_disk import files_no_larger_than

from gam_relocalizer.cameras import format_camera, parse_camera
from gam_relocalizer.errors import MapBuildError
from gam_relocalizer.image_set import ImageSet
from gam_relocalizer.mapping.build import MapBuildOptions, build_map
from gam_relocalizer.mapping.workspace import open_workspace, workspace_of
from gam_relocalizer.scene_map import MANIFEST

if TYPE_CHECKING:
    from pathlib import Path

    from conftest import BuiltMap, Room

    from gam_relocalizer.mapping.report import BuildReport

OPTIONS = MapBuildOptions(max_keypoints=600)
IMAGES, PAIRS = 8, 28
EVERYTHING = {'extract': IMAGES, 'match': PAIRS, 'verify': PAIRS, 'sfm': IMAGES}
BUILD_THAT_IS_KILLED = """
import os, signal, sys
from pathlib import Path
from gam_relocalizer.cameras import parse_camera
from gam_relocalizer.image_set import ImageSet
from gam_relocalizer.mapping.build import MapBuildOptions, build_map
from gam_relocalizer.mapping.workspace import open_workspace, workspace_of

images, camera, out, last_step, last_done = sys.argv[1:]

def progress(step, done, total):
    if step == last_step and done >= int(last_done):
        os.kill(os.getpid(), signal.SIGKILL)

with open_workspace(workspace_of(Path(out))) as workspace:
    build_map(
        ImageSet.of_folder(Path(images), parse_camera(camera)),
        Path(out),
        MapBuildOptions(max_keypoints=600),
        progress,
        workspace,
    )
"""


def build(out: Path, images: ImageSet, options: MapBuildOptions = OPTIONS) -> BuildReport:
    with open_workspace(workspace_of(out)) as workspace:
        return build_map(images, out, options, workspace=workspace)


def bytes_of(path: Path) -> dict[str, bytes]:
    """All files of a map but the manifest, which holds times."""
    return {
        file.relative_to(path).as_posix(): file.read_bytes()
        for file in path.rglob('*')
        if file.is_file() and file.name != MANIFEST
    }


@pytest.fixture(scope='module')
def finished(room: Room, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map beside the workspace it was built in."""
    out = tmp_path_factory.mktemp('finished') / 'map'
    build(out, ImageSet.of_folder(room.images, CAMERA))
    return out


@pytest.fixture
def out(finished: Path, tmp_path: Path) -> Path:
    """A copy of that."""
    shutil.copytree(finished.parent, tmp_path, dirs_exist_ok=True)
    return tmp_path / finished.name


@pytest.fixture
def images(room: Room, tmp_path: Path) -> Path:
    """A copy of the folder of images."""
    return shutil.copytree(room.images, tmp_path / 'images')


def test_a_workspace_changes_nothing_about_the_map(finished: Path, free_map: BuiltMap) -> None:
    assert bytes_of(finished) == bytes_of(free_map.path)


def test_nothing_is_done_twice(out: Path, room: Room) -> None:
    before = bytes_of(out)

    report = build(out, ImageSet.of_folder(room.images, CAMERA))

    assert report.reused == EVERYTHING
    assert bytes_of(out) == before


def test_a_build_that_is_killed_again_and_again_continues_and_gives_the_same_map(
    room: Room, free_map: BuiltMap, tmp_path: Path
) -> None:
    arguments = [str(room.images), format_camera(CAMERA), str(tmp_path / 'map')]
    for step, done in [('extract', 3), ('match', 15), ('verify', 15), ('sfm', 2)]:
        killed = subprocess.run(
            [sys.executable, '-c', BUILD_THAT_IS_KILLED, *arguments, step, str(done)], check=False
        )
        assert killed.returncode == -signal.SIGKILL
        assert not (tmp_path / 'map').exists()

    report = build(tmp_path / 'map', ImageSet.of_folder(room.images, CAMERA))

    assert report.reused == {**EVERYTHING, 'sfm': 0}
    assert bytes_of(tmp_path / 'map') == bytes_of(free_map.path)


def test_a_killed_build_did_not_lose_the_images_and_pairs_it_had_finished(
    room: Room, tmp_path: Path
) -> None:
    images = ImageSet.of_folder(room.images, CAMERA)

    class Interruption(Exception):  # noqa: N818 - the user's, no error
        pass

    def interrupt(step: str, done: int, total: int) -> None:
        if step == 'verify' and done > total // 2:
            raise Interruption

    with (
        pytest.raises(Interruption),
        open_workspace(workspace_of(tmp_path / 'map')) as workspace,
    ):
        build_map(images, tmp_path / 'map', OPTIONS, interrupt, workspace)

    reused = build(tmp_path / 'map', images).reused
    assert (reused['extract'], reused['match']) == (IMAGES, PAIRS)
    assert PAIRS // 2 < reused['verify'] < PAIRS


@pytest.mark.parametrize(
    ('options', 'camera', 'reused'),
    [
        (MapBuildOptions(max_keypoints=600, mapper='global'), CAMERA, {**EVERYTHING, 'sfm': 0}),
        (MapBuildOptions(max_keypoints=600, refine_camera=True), CAMERA, {**EVERYTHING, 'sfm': 0}),
        (
            OPTIONS,
            parse_camera('SIMPLE_PINHOLE 384 288 341 192 144'),
            {**EVERYTHING, 'verify': 0, 'sfm': 0},
        ),
        (MapBuildOptions(max_keypoints=500), CAMERA, dict.fromkeys(EVERYTHING, 0)),
        (MapBuildOptions(max_keypoints=600, descriptor_bits=8), CAMERA, EVERYTHING),
    ],
    ids=['mapper', 'refine camera', 'camera', 'max keypoints', 'descriptor bits'],
)
def test_a_changed_option_repeats_what_depends_on_it(
    out: Path, room: Room, options: MapBuildOptions, camera: object, reused: dict[str, int]
) -> None:
    images = ImageSet.of_folder(room.images, camera)

    assert build(out, images, options).reused == reused
    assert build(out, images, options).reused == EVERYTHING


def test_poses_repeat_structure_from_motion_alone(
    out: Path, room: Room, posed_map: BuiltMap
) -> None:
    report = build(out, ImageSet.of_folder(room.images, CAMERA, room.poses))

    assert report.reused == {**EVERYTHING, 'sfm': 0}
    assert bytes_of(out) == bytes_of(posed_map.path)


def test_a_further_image_adds_its_features_and_pairs(out: Path, images: Path) -> None:
    view = CornerRoom().render(looking_into_the_corner(0.55))
    cv2.imwrite(str(images / 'view 03b.png'), cv2.cvtColor(view, cv2.COLOR_RGB2BGR))
    image_set = ImageSet.of_folder(images, CAMERA)

    report = build(out, image_set)

    assert report.reused == {**EVERYTHING, 'sfm': 0}
    assert report.images_registered == IMAGES + 1
    build_map(image_set, out.with_name('fresh'), OPTIONS)
    assert bytes_of(out) == bytes_of(out.with_name('fresh'))


def test_a_removed_image_repeats_structure_from_motion_alone(out: Path, images: Path) -> None:
    (images / 'view 04.png').unlink()

    report = build(out, ImageSet.of_folder(images, CAMERA))

    assert report.reused == {'extract': 7, 'match': 21, 'verify': 21, 'sfm': 0}
    assert report.images_registered == 7


def test_a_changed_image_is_described_and_matched_anew(out: Path, images: Path) -> None:
    view = CornerRoom().render(looking_into_the_corner(0.55))
    cv2.imwrite(str(images / 'view 04.png'), cv2.cvtColor(view, cv2.COLOR_RGB2BGR))

    report = build(out, ImageSet.of_folder(images, CAMERA))

    assert report.reused == {'extract': 7, 'match': 21, 'verify': 21, 'sfm': 0}


def test_renamed_images_are_known_by_their_contents(out: Path, images: Path) -> None:
    for file in sorted(images.iterdir()):
        file.rename(file.with_name(f'renamed {file.name}'))

    report = build(out, ImageSet.of_folder(images, CAMERA))

    assert report.reused == {**EVERYTHING, 'sfm': 0}
    assert report.images_registered == IMAGES


@pytest.mark.parametrize('step', ['features', 'retrieval', 'matches', 'geometries', 'models'])
@pytest.mark.parametrize('damage', ['truncated', 'changed'])
def test_damaged_results_are_made_again(out: Path, room: Room, step: str, damage: str) -> None:
    before = bytes_of(out)
    work = workspace_of(out)
    for file in [one for one in (work / step).rglob('*') if one.is_file()]:
        data = bytearray(file.read_bytes())
        data[len(data) // 2] ^= 255
        file.write_bytes(data[: len(data) // 2] if damage == 'truncated' else data)
    if step != 'models':  # else nobody would look at them
        shutil.rmtree(work / 'models')

    report = build(out, ImageSet.of_folder(room.images, CAMERA))

    assert bytes_of(out) == before
    assert report.reused != EVERYTHING


def test_images_are_not_needed_once_they_are_described(
    finished: Path, images: Path, tmp_path: Path
) -> None:
    def delete_images(step: str, *_: int) -> None:
        if step == 'match' and images.exists():
            shutil.rmtree(images)

    build_map(ImageSet.of_folder(images, CAMERA), tmp_path / 'new', OPTIONS, delete_images)

    assert not images.exists()
    assert bytes_of(tmp_path / 'new') == bytes_of(finished)


@pytest.mark.parametrize('full_at', ['extract', 'match', 'verify', 'sfm'])
def test_a_full_disk_ends_the_build_and_leaves_no_map(
    room: Room, tmp_path: Path, full_at: str
) -> None:
    images = ImageSet.of_folder(room.images, CAMERA, room.poses)

    def fill_disk(step: str, *_: int) -> None:
        if step == full_at:
            disk.enter_context(files_no_larger_than(1000))

    with (
        ExitStack() as disk,
        pytest.raises(MapBuildError, match=r'map\.work'),
        open_workspace(workspace_of(tmp_path / 'map')) as workspace,
    ):
        build_map(images, tmp_path / 'map', OPTIONS, fill_disk, workspace)

    assert not (tmp_path / 'map').exists()
    assert build(tmp_path / 'map', images).images_registered == IMAGES
