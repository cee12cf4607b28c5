# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import pytest
from corner_room import CAMERA, CornerRoom, looking_into_the_corner, write_room_images

from gam_relocalizer.cameras import format_camera
from gam_relocalizer.evaluation.query_set import QuerySet, read_query_set
from gam_relocalizer.geometry import write_poses
from gam_relocalizer.image_set import ImageSet
from gam_relocalizer.mapping.build import MapBuildOptions, build_map
from gam_relocalizer.mapping.leave_one_out import read_reference_images

if TYPE_CHECKING:
    from gam_relocalizer.mapping.leave_one_out import ReferenceImages

QUERY_STEPS = (0.3, 0.5)


@dataclass(frozen=True)
class Corner:
    """A room: the images of its map, and queries."""

    references: ReferenceImages
    query_set: QuerySet


@pytest.fixture(scope='session')
def corner(tmp_path_factory: pytest.TempPathFactory) -> Corner:
    folder = tmp_path_factory.mktemp('corner')
    poses = write_room_images(folder / 'images', count=5)
    images = ImageSet.of_folder(folder / 'images', CAMERA, poses)
    build_map(images, folder / 'map', MapBuildOptions(max_keypoints=400))
    room, truth = CornerRoom(), {}
    (folder / 'queries').mkdir()
    for index, step in enumerate(QUERY_STEPS):
        truth[f'{index}.png'] = looking_into_the_corner(step)
        image = cv2.cvtColor(room.render(truth[f'{index}.png']), cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(folder / 'queries' / f'{index}.png'), image)
    write_poses(folder / 'truth.txt', truth)
    query_set = read_query_set(
        folder / 'map', folder / 'queries', folder / 'truth.txt', format_camera(CAMERA)
    )
    references = read_reference_images(query_set.scene_map, folder / 'images')
    return Corner(references, query_set)
